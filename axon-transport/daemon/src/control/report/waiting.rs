//! The endpoints of this host that wait for routes which another host, or this one, refuses. The status shows them, and
//! their sessions are notified.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::Arc,
};

use axon_shm::{
    ids::{Gid, SessionId},
    internal::descriptors::PassedFd,
};
use axon_transport::internal::{
    registry::{LocalEndpoint, Registry},
    wire::session::{EndpointRole, SessionMessage, SessionRefused},
};

use crate::bridge::RefusedRoute;

/// Maximum number of endpoints that are notified of one peer's routes while it is linked.
const MAX_WAITING_ENDPOINTS: usize = 4096;

type DaemonRegistry = Registry<Arc<PassedFd>>;

/// Returns each endpoint that waits for one of the routes, with the route.
pub(super) fn waiting<'a, 'r>(
    registry: &'a DaemonRegistry,
    routes: &'r [RefusedRoute],
) -> Vec<(&'a LocalEndpoint, &'r RefusedRoute)> {
    if routes.is_empty() {
        return Vec::new();
    }
    let mut by_topic: HashMap<_, Vec<&LocalEndpoint>> = HashMap::new();
    for local in registry.endpoints().filter(|e| e.role == EndpointRole::Application) {
        by_topic.entry((local.endpoint.kind, &*local.endpoint.topic)).or_default().push(local);
    }
    let mut all = Vec::new();
    for route in routes {
        let waiting = by_topic.get(&(route.waits, &*route.topic)).into_iter().flatten();
        let same = |local: &LocalEndpoint| {
            route.type_name.as_ref().is_none_or(|name| *name == local.endpoint.type_name)
        };
        all.extend(waiting.filter(|local| same(local)).map(|local| (*local, route)));
    }
    all
}

/// The endpoints whose sessions were notified, by peer. Each is notified once while the peer is linked.
#[derive(Debug, Default)]
pub(in crate::control) struct NotifiedEndpoints(BTreeMap<String, HashSet<Gid>>);

impl NotifiedEndpoints {
    /// Forgets a peer whose link is over.
    pub(in crate::control) fn forget(&mut self, peer: &str) {
        self.0.remove(peer);
    }

    /// Notifies the sessions of endpoints that wait for these routes to or from `peer`, which is the host `host`.
    pub(in crate::control) fn tell(
        &mut self,
        registry: &mut DaemonRegistry,
        peer: &str,
        host: &str,
        routes: &[RefusedRoute],
    ) {
        let untold = self.take_untold(registry, peer, host, routes);
        for (session, text) in untold {
            registry.push(
                &session,
                &SessionMessage::Refused(SessionRefused::because(text)),
                Vec::new(),
            );
        }
    }

    fn take_untold(
        &mut self,
        registry: &DaemonRegistry,
        peer: &str,
        host: &str,
        routes: &[RefusedRoute],
    ) -> Vec<(SessionId, String)> {
        let mut untold = Vec::new();
        // Other users must see neither hosts nor rules.
        let is_own = |local: &LocalEndpoint| {
            registry.session(&local.session).is_some_and(|session| session.user.is_none())
        };
        let all = waiting(registry, routes).into_iter();
        for (local, route) in all.filter(|(local, _)| is_own(local)) {
            let told = self.0.entry(peer.to_owned()).or_default();
            let gid = local.endpoint.gid;
            // The control plane is about to resend everything to such a session, which would not get this message; the
            // next report sends it.
            if told.len() == MAX_WAITING_ENDPOINTS
                || registry.is_told_anew(&local.session)
                || !told.insert(gid)
            {
                continue;
            }
            let text = format!(
                "endpoint {gid} of topic {:?}: nothing crosses to or from host {host:?}: {}",
                route.topic, route.reason
            );
            untold.push((local.session, text));
        }
        untold
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::{
        graph::{Endpoint, EndpointKind},
        internal::wire::session::{Announce, SessionRole},
    };

    use super::*;

    const SESSION: SessionId = SessionId([1; 16]);

    fn registry() -> DaemonRegistry {
        let mut registry = Registry::default();
        let (role, name) = (SessionRole::Application, String::new());
        registry.handle_connect(SESSION, role, name, 1, None, None).unwrap();
        registry
    }

    fn announce(registry: &mut DaemonRegistry, number: u32, topic: &str) {
        let gid = Gid::new(SESSION, number);
        let endpoint = Endpoint::new(gid, EndpointKind::Subscription, topic, "T");
        let role = EndpointRole::Application;
        let announce = Announce { endpoint, role, stands_for: vec![], ring: None, only: None };
        registry.handle_message(&SESSION, SessionMessage::Endpoint(announce), vec![]).unwrap();
    }

    /// Returns the messages that the session gets.
    fn heard(registry: &mut DaemonRegistry) -> Vec<String> {
        let packets = std::iter::from_fn(|| registry.poll_output(&SESSION));
        let texts =
            packets.filter_map(|output| match SessionMessage::decode(&output.packet).unwrap() {
                SessionMessage::Refused(refused) => {
                    assert_eq!(refused.endpoint, None, "it stays in the graph");
                    Some(refused.text)
                }
                _ => None,
            });
        texts.collect()
    }

    fn route(topic: &str, type_name: Option<&str>) -> RefusedRoute {
        let (topic, type_name) = (topic.to_owned(), type_name.map(str::to_owned));
        let reason = "refused by the peer: no room".to_owned();
        RefusedRoute { topic, type_name, waits: EndpointKind::Subscription, reason }
    }

    #[test]
    fn session_of_an_endpoint_that_waits_is_told_once_while_the_peer_is_linked() {
        let (mut registry, mut told) = (registry(), NotifiedEndpoints::default());
        announce(&mut registry, 1, "/a");
        announce(&mut registry, 2, "/b");
        let routes = [route("/a", Some("T")), route("/a", Some("other")), route("/c", None)];
        told.tell(&mut registry, "peer", "base", &routes);
        assert_eq!(heard(&mut registry), [""; 0], "it is told everything first");
        told.tell(&mut registry, "peer", "base", &routes);
        let texts = heard(&mut registry);
        assert_eq!(texts.len(), 1, "{texts:?}");
        for part in ["\"/a\"", "\"base\"", "refused by the peer: no room"] {
            assert!(texts[0].contains(part), "{texts:?}");
        }
        // The next report has it as well. An endpoint that came later is notified.
        announce(&mut registry, 3, "/a");
        told.tell(&mut registry, "peer", "base", &routes);
        let texts = heard(&mut registry);
        let gid = Gid::new(SESSION, 3).to_string();
        assert!(texts.len() == 1 && texts[0].contains(&gid), "{texts:?}");
        told.forget("peer");
        told.tell(&mut registry, "peer", "base", &routes);
        assert_eq!(heard(&mut registry).len(), 2);
        // Another user's session gets no message.
        told.forget("peer");
        registry.set_user(&SESSION, 7);
        told.tell(&mut registry, "peer", "base", &routes);
        assert_eq!(heard(&mut registry).len(), 0);
    }
}
