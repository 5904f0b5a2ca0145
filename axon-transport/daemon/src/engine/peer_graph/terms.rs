//! The terms of a GRAPH message about the endpoints that it adds.

use std::collections::BTreeSet;

use axon_shm::ids::Gid;
use axon_transport::{config::DiscoveryRange, internal::graph::RangeToHost};

/// The endpoints of a GRAPH message for which it has terms.
pub(super) struct GraphTerms {
    localhost: BTreeSet<Gid>,
    listing: BTreeSet<Gid>,
    denied: BTreeSet<Gid>,
}

impl GraphTerms {
    /// Creates the terms from the fields of a message: endpoints with the range LOCALHOST, endpoints of sessions that
    /// list this host as a static peer, and endpoints whose other end the peer's access rules deny this host.
    pub(super) fn new(fields: [Option<Vec<Gid>>; 3]) -> Self {
        let [localhost, listing, denied] =
            fields.map(|gids| gids.unwrap_or_default().into_iter().collect());
        Self { localhost, listing, denied }
    }

    /// Returns the range of an endpoint towards this host.
    pub(super) fn toward(&self, gid: &Gid) -> RangeToHost {
        let near = self.localhost.contains(gid);
        let range = if near { DiscoveryRange::Localhost } else { DiscoveryRange::Subnet };
        RangeToHost { range, lists: self.listing.contains(gid) }
    }

    /// Returns whether access rules of the peer deny this host the other end of an endpoint.
    pub(super) fn denies(&self, gid: &Gid) -> bool {
        self.denied.contains(gid)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_without_terms_has_subnet_range_and_no_denial() {
        let gids = [1, 2, 3].map(|number| Gid([number; 16]));
        let terms = GraphTerms::new([Some(vec![gids[0]]), Some(vec![gids[0], gids[1]]), None]);
        let toward = gids.map(|gid| terms.toward(&gid));
        assert_eq!(toward.map(|to| to.lists), [true, true, false]);
        let (near, subnet) = (DiscoveryRange::Localhost, DiscoveryRange::Subnet);
        assert_eq!(toward.map(|to| to.range), [near, subnet, subnet]);
        assert!(!gids.iter().any(|gid| terms.denies(gid)));
        let terms = GraphTerms::new([None, None, Some(vec![gids[2]])]);
        assert_eq!(gids.map(|gid| terms.denies(&gid)), [false, false, true]);
    }
}
