//! The limits on what crosses between this host and a peer, by route.

use std::rc::Rc;

use axon_envelope::Kind;
use axon_transport::{access::Verb, config::Config};

use super::{Peer, routes::RouteKey};
use crate::engine::limits::Limit;

impl Peer {
    /// The limits on what the peer gets of a route that it asked for. No response is limited, and no request to it.
    pub(super) fn outgoing_limits(&self, key: &RouteKey, config: &Config) -> Vec<Rc<Limit>> {
        match key.kind {
            Kind::Topic => self.limits(Verb::Subscribe, key, config),
            Kind::Request | Kind::Response => Vec::new(),
        }
    }

    /// The limits on what the peer sends here on a route that this host asked for.
    pub(super) fn incoming_limits(&self, key: &RouteKey, config: &Config) -> Vec<Rc<Limit>> {
        match key.kind {
            Kind::Topic => self.limits(Verb::Publish, key, config),
            Kind::Request => self.limits(Verb::Call, key, config),
            Kind::Response => Vec::new(),
        }
    }

    fn limits(&self, verb: Verb, key: &RouteKey, config: &Config) -> Vec<Rc<Limit>> {
        let permissions = self.access.permissions();
        self.remote.account().limits.of(verb, &key.topic, permissions, config)
    }

    /// The rules changed: the routes that stand have the limits that they set now.
    pub(super) fn renew_limits(&mut self, config: &Config) {
        let served = self.served.iter();
        let outgoing = served.map(|(number, of)| (number, self.outgoing_limits(&of.key, config)));
        for (number, limits) in outgoing.collect::<Vec<_>>() {
            self.outbound.set_limits(number, limits);
        }
        let asked = self.asked.iter();
        let incoming = asked.map(|(key, of)| (of.number, self.incoming_limits(key, config)));
        for (number, limits) in incoming.collect::<Vec<_>>() {
            if let Some(route) = self.inbound.routes().get_mut(&number) {
                route.limit.set(limits);
            }
        }
        self.inbound.handle_limits();
    }
}
