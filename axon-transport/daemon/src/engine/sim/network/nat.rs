//! Network address translation, in the terms of RFC 4787: mappings do not depend on the remote endpoint.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    net::{Ipv4Addr, SocketAddrV4},
    time::Duration,
};

use super::nanos;

/// Which incoming packets a NAT forwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Filtering {
    /// Accepts all packets to a mapped port.
    EndpointIndependent,
    /// Accepts packets from an address and port to which the mapping has sent.
    AddressAndPortDependent,
}

const FIRST_PORT: u16 = 49_152;
/// Maximum number of remote endpoints that one mapping remembers. Packets from other endpoints are refused.
const MAX_REMOTES: usize = 4_096;

pub(super) struct Nat {
    pub(super) outer: Ipv4Addr,
    filtering: Filtering,
    /// Nanoseconds without an outgoing packet after which a mapping ends.
    lifetime: u64,
    next_port: u16,
    /// Outer ports that are always forwarded.
    forwards: BTreeMap<u16, SocketAddrV4>,
    by_port: HashMap<u16, Mapping>,
    by_inner: HashMap<SocketAddrV4, u16>,
}

struct Mapping {
    inner: SocketAddrV4,
    ends: u64,
    remotes: BTreeSet<SocketAddrV4>,
}

impl Nat {
    pub(super) fn new(outer: Ipv4Addr, filtering: Filtering, lifetime: Option<Duration>) -> Self {
        Self {
            outer,
            filtering,
            lifetime: lifetime.map_or(u64::MAX, nanos),
            next_port: FIRST_PORT,
            forwards: BTreeMap::new(),
            by_port: HashMap::new(),
            by_inner: HashMap::new(),
        }
    }

    pub(super) fn forward(&mut self, port: u16, inner: SocketAddrV4) {
        self.forwards.insert(port, inner);
    }

    /// Forgets all mappings: the next packet of each socket gets another outer port.
    pub(super) fn rebind(&mut self) {
        self.by_port.clear();
        self.by_inner.clear();
    }

    /// Returns the source address that a packet from `inner` to `remote` has outside, or `None` if no port is
    /// free.
    pub(super) fn outbound(
        &mut self,
        now: u64,
        inner: SocketAddrV4,
        remote: SocketAddrV4,
    ) -> Option<SocketAddrV4> {
        if let Some((port, _)) = self.forwards.iter().find(|(_, to)| **to == inner) {
            return Some(SocketAddrV4::new(self.outer, *port));
        }
        let current = self.by_inner.get(&inner).copied();
        let port = match current.filter(|port| self.by_port[port].ends > now) {
            Some(port) => port,
            None => self.map(inner, current, now)?,
        };
        let mapping = self.by_port.get_mut(&port)?;
        mapping.ends = now.saturating_add(self.lifetime);
        let dependent = self.filtering == Filtering::AddressAndPortDependent;
        if dependent && mapping.remotes.len() < MAX_REMOTES {
            mapping.remotes.insert(remote);
        }
        Some(SocketAddrV4::new(self.outer, port))
    }

    /// Gives `inner` a port that it did not have before.
    fn map(&mut self, inner: SocketAddrV4, expired: Option<u16>, now: u64) -> Option<u16> {
        if let Some(port) = expired {
            self.by_port.remove(&port);
            self.by_inner.remove(&inner);
        }
        for _ in FIRST_PORT..=u16::MAX {
            let port = self.next_port;
            self.next_port = port.checked_add(1).unwrap_or(FIRST_PORT);
            if self.forwards.contains_key(&port) {
                continue;
            }
            match self.by_port.get(&port) {
                Some(mapping) if mapping.ends > now => continue,
                Some(ended) => self.by_inner.remove(&ended.inner),
                None => None,
            };
            self.by_port.insert(port, Mapping { inner, ends: 0, remotes: BTreeSet::new() });
            self.by_inner.insert(inner, port);
            return Some(port);
        }
        None
    }

