//! The limits on traffic between this host and a peer, by route.

use std::rc::Rc;

use axon_envelope::Kind;
use axon_transport::{
    access::{Permissions, Verb},
    config::Config,
};

use crate::engine::route::RouteKey;
use crate::engine::{account::Account, limits::Limit};

/// The limits that the access rules set for a peer.
pub(in crate::engine::peer) struct PeerLimits<'a> {
    /// The state of the limits, for all daemons of the peer's identity.
    pub(in crate::engine::peer) account: &'a Account,
    /// The rules about the peer.
    pub(in crate::engine::peer) permissions: &'a Permissions,
    /// The settings of this host.
    pub(in crate::engine::peer) config: &'a Config,
}

impl PeerLimits<'_> {
    /// Returns the limits on the samples that the peer gets on a route that it asked for. Responses, and requests to
    /// the peer, are not limited.
    pub(in crate::engine::peer) fn outgoing(&self, key: &RouteKey) -> Vec<Rc<Limit>> {
        match key.kind {
            Kind::Topic => self.of(Verb::Subscribe, key),
            Kind::Request | Kind::Response => Vec::new(),
        }
    }

    /// Returns the limits on the messages that the peer sends here on a route that this host asked for.
    pub(in crate::engine::peer) fn incoming(&self, key: &RouteKey) -> Vec<Rc<Limit>> {
        match key.kind {
            Kind::Topic => self.of(Verb::Publish, key),
            Kind::Request => self.of(Verb::Call, key),
            Kind::Response => Vec::new(),
        }
    }

    fn of(&self, verb: Verb, key: &RouteKey) -> Vec<Rc<Limit>> {
        self.account.limits.of(verb, &key.topic, self.permissions, self.config)
    }
}
