//! Counters of packets, and the causes of drops.

/// Why a packet was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Cause {
    /// No interface has the destination address, or it is a private address behind another NAT.
    Unreachable,
    /// The sending or the receiving interface is down.
    InterfaceDown,
    /// A partition or a blackhole.
    Cut,
    /// Random loss.
    Loss,
    /// A full queue in front of a limited rate.
    Queue,
    /// Longer than the path's MTU.
    Mtu,
    /// No NAT mapping for the destination, or its filter refused the sender, or no port was free.
    Nat,
    /// No daemon runs on the host.
    NoSocket,
    /// The receive buffer of a paused host is full.
    ReceiveBuffer,
    /// More packets were in flight than the simulator allows. This is no fault of the engine: raise the limit.
    InFlightLimit,
}

impl Cause {
    /// All causes.
    pub(crate) const ALL: [Self; 10] = [
        Self::Unreachable,
        Self::InterfaceDown,
        Self::Cut,
        Self::Loss,
        Self::Queue,
        Self::Mtu,
        Self::Nat,
        Self::NoSocket,
        Self::ReceiveBuffer,
        Self::InFlightLimit,
    ];
}

/// Counters of one host. Bytes are UDP payload.
///
/// Over all hosts, `sent + copies` is `received`, plus all drops, plus the packets in flight.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counters {
    /// Datagrams sent; a multicast datagram counts once.
    pub(crate) sent: u64,
    pub(crate) sent_bytes: u64,
    /// Datagrams that the network made out of the sent ones: duplicates, and each receiver of a multicast
    /// datagram beyond the first.
    pub(crate) copies: u64,
    pub(crate) received: u64,
    pub(crate) received_bytes: u64,
    dropped: [u64; Cause::ALL.len()],
}

impl Counters {
    /// Returns how many packets that this host sent were dropped for `cause`, wherever.
    pub(crate) fn dropped(&self, cause: Cause) -> u64 {
        self.dropped[cause as usize]
    }

    /// Returns how many packets that this host sent were dropped.
    pub(crate) fn all_dropped(&self) -> u64 {
        self.dropped.iter().sum()
    }

    pub(super) fn count_drop(&mut self, cause: Cause) {
        self.dropped[cause as usize] += 1;
    }
}
