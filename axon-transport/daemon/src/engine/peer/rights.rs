//! What access rules let a peer see and use of the endpoints of this host, decided once for each of them.

use std::{collections::HashMap, sync::Arc};

use axon_shm::ids::Gid;
use axon_transport::{
    access::Permissions,
    graph::Endpoint,
    internal::graph::{permits_use, shows},
};

use crate::engine::peer_graph::decisions::note_look;

/// What rules say of an endpoint of this host.
#[derive(Clone, Copy)]
pub(super) struct EndpointRights {
    /// The peer is shown it.
    pub(super) shown: bool,
    /// The peer may be at its other end.
    pub(super) usable: bool,
}

/// The endpoints of this host that rules about the peer were asked about.
#[derive(Default)]
pub(super) struct RightsByEndpoint(HashMap<Gid, (Arc<Endpoint>, EndpointRights)>);

impl RightsByEndpoint {
    /// What the rules say. They are asked about an endpoint that is new, or is not what it was.
    pub(super) fn judge(
        &mut self,
        rules: &Permissions,
        endpoint: &Arc<Endpoint>,
    ) -> EndpointRights {
        if rules.are_unrestricted() {
            return EndpointRights { shown: true, usable: true };
        }
        if let Some((known, judgement)) = self.0.get(&endpoint.gid)
            && (Arc::ptr_eq(known, endpoint) || known == endpoint)
        {
            return *judgement;
        }
        note_look();
        let judgement =
            EndpointRights { shown: shows(rules, endpoint), usable: permits_use(rules, endpoint) };
        self.0.insert(endpoint.gid, (Arc::clone(endpoint), judgement));
        judgement
    }

    /// The rules changed: each endpoint is judged anew.
    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// Forgets endpoints that are gone.
    pub(super) fn retain(&mut self, stands: impl Fn(&Gid) -> bool) {
        self.0.retain(|gid, _| stands(gid));
    }
}

#[cfg(test)]
mod tests {
    use axon_transport::{
        access::{AccessRules, Principal},
        graph::EndpointKind,
    };

    use super::*;
    use crate::engine::peer_graph::decisions::looks_at_rules;

    fn rules(text: &str) -> Permissions {
        let rules = AccessRules::parse(text, "access.toml").unwrap();
        rules.permissions(Principal::Address("10.0.0.1".parse().unwrap()))
    }

    fn publisher(topic: &str) -> Arc<Endpoint> {
        Arc::new(Endpoint::new(Gid::default(), EndpointKind::Publisher, topic, "T"))
    }

    #[test]
    fn an_endpoint_is_judged_once_until_it_or_the_rules_change_or_it_is_gone() {
        let closed = rules("[[deny]]\npeer = \"*\"\nsubscribe = \"/closed\"");
        let mut judged = RightsByEndpoint::default();
        let mut judge = |rules: &Permissions, topic| {
            let before = looks_at_rules();
            let judgement = judged.judge(rules, &publisher(topic));
            (judgement.shown, judgement.usable, looks_at_rules() - before)
        };
        assert_eq!(judge(&closed, "/open"), (true, true, 1));
        assert_eq!(judge(&closed, "/open"), (true, true, 0));
        // Its session made another endpoint of the same GID.
        assert_eq!(judge(&closed, "/closed"), (true, false, 1));
        assert_eq!(judge(&closed, "/closed"), (true, false, 0));
        judged.clear();
        let hidden = rules("[[deny]]\npeer = \"*\"\nsee = \"/closed\"");
        let judgement = judged.judge(&hidden, &publisher("/closed"));
        assert!(!judgement.shown && !judgement.usable);
        judged.retain(|_| false);
        assert!(judged.0.is_empty());
    }

    #[test]
    fn nothing_is_remembered_where_there_are_no_rules() {
        let mut judged = RightsByEndpoint::default();
        let none = AccessRules::default().permissions(Principal::Name("base"));
        let judgement = judged.judge(&none, &publisher("/t"));
        assert!(judgement.shown && judgement.usable && judged.0.is_empty());
    }
}
