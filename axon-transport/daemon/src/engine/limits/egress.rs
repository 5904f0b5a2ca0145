//! Limits on the bytes a second that leave this host for one identity, or by one network interface.

use std::{
    cell::{Cell, RefCell},
    net::IpAddr,
    rc::Rc,
    time::Duration,
};

use axon_transport::{access::EgressLimit, status::LimitStatus};

use super::{interfaces::InterfaceLimits, rate_bucket::BucketLevel};

/// Bucket size of a limit: seconds of the limited rate, and the minimum in bytes, which is a few packets.
const BURST: (f64, f64) = (0.005, 6000.0);
/// Assumed bytes of a packet, from which the number of packets to pass to the kernel together is computed.
const PACKET: f64 = 1500.0;
/// Time that is added to the round trip: QUIC may hold the bytes of both.
const AHEAD: Duration = Duration::from_millis(20);

/// A limit on all packets to one identity, or by one interface.
#[derive(Debug)]
pub(crate) struct EgressCap {
    limit: EgressLimit,
    /// The interface. `None` for a limit on the packets to an identity.
    interface: Option<String>,
    level: RefCell<BucketLevel>,
    packets: Cell<u64>,
}

impl EgressCap {
    /// Creates a limit on all packets to an identity.
    pub(super) fn of_peer(limit: &EgressLimit) -> Self {
        Self::new(limit, None)
    }

    /// Creates a limit on all packets by an interface.
    pub(super) fn of_interface(limit: &EgressLimit, interface: &str) -> Self {
        Self::new(limit, Some(interface.to_owned()))
    }

    fn new(limit: &EgressLimit, interface: Option<String>) -> Self {
        let most = (limit.bytes * BURST.0).max(BURST.1);
        let level = RefCell::new(BucketLevel::full(limit.bytes, most));
        Self { limit: limit.clone(), interface, level, packets: Cell::default() }
    }

    pub(super) fn is(&self, limit: &EgressLimit) -> bool {
        self.limit == *limit
    }

    pub(super) fn status(&self) -> LimitStatus {
        let mut status = LimitStatus::default();
        status.verb = "egress".into();
        status.name = match &self.interface {
            Some(interface) => format!("(all packets by {interface})"),
            None => "(all packets)".into(),
        };
        status.limit = self.limit.to_string();
        status.place = format!("line {} of {}", self.limit.line, self.limit.file);
        status.passed = self.packets.get();
        status
    }
}

/// The limits on what one connection sends.
#[derive(Clone, Debug, Default)]
pub(crate) struct Egress {
    peer: Vec<Rc<EgressCap>>,
    interface: Vec<Rc<EgressCap>>,
}

impl Egress {
    /// Replaces the limits on what is sent to the peer.
    pub(crate) fn set_peer(&mut self, caps: Vec<Rc<EgressCap>>) {
        self.peer = caps;
    }

    /// Returns the limits on what is sent to the peer.
    pub(crate) fn peer(&self) -> Vec<Rc<EgressCap>> {
        self.peer.clone()
    }

    /// Replaces the limits on what leaves by the interface with this address.
    pub(crate) fn set_interface(&mut self, limits: &InterfaceLimits, local: IpAddr) {
        self.interface = limits.of(local).to_vec();
    }

    fn caps(&self) -> impl Iterator<Item = &EgressCap> {
        self.peer.iter().chain(&self.interface).map(|cap| &**cap)
    }

    /// Returns the status of the limits on the interface.
    pub(crate) fn interface_status(&self) -> impl Iterator<Item = LimitStatus> {
        self.interface.iter().map(|cap| cap.status())
    }

    /// Returns when the next packet may leave, if not now.
    pub(crate) fn closed_until(&self, now: Duration) -> Option<Duration> {
        let open = self.caps().map(|cap| cap.level.borrow().when(1.0));
        open.max().filter(|at| *at > now)
    }

    /// Returns how many packets may leave now.
    pub(crate) fn packets(&self, now: Duration) -> usize {
        let left = self.caps().map(|cap| cap.level.borrow().at(now));
        left.reduce(f64::min).map_or(usize::MAX, |bytes| (bytes / PACKET).max(1.0) as usize)
    }

    /// Records that these packets left.
    pub(crate) fn sent(&self, packets: u64, bytes: u64, now: Duration) {
        for cap in self.caps() {
            cap.level.borrow_mut().take(bytes as f64, now);
            cap.packets.set(cap.packets.get() + packets);
        }
    }

    /// Returns the rate of the slowest limit, in bytes a second.
    pub(crate) fn rate(&self) -> Option<f64> {
        self.caps().map(|cap| cap.limit.bytes).reduce(f64::min)
    }

    /// Returns the congestion window, or the bytes that the limits allow in a round trip and [`AHEAD`] if these are
    /// fewer. QUIC holds no more, so that samples wait where newer ones replace them.
    pub(crate) fn window(&self, window: u64, rtt: Duration) -> u64 {
        let most = self.rate().map(|bytes| (bytes * (rtt + AHEAD).as_secs_f64()).max(2.0 * PACKET));
        most.map_or(window, |most| window.min(most as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::limits::{IdentityLimits, tests::permissions};

    #[test]
    fn slowest_limit_holds_for_all_connections_of_an_identity_together() {
        let rules = "[[limit]]\npeer = \"*\"\negress = \"1 MB/s\"\n[[limit]]\npeer = \"*\"\negress = \"9 MB/s\"";
        let all = IdentityLimits::default();
        let connections = [0, 1].map(|_| {
            let mut egress = Egress::default();
            all.limit_egress(&mut egress, &permissions(rules));
            egress
        });
        let (mut now, mut sent) = (Duration::ZERO, 0);
        while now < Duration::from_secs(10) {
            let mut next = now + Duration::from_millis(1);
            for egress in &connections {
                match egress.closed_until(now) {
                    Some(until) => next = next.min(until),
                    None => {
                        let packets = egress.packets(now).min(10) as u64;
                        egress.sent(packets, packets * 1480, now);
                        sent += packets * 1480;
                    }
                }
            }
            now = next;
        }
        assert!((9_950_000..10_030_000).contains(&sent), "{sent}");
        let one = &connections[0];
        assert_eq!(one.window(1 << 30, Duration::from_millis(80)), 100_000);
        assert_eq!(one.window(50_000, Duration::from_millis(80)), 50_000);
        let free = Egress::default();
        assert_eq!((free.closed_until(now), free.packets(now)), (None, usize::MAX));
        assert_eq!(free.window(7, Duration::ZERO), 7);
    }
}
