//! The endpoints of this host as a peer is told of them.

use axon_shm::ids::Gid;
use axon_transport::{config::DiscoveryRange, graph::Endpoint, internal::graph::RemoteEndpoint};

use crate::link::Graph;

/// An endpoint of this host that a peer is shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Told {
    /// The endpoint, and its range towards the peer.
    pub(super) remote: RemoteEndpoint,
    /// Access rules deny the peer the other end.
    pub(super) denied: bool,
}

/// A GRAPH that adds these. Its versions and what it removes are the caller's.
pub(super) fn added(part: &[&Told]) -> Graph {
    let named = |is: fn(&Told) -> bool| {
        let gids = part.iter().filter(|told| is(told)).map(|told| told.remote.endpoint.gid);
        Some(gids.collect::<Vec<Gid>>()).filter(|gids| !gids.is_empty())
    };
    Graph {
        localhost: named(|told| told.remote.toward.range != DiscoveryRange::Subnet),
        listing: named(|told| told.remote.toward.lists),
        denied: named(|told| told.denied),
        added: part.iter().map(|told| Endpoint::clone(&told.remote.endpoint)).collect(),
        ..Graph::default()
    }
}
