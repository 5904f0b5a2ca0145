//! Discovery of a simulated host, without beacons: where its peers are, how its links with them do, and when it dials
//! them.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    net::SocketAddr,
    time::Duration,
};

use axon_shm::ids::DaemonId;

use crate::{bridge::ToGateway, discovery::AddressConfidence};

/// Delay of the dial by the daemon of the higher id.
const SECOND_DIAL: Duration = Duration::from_millis(300);
/// Time between a failed dial, or the end of a link, and the next dial. The daemon of the higher id waits twice as long.
const REDIAL: Duration = Duration::from_millis(250);
/// A dial has come to an end after this time.
const LONGEST_DIAL: Duration = Duration::from_secs(60);

/// The peers of one host.
#[derive(Default)]
pub(super) struct SimDiscovery {
    /// The host's own daemon.
    daemon: DaemonId,
    peers: BTreeMap<DaemonId, Peer>,
    links: BTreeMap<DaemonId, Linked>,
    /// All addresses of peers that have several.
    addresses: BTreeMap<DaemonId, Vec<SocketAddr>>,
    /// Orders for the gateway.
    orders: Vec<ToGateway>,
    /// When dials began.
    dialled: VecDeque<Duration>,
}

/// A peer to be linked with.
struct Peer {
    address: SocketAddr,
    sae: Option<String>,
    dial_at: Option<Duration>,
}

/// A link that stands.
struct Linked {
    address: SocketAddr,
    /// Whether the path of its link is cut.
    cut: bool,
}

impl SimDiscovery {
    /// Handles the start of the host's daemon: dials all peers.
    pub(super) fn start(&mut self, daemon: DaemonId, now: Duration) {
        self.daemon = daemon;
        self.links.clear();
        self.orders.clear();
        self.peers.values_mut().for_each(|peer| peer.dial_at = Some(now));
    }

    /// Handles the death of the host's daemon.
    pub(super) fn kill(&mut self) {
        self.links.clear();
    }

    /// Returns the linked peers.
    pub(super) fn linked(&self) -> BTreeSet<DaemonId> {
        self.links.keys().copied().collect()
    }

    /// Adds a peer to link with. The lower id dials first.
    pub(super) fn want(
        &mut self,
        daemon: DaemonId,
        address: SocketAddr,
        sae: Option<String>,
        now: Duration,
    ) {
        let wait = if self.daemon < daemon { Duration::ZERO } else { SECOND_DIAL };
        self.peers.insert(daemon, Peer { address, sae, dial_at: Some(now + wait) });
    }

    /// Forgets a peer that is gone.
    pub(super) fn unwant(&mut self, daemon: DaemonId) {
        self.peers.remove(&daemon);
    }

    /// Beacons came from these addresses of a peer.
    pub(super) fn hear_addresses(&mut self, daemon: DaemonId, addresses: Vec<SocketAddr>) {
        if self.links.contains_key(&daemon) {
            self.orders.push(ToGateway::Addresses { daemon, addresses: addresses.clone() });
        }
        self.addresses.insert(daemon, addresses);
    }

    /// Sets a new address of a peer.
    pub(super) fn set_address(&mut self, daemon: DaemonId, address: SocketAddr) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        peer.address = address;
        if self.links.get(&daemon).is_some_and(|link| link.cut) {
            peer.dial_at = Some(Duration::ZERO);
        }
    }

    /// Records a link at this address.
    pub(super) fn handle_link_up(&mut self, daemon: DaemonId, address: SocketAddr) {
        self.links.insert(daemon, Linked { address, cut: false });
        if let Some(addresses) = self.addresses.get(&daemon).cloned() {
            self.orders.push(ToGateway::Addresses { daemon, addresses });
        }
    }

    /// Records whether the path of a link works.
    pub(super) fn handle_path(&mut self, now: Duration, daemon: DaemonId, works: bool) {
        let Some(link) = self.links.get_mut(&daemon) else { return };
        link.cut = !works;
        if link.cut {
            self.handle_dial_failed(now, daemon);
        }
    }

    /// Handles the end of the link with a peer.
    pub(super) fn handle_link_down(&mut self, now: Duration, daemon: DaemonId) {
        self.links.remove(&daemon);
        self.handle_dial_failed(now, daemon);
    }

    /// Handles a failed dial.
    pub(super) fn handle_dial_failed(&mut self, now: Duration, daemon: DaemonId) {
        if let Some(peer) = self.peers.get_mut(&daemon) {
            let wait = if self.daemon < daemon { REDIAL } else { 2 * REDIAL };
            peer.dial_at = Some(now + wait);
        }
    }

    /// Returns when a dial is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let ordered = (!self.orders.is_empty()).then_some(Duration::ZERO);
        self.looked_for().filter_map(|(_, peer)| peer.dial_at).chain(ordered).min()
    }

    /// Takes the dials that are due, and other orders.
    pub(super) fn take_due(&mut self, now: Duration) -> Vec<ToGateway> {
        let due = self.looked_for().filter(|(_, peer)| peer.dial_at.is_some_and(|at| at <= now));
        let due: Vec<_> = due.map(|(daemon, _)| *daemon).collect();
        let dials = due.into_iter().filter_map(|daemon| {
            let peer = self.peers.get_mut(&daemon)?;
            peer.dial_at = None;
            self.dialled.push_back(now);
            let (addresses, sae) = (vec![peer.address], peer.sae.clone());
            let standing = AddressConfidence::Heard;
            Some(ToGateway::Dial { daemon, sae, addresses, listed: false, standing })
        });
        let dials: Vec<_> = dials.collect();
        self.orders.drain(..).chain(dials).collect()
    }

    /// Returns the maximum number of dials that may be under way, including dials of successors.
    pub(super) fn most_dials(&mut self, now: Duration) -> usize {
        self.dialled.retain(|at| *at + LONGEST_DIAL >= now);
        // A silent link dials a successor again after 1, 2, 4 and 8 s, even if the dial before failed.
        self.dialled.len() + 5 * self.peers.len()
    }

    /// Returns the peers without a link, and those whose link has a path that does not work and whose address is
    /// another.
    fn looked_for(&self) -> impl Iterator<Item = (&DaemonId, &Peer)> {
        self.peers.iter().filter(|(daemon, peer)| match self.links.get(daemon) {
            Some(link) => link.cut && link.address != peer.address,
            None => true,
        })
    }
}