    /// Returns where a packet from `remote` to the outer `port` goes inside.
    pub(super) fn inbound(
        &self,
        now: u64,
        port: u16,
        remote: SocketAddrV4,
    ) -> Option<SocketAddrV4> {
        if let Some(inner) = self.forwards.get(&port) {
            return Some(*inner);
        }
        let mapping = self.by_port.get(&port)?;
        let lets_in = match self.filtering {
            Filtering::EndpointIndependent => true,
            Filtering::AddressAndPortDependent => mapping.remotes.contains(&remote),
        };
        (lets_in && mapping.ends > now).then_some(mapping.inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OUTER: Ipv4Addr = Ipv4Addr::new(203, 0, 113, 1);

    fn inner(port: u16) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(192, 168, 0, 2), port)
    }

    fn remote(port: u16) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(198, 51, 100, 7), port)
    }

    #[test]
    fn mapping_serves_all_remotes_and_lets_in_by_its_filter() {
        for filtering in [Filtering::EndpointIndependent, Filtering::AddressAndPortDependent] {
            let mut nat = Nat::new(OUTER, filtering, None);
            assert_eq!(nat.inbound(0, FIRST_PORT, remote(1)), None);
            let outer = nat.outbound(0, inner(7), remote(1)).unwrap();
            assert_eq!(nat.outbound(0, inner(7), remote(2)), Some(outer));
            assert_ne!(nat.outbound(0, inner(8), remote(2)), Some(outer));
            assert_eq!(nat.inbound(9, outer.port(), remote(2)), Some(inner(7)));
            let stranger = nat.inbound(9, outer.port(), remote(3));
            assert_eq!(stranger.is_some(), filtering == Filtering::EndpointIndependent);
        }
    }

    #[test]
    fn rebind_and_expiry_give_another_port() {
        let lifetime = Some(Duration::from_nanos(100));
        let mut nat = Nat::new(OUTER, Filtering::EndpointIndependent, lifetime);
        let first = nat.outbound(0, inner(7), remote(1)).unwrap();
        assert_eq!(nat.outbound(99, inner(7), remote(1)), Some(first));
        assert_eq!(nat.inbound(198, first.port(), remote(1)), Some(inner(7)));
        assert_eq!(nat.inbound(199, first.port(), remote(1)), None);
        let second = nat.outbound(199, inner(7), remote(1)).unwrap();
        assert_ne!(second, first);
        nat.rebind();
        assert_eq!(nat.inbound(199, second.port(), remote(1)), None);
        let third = nat.outbound(199, inner(7), remote(1)).unwrap();
        assert!(third != first && third != second);
    }

    #[test]
    fn forwarded_port_is_open_and_stays() {
        let mut nat = Nat::new(OUTER, Filtering::AddressAndPortDependent, None);
        nat.forward(7, inner(7));
        for _ in 0..2 {
            assert_eq!(nat.inbound(0, 7, remote(1)), Some(inner(7)));
            assert_eq!(nat.outbound(0, inner(7), remote(1)).unwrap().port(), 7);
            nat.rebind();
        }
    }

    #[test]
    fn exhausted_ports_refuse_new_sockets_until_one_expires() {
        let lifetime = Some(Duration::from_nanos(100));
        let mut nat = Nat::new(OUTER, Filtering::EndpointIndependent, lifetime);
        let ports = u16::MAX - FIRST_PORT + 1;
        for port in 0..ports {
            nat.outbound(0, inner(port), remote(1)).unwrap();
        }
        assert_eq!(nat.outbound(50, inner(ports), remote(1)), None);
        assert!(nat.outbound(50, inner(3), remote(1)).is_some());
        let reused = nat.outbound(100, inner(ports), remote(1)).unwrap();
        assert_eq!(nat.inbound(100, reused.port(), remote(1)), Some(inner(ports)));
        assert_eq!(nat.by_port.len(), nat.by_inner.len());
    }
}
