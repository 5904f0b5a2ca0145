//! Discovery: which daemons exist, and which of them to dial.
//!
//! [`wire::beacon`](crate::wire::beacon) is the wire format, [`PeerDiscovery`] the state machine, [`socket`] the shared
//! UDP port, and [`run`] the task that ties them together. Discovery sends from QUIC ports through the gateway,
//! whose `DemuxSocket` takes received discovery datagrams out of QUIC's. Discovery is unauthenticated: it selects
//! addresses to dial and proves nothing.

#![forbid(unsafe_code)]

use std::{
    collections::BTreeMap,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4},
    ops::RangeInclusive,
};

use axon_shm::ids::DaemonId;

mod confidence;
mod datagrams;
mod interfaces;
mod peers;
mod run;
pub(crate) mod socket;
#[cfg(test)]
mod tests;
mod wanted;

pub(crate) use confidence::AddressConfidence;
pub(crate) use datagrams::Datagrams;
pub(crate) use interfaces::{Interface, interfaces};
pub(crate) use peers::{Arrival, LocalDaemon, PeerDiscovery, PeersOutput};
pub(crate) use run::{DiscoveryEvent, run};
pub(crate) use wanted::DiscoveryNeeds;

/// Returns the UDP ports of daemons of `domain`. A daemon takes the first free one as its QUIC port.
///
/// ```
/// assert_eq!(axon_daemon::internal::quic_ports(0), 61300..=61315);
/// assert_eq!(axon_daemon::internal::quic_ports(232), 65012..=65027);
/// ```
pub fn quic_ports(domain: u32) -> RangeInclusive<u16> {
    let first = 61_300 + 16 * (domain.min(232) as u16);
    first..=first + 15
}

/// Returns the multicast group and port that all daemons of `domain` share.
///
/// ```
/// let group = axon_daemon::internal::shared_group(7);
/// assert_eq!(group, "239.255.88.8:61007".parse().unwrap());
/// ```
pub fn shared_group(domain: u32) -> SocketAddrV4 {
    let domain = domain.min(232) as u16;
    let last = 1 + (domain % 254) as u8;
    SocketAddrV4::new(Ipv4Addr::new(239, 255, 88, last), 61_000 + domain)
}

/// Returns whether a datagram on a QUIC port that begins with this byte belongs to discovery and not to QUIC.
pub(crate) const fn is_discovery(first_byte: u8) -> bool {
    first_byte & 0b1100_0000 == 0
}

/// A request of discovery to the daemon.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum DiscoveryAction {
    /// Dial this daemon. The daemon answers with [`DiscoveryEvent::LinkUp`] or [`DiscoveryEvent::DialFailed`]; without
    /// an answer it counts as failed after 30 s.
    Dial {
        /// The id of the expected daemon.
        daemon: DaemonId,
        /// In qkd its SAE ID, for the KME.
        sae: Option<String>,
        /// The addresses to try, best first: one to eight.
        addrs: Vec<SocketAddr>,
        /// Whether this host lists the peer; our HELLO contains it.
        listed: bool,
        /// The evidence for the addresses; the answer to the action repeats it.
        standing: AddressConfidence,
    },
    /// The addresses of a linked peer, best first; they are candidates for a second path.
    Addresses {
        /// The id of the peer.
        daemon: DaemonId,
        /// At most eight addresses.
        addresses: Vec<SocketAddr>,
    },
    /// Send this from the QUIC port, best effort.
    SendFromQuicPort {
        /// The destination.
        to: SocketAddr,
        /// At most 512 bytes.
        bytes: Vec<u8>,
    },
    /// This peer is not dialled; the mismatch is the reason. Reported once for each peer; after 32 peers, one a second.
    Mismatch(PeerMismatch),
    /// The addresses of static peers, by name.
    Named(BTreeMap<String, Vec<IpAddr>>),
    /// No datagram of this peer arrived for long, or it said goodbye.
    Gone {
        /// The id of the peer.
        daemon: DaemonId,
    },
}

/// A setting that keeps this daemon and a peer apart.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct PeerMismatch {
    /// The daemon id that the peer states.
    pub peer: DaemonId,
    /// The source address of its beacon.
    pub address: SocketAddr,
    /// The variable to check.
    pub setting: &'static str,
    /// This daemon's value.
    pub ours: String,
    /// The value that the peer states.
    pub theirs: String,
}

impl std::fmt::Display for PeerMismatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { peer, address, setting, ours, theirs } = self;
        write!(f, "peer {peer} at {address} not dialled: {setting} is {theirs} there, {ours} here")
    }
}
