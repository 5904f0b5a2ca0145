//! The endpoints of this host as they are sent to a peer.

use std::{collections::BTreeMap, time::Duration};

use axon_shm::ids::Gid;
use axon_transport::{config::DiscoveryRange, graph::Endpoint, internal::graph::RemoteEndpoint};

use crate::link::{GraphUpdate, LinkMessage};

/// Maximum number of endpoints in one message of a graph.
const GRAPH_PART: usize = 512;
/// Minimum time between two whole graphs.
const RESYNC: Duration = Duration::from_secs(1);

/// An endpoint of this host that is shown to a peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::engine) struct AdvertisedEndpoint {
    /// The endpoint, and its range towards the peer.
    pub(in crate::engine) remote: RemoteEndpoint,
    /// True if access rules deny the peer the other end.
    pub(in crate::engine) denied: bool,
}

/// The part of this host's graph that was sent to a peer.
#[derive(Default)]
pub(in crate::engine) struct AdvertisedGraph {
    endpoints: BTreeMap<Gid, AdvertisedEndpoint>,
    version: u64,
    /// The last time at which the peer got the whole graph because it asked for it.
    resynced: Option<Duration>,
    /// True if it asked again too early.
    resync_due: bool,
}

impl AdvertisedGraph {
    /// Returns the endpoints that the peer knows.
    pub(in crate::engine) fn iter(&self) -> impl Iterator<Item = (&Gid, &AdvertisedEndpoint)> {
        self.endpoints.iter()
    }

    /// Handles the peer's request for the whole graph, or an earlier one that came too early. Returns whether the peer
    /// gets the graph now.
    pub(in crate::engine) fn handle_resync(&mut self, now: Duration) -> bool {
        let recent = |sent| now.saturating_sub(sent) < RESYNC;
        self.resync_due = self.resynced.is_some_and(recent);
        if !self.resync_due {
            self.resynced = Some(now);
        }
        !self.resync_due
    }

    /// Returns whether the peer still has to get the whole graph.
    pub(in crate::engine) fn owes_resync(&self) -> bool {
        self.resync_due
    }

    /// Returns when the peer gets the whole graph for which it asked too early.
    pub(in crate::engine) fn poll_timeout(&self) -> Option<Duration> {
        self.resync_due.then(|| self.resynced.unwrap_or_default() + RESYNC)
    }

    /// Sets the endpoints that the peer may see now. Returns the messages with the changes, or with all endpoints for
    /// the `whole` graph.
    pub(in crate::engine) fn tell(
        &mut self,
        now: BTreeMap<Gid, AdvertisedEndpoint>,
        whole: bool,
    ) -> Vec<LinkMessage> {
        let before = if whole { BTreeMap::new() } else { std::mem::take(&mut self.endpoints) };
        let new: Vec<_> = now
            .iter()
            .filter(|(gid, told)| before.get(gid) != Some(told))
            .map(|(_, e)| e)
            .collect();
        let removed: Vec<_> = before.keys().filter(|gid| !now.contains_key(gid)).copied().collect();
        let mut messages = Vec::new();
        if whole || !new.is_empty() || !removed.is_empty() {
            let mut before = if whole { 0 } else { self.version };
            let mut removed = Some(removed);
            let mut parts: Vec<&[_]> = new.chunks(GRAPH_PART).collect();
            if parts.is_empty() {
                parts.push(&[]);
            }
            let last = parts.len() - 1;
            for (index, part) in parts.into_iter().enumerate() {
                self.version += 1;
                messages.push(LinkMessage::Graph(GraphUpdate {
                    version: self.version,
                    before,
                    removed: removed.take().unwrap_or_default(),
                    more: index < last,
                    ..added(part)
                }));
                before = self.version;
            }
        }
        self.endpoints = now;
        messages
    }
}

/// Creates a GRAPH that adds these endpoints. The caller sets its versions and the removed endpoints.
fn added(part: &[&AdvertisedEndpoint]) -> GraphUpdate {
    let named = |is: fn(&AdvertisedEndpoint) -> bool| {
        let gids = part.iter().filter(|told| is(told)).map(|told| told.remote.endpoint.gid);
        Some(gids.collect::<Vec<Gid>>()).filter(|gids| !gids.is_empty())
    };
    GraphUpdate {
        localhost: named(|told| told.remote.toward.range != DiscoveryRange::Subnet),
        listing: named(|told| told.remote.toward.lists),
        denied: named(|told| told.denied),
        added: part.iter().map(|told| Endpoint::clone(&told.remote.endpoint)).collect(),
        ..GraphUpdate::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axon_transport::graph::EndpointKind;

    /// Creates endpoints with these numbers; those from 1000 on are denied.
    fn endpoints(numbers: impl IntoIterator<Item = u32>) -> BTreeMap<Gid, AdvertisedEndpoint> {
        let of = |number: u32| {
            let gid = Gid((u128::from(number % 1000)).to_be_bytes());
            let remote = Endpoint::new(gid, EndpointKind::Publisher, "/t", "T").into();
            (gid, AdvertisedEndpoint { remote, denied: number >= 1000 })
        };
        numbers.into_iter().map(of).collect()
    }

    /// Returns the version, the previous version, the numbers of added and removed endpoints, and whether more follows.
    fn said(messages: Vec<LinkMessage>) -> Vec<(u64, u64, usize, usize, bool)> {
        let of = |message| match message {
            LinkMessage::Graph(g) => (g.version, g.before, g.added.len(), g.removed.len(), g.more),
            other => panic!("{other:?}"),
        };
        messages.into_iter().map(of).collect()
    }

    #[test]
    fn a_peer_is_sent_each_graph_change_once() {
        let mut told = AdvertisedGraph::default();
        assert_eq!(said(told.tell(endpoints(1..4), false)), [(1, 0, 3, 0, false)]);
        assert!(told.tell(endpoints(1..4), false).is_empty());
        assert_eq!(said(told.tell(endpoints([2, 3, 4, 5]), false)), [(2, 1, 2, 1, false)]);
        assert_eq!(said(told.tell(endpoints([1002, 3, 4, 5]), false)), [(3, 2, 1, 0, false)]);
        assert_eq!(said(told.tell(endpoints([]), false)), [(4, 3, 0, 4, false)]);
    }

    #[test]
    fn a_whole_graph_begins_at_version_0_and_is_sent_if_it_is_empty() {
        let mut told = AdvertisedGraph::default();
        told.tell(endpoints(1..4), false);
        assert_eq!(said(told.tell(endpoints(2..4), true)), [(2, 0, 2, 0, false)]);
        assert_eq!(said(told.tell(endpoints([]), true)), [(3, 0, 0, 0, false)]);
        let parts = said(told.tell(endpoints(0..999), true));
        assert_eq!(parts, [(4, 0, 512, 0, true), (5, 4, 487, 0, false)]);
    }

    #[test]
    fn a_peer_that_asks_again_and_again_gets_the_whole_graph_once_a_second() {
        let mut told = AdvertisedGraph::default();
        let at = Duration::from_millis;
        assert!(told.handle_resync(at(100)) && !told.owes_resync());
        assert!(!told.handle_resync(at(200)) && !told.handle_resync(at(1099)));
        assert_eq!((told.poll_timeout(), told.owes_resync()), (Some(at(1100)), true));
        assert!(told.handle_resync(at(1100)));
        assert_eq!((told.poll_timeout(), told.owes_resync()), (None, false));
    }
}
