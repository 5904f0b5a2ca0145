//! Discovery of a simulated host, without beacons: where its peers are, how its links with them do, and when it dials
//! them.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    net::SocketAddr,
    time::Duration,
};

use axon_shm::ids::DaemonId;

use crate::{bridge::ToGateway, discovery::AddressConfidence};

/// The daemon of the higher id dials later by so much.
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
    /// Its path does not work.
    cut: bool,
}

impl SimDiscovery {
    /// The host's daemon starts: it dials all peers.
    pub(super) fn start(&mut self, daemon: DaemonId, now: Duration) {
        self.daemon = daemon;
        self.links.clear();
        self.orders.clear();
        self.peers.values_mut().for_each(|peer| peer.dial_at = Some(now));
    }

    /// The host's daemon is dead.
    pub(super) fn kill(&mut self) {
        self.links.clear();
    }

    /// The peers that are linked.
    pub(super) fn linked(&self) -> BTreeSet<DaemonId> {
        self.links.keys().copied().collect()
    }

    /// A peer is to be linked with. The lower id dials first.
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

    /// A peer has another address.
    pub(super) fn set_address(&mut self, daemon: DaemonId, address: SocketAddr) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        peer.address = address;
        if self.links.get(&daemon).is_some_and(|link| link.cut) {
            peer.dial_at = Some(Duration::ZERO);
        }
    }

    /// A link stands there.
    pub(super) fn handle_link_up(&mut self, daemon: DaemonId, address: SocketAddr) {
        self.links.insert(daemon, Linked { address, cut: false });
        if let Some(addresses) = self.addresses.get(&daemon).cloned() {
            self.orders.push(ToGateway::Addresses { daemon, addresses });
        }
    }

    /// The path of a link works, or does not.
    pub(super) fn handle_path(&mut self, now: Duration, daemon: DaemonId, works: bool) {
        let Some(link) = self.links.get_mut(&daemon) else { return };
        link.cut = !works;
        if link.cut {
            self.handle_dial_failed(now, daemon);
        }
    }

    /// The link with a peer is no more.
    pub(super) fn handle_link_down(&mut self, now: Duration, daemon: DaemonId) {
        self.links.remove(&daemon);
        self.handle_dial_failed(now, daemon);
    }

    /// A dial came to nothing.
    pub(super) fn handle_dial_failed(&mut self, now: Duration, daemon: DaemonId) {
        if let Some(peer) = self.peers.get_mut(&daemon) {
            let wait = if self.daemon < daemon { REDIAL } else { 2 * REDIAL };
            peer.dial_at = Some(now + wait);
        }
    }

    /// When a dial is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let ordered = (!self.orders.is_empty()).then_some(Duration::ZERO);
        self.looked_for().filter_map(|(_, peer)| peer.dial_at).chain(ordered).min()
    }

    /// The dials that are due, and other orders.
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

    /// Dials that may be under way, those of successors included.
    pub(super) fn most_dials(&mut self, now: Duration) -> usize {
        self.dialled.retain(|at| *at + LONGEST_DIAL >= now);
        // A silent link dials a successor again after 1, 2, 4 and 8 s, whatever became of the one before.
        self.dialled.len() + 5 * self.peers.len()
    }

    /// Peers that are not linked, or elsewhere than at the end of a path that does not work.
    fn looked_for(&self) -> impl Iterator<Item = (&DaemonId, &Peer)> {
        self.peers.iter().filter(|(daemon, peer)| match self.links.get(daemon) {
            Some(link) => link.cut && link.address != peer.address,
            None => true,
        })
    }
}
