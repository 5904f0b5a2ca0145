//! Finds the destination of a packet: addresses, NAT, partitions.

use std::net::{IpAddr, SocketAddr, SocketAddrV4};

use super::{Cause, Interface, Network, path::Link, topology::Owner};
use crate::engine::sim::rng::{Stream, stream};

const NO_LINK: u32 = u32::MAX;

/// The current route of packets to an address.
#[derive(Clone, Copy)]
pub(super) struct Route {
    pub(super) sender: usize,
    pub(super) interface: u32,
    /// `None` if the host sends to itself.
    pub(super) link: Option<u32>,
    /// The sender, as it is seen outside.
    pub(super) from: SocketAddrV4,
    pub(super) to: SocketAddrV4,
}

impl Network {
    /// Finds the interface with the address that a host sends from.
    pub(super) fn own_address(&self, from: SocketAddr) -> Option<(u32, SocketAddrV4)> {
        let from = v4(from)?;
        match self.owners.get(from.ip())? {
            Owner::Interface(interface) => Some((*interface, from)),
            Owner::Nat(_) => None,
        }
    }

    /// Finds the way of a packet: through the sender's NAT, over a link, to an interface.
    pub(super) fn route(
        &mut self,
        now: u64,
        interface: u32,
        from: SocketAddrV4,
        to: SocketAddr,
    ) -> Result<Route, Cause> {
        let to = v4(to).ok_or(Cause::Unreachable)?;
        let Interface { host: sender, nat, .. } = self.interfaces[interface as usize];
        let mut seen_as = from;
        if let Some(nat) = nat {
            let own = &mut self.nats[nat.0];
            let is_inside = match self.owners.get(to.ip()) {
                Some(Owner::Interface(other)) => self.interfaces[*other as usize].nat == Some(nat),
                _ => false,
            };
            if !is_inside {
                seen_as = own.outbound(now, from, to).ok_or(Cause::Nat)?;
            }
        }
        let (receiving, _) = self.resolve(now, to, seen_as)?;
        let host = self.interfaces[receiving as usize].host;
        if host == sender {
            return Ok(Route { sender, interface: receiving, link: None, from: seen_as, to });
        }
        if self.is_cut(now, sender, host) {
            return Err(Cause::Cut);
        }
        let link = Some(self.link(interface, receiving));
        Ok(Route { sender, interface: receiving, link, from: seen_as, to })
    }

    /// Finds the interface that gets a packet, and the address that it has there.
    pub(super) fn resolve(
        &self,
        now: u64,
        to: SocketAddrV4,
        from: SocketAddrV4,
    ) -> Result<(u32, SocketAddrV4), Cause> {
        let (interface, own) = match self.owners.get(to.ip()).ok_or(Cause::Unreachable)? {
            Owner::Nat(nat) => {
                let inner = self.nats[nat.0].inbound(now, to.port(), from).ok_or(Cause::Nat)?;
                match self.owners.get(inner.ip()) {
                    Some(Owner::Interface(interface)) => (*interface, inner),
                    _ => return Err(Cause::Unreachable),
                }
            }
            Owner::Interface(interface) => {
                let behind = self.interfaces[*interface as usize].nat;
                // A private address is unreachable from outside its NAT.
                let inside = match self.owners.get(from.ip()) {
                    Some(Owner::Interface(sender)) => self.interfaces[*sender as usize].nat,
                    _ => None,
                };
                if behind.is_some() && behind != inside {
                    return Err(Cause::Unreachable);
                }
                (*interface, to)
            }
        };
        Ok((interface, own))
    }

    /// Returns the link from one interface to another, created at its first packet.
    pub(super) fn link(&mut self, from: u32, to: u32) -> u32 {
        let row = &mut self.rows[from as usize];
        if row.len() <= to as usize {
            row.resize(to as usize + 1, NO_LINK);
        }
        let link = &mut row[to as usize];
        if *link == NO_LINK {
            *link = self.links.len() as u32;
            self.links.push(Link::new(stream(self.seed, Stream::Link { from, to })));
        }
        *link
    }
}

fn v4(address: SocketAddr) -> Option<SocketAddrV4> {
    match address.ip().to_canonical() {
        IpAddr::V4(ip) => Some(SocketAddrV4::new(ip, address.port())),
        IpAddr::V6(_) => None,
    }
}
