//! The graph of this host as one peer sees it: live endpoints that the peer may see, and ended publishers whose samples
//! have not all arrived there.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    config::DiscoveryRange, graph::EndpointKind, internal::graph::RemoteEndpoint,
};

use super::{access::PeerAccess, context::LocalEndpoints, control_queue::ControlQueue};
use crate::{
    engine::peer_graph::{
        advertised::{AdvertisedEndpoint, AdvertisedGraph},
        owners::Prover,
    },
    owner::ChannelBinding,
};

/// The graph of this host as one peer sees it.
pub(super) struct LocalGraph {
    peer: DaemonId,
    /// The graph that was sent to the peer.
    shown: AdvertisedGraph,
    /// Proves to the peer that sessions belong to this host.
    prover: Prover,
    /// Ended publishers of this host whose samples have not all arrived. The peer sees them until then.
    ending: BTreeMap<Gid, RemoteEndpoint>,
}

/// The inputs that decide which endpoints of this host a peer may see.
pub(super) struct Visibility<'a> {
    /// The endpoints of this host.
    pub(super) local: &'a LocalEndpoints,
    /// True if a session of the peer lists this host.
    pub(super) listed: bool,
    /// The peer's rights on this host.
    pub(super) access: &'a mut PeerAccess,
}

impl LocalGraph {
    /// Creates the graph of a peer that was shown nothing.
    pub(super) fn new(peer: DaemonId, prover: Prover) -> Self {
        Self { peer, shown: AdvertisedGraph::default(), prover, ending: BTreeMap::new() }
    }

    /// Moves to a new link: repeats the proofs that were sent over the link before.
    pub(super) fn succeed(
        &mut self,
        binding: Option<ChannelBinding>,
        by: Visibility<'_>,
        messages: &mut ControlQueue,
    ) {
        self.prover.succeed(binding);
        let visible = self.visible(by);
        self.prove(&visible, messages);
    }

    /// Sends the peer the changes of the graph, or the whole graph.
    pub(super) fn send(&mut self, by: Visibility<'_>, whole: bool, messages: &mut ControlQueue) {
        let Visibility { local, listed, access } = by;
        let visible = self.visible(Visibility { local, listed, access });
        self.prove(&visible, messages);
        let mut told = |remote: RemoteEndpoint| {
            let denied = !access.judge(&remote.endpoint).usable;
            AdvertisedEndpoint { remote, denied }
        };
        let now: BTreeMap<_, _> = visible.into_iter().map(|(gid, e)| (gid, told(e))).collect();
        access.retain_rights(|gid| local.contains_key(gid) || self.ending.contains_key(gid));
        self.shown.tell(now, whole).into_iter().for_each(|message| messages.say(message));
    }

    /// Sends the whole graph, which the peer asked for, unless it asked too early.
    pub(super) fn resync(
        &mut self,
        by: Visibility<'_>,
        now: Duration,
        messages: &mut ControlQueue,
    ) {
        if self.shown.handle_resync(now) {
            self.prover.forget();
            self.send(by, true, messages);
        }
    }

    /// Returns whether the peer still has to get the whole graph.
    pub(super) fn owes_resync(&self) -> bool {
        self.shown.owes_resync()
    }

    /// Returns when the peer gets the whole graph for which it asked too early.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.shown.poll_timeout()
    }

    /// Returns the publishers that the peer is shown, have ended, and are not kept yet.
    pub(super) fn ended_publishers<'a>(
        &'a self,
        local: &'a LocalEndpoints,
    ) -> impl Iterator<Item = (&'a Gid, &'a RemoteEndpoint)> {
        let ended = self.shown.iter().filter(|(gid, shown)| {
            shown.remote.endpoint.kind == EndpointKind::Publisher
                && !local.contains_key(gid)
                && !self.ending.contains_key(gid)
        });
        ended.map(|(gid, shown)| (gid, &shown.remote))
    }

    /// Keeps an ended publisher in the graph until its samples have arrived.
    pub(super) fn keep(&mut self, gid: Gid, publisher: RemoteEndpoint) {
        self.ending.insert(gid, publisher);
    }

    /// Removes an ended publisher whose samples have arrived. Returns whether it was kept.
    pub(super) fn remove_ended(&mut self, gid: &Gid) -> bool {
        self.ending.remove(gid).is_some()
    }

    /// Removes the ended publishers that new access rules hide from the peer.
    pub(super) fn handle_permissions(&mut self, access: &mut PeerAccess) {
        self.ending.retain(|_, publisher| access.judge(&publisher.endpoint).shown);
    }

    /// Returns whether ended publishers are kept.
    pub(super) fn is_draining(&self) -> bool {
        !self.ending.is_empty()
    }

    fn visible(&self, by: Visibility<'_>) -> BTreeMap<Gid, RemoteEndpoint> {
        let in_range = by.local.iter().filter_map(|(gid, (endpoint, reach))| {
            let toward = reach.toward(self.peer);
            let shown = match toward.range {
                DiscoveryRange::Off => false,
                DiscoveryRange::Localhost => toward.lists || by.listed,
                DiscoveryRange::Subnet => true,
            };
            shown.then(|| (*gid, RemoteEndpoint { endpoint: Arc::clone(endpoint), toward }))
        });
        let live = in_range.filter(|(_, remote)| by.access.judge(&remote.endpoint).shown);
        let mut visible = self.ending.clone();
        visible.extend(live);
        visible
    }

    fn prove(&mut self, visible: &BTreeMap<Gid, RemoteEndpoint>, messages: &mut ControlQueue) {
        self.prover.owed(visible.keys()).into_iter().for_each(|proofs| messages.say(proofs));
    }
}
