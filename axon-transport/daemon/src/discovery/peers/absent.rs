//! Forgets addresses at which an authenticated peer turned out to be another daemon, as after the restart of a daemon.
//!
//! Beacons prove nothing, so they only add addresses. Only the host at an address can take it from a daemon: by its
//! answer to a dial, or by a link. It takes no other address. A host in the middle could do it too, but could also
//! prevent the link.

use std::net::SocketAddr;

use axon_shm::ids::DaemonId;

use super::PeerDiscovery;

impl PeerDiscovery {
    /// Handles the answer of an authenticated peer at this address that it is another daemon, or that it ends. The
    /// daemon is dialled there again after its next beacon from there. Its other addresses stay.
    pub(crate) fn handle_absent(&mut self, daemon: DaemonId, address: SocketAddr) {
        let address = SocketAddr::new(address.ip().to_canonical(), address.port());
        if let Some(record) = self.records.get_mut(&daemon) {
            record.is_not_at(address);
        }
    }

    /// Handles a link of `daemon` at this address: no other daemon is there.
    pub(super) fn handle_found(&mut self, daemon: DaemonId, address: SocketAddr) {
        for (other, record) in &mut self.records {
            if *other != daemon {
                record.is_not_at(address);
            }
        }
    }

    /// Removes the address of a link that ended, if another daemon was linked there since.
    pub(super) fn forget_taken(&mut self, daemon: DaemonId) {
        let Some(since) = self.records.get(&daemon).map(|record| record.linked_at) else { return };
        let newer = self.records.values().filter(|r| r.linked && r.linked_at > since);
        let taken = newer.flat_map(|record| record.sources.iter().filter(|source| source.proven));
        let taken: Vec<_> = taken.map(|source| source.address).collect();
        if let Some(record) = self.records.get_mut(&daemon) {
            taken.into_iter().for_each(|address| record.is_not_at(address));
        }
    }
}
