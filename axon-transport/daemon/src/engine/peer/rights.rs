//! The rights of a peer on the endpoints of this host by the access rules, evaluated once for each endpoint.

use std::{collections::HashMap, sync::Arc};

use axon_shm::ids::Gid;
use axon_transport::{
    access::Permissions,
    graph::Endpoint,
    internal::graph::{permits_use, shows},
};

use crate::engine::peer_graph::decisions::note_look;

/// The rights of a peer on an endpoint of this host.
#[derive(Clone, Copy)]
pub(super) struct EndpointRights {
    /// True if the peer is shown the endpoint.
    pub(super) shown: bool,
    /// True if the peer may be at the other end of the endpoint.
    pub(super) usable: bool,
}

/// The rights of a peer on the endpoints of this host that were evaluated.
#[derive(Default)]
pub(super) struct RightsByEndpoint(HashMap<Gid, (Arc<Endpoint>, EndpointRights)>);

impl RightsByEndpoint {
    /// Returns the peer's rights on an endpoint. The rules are evaluated only if the endpoint is new or changed.
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

    /// Discards all rights, because the rules changed: each endpoint is evaluated again.
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
    fn endpoint_is_judged_once_for_each_change_of_it_or_of_the_rules() {
        let closed = rules("[[deny]]\npeer = \"*\"\nsubscribe = \"/closed\"");
        let mut judged = RightsByEndpoint::default();
        let mut judge = |rules: &Permissions, topic| {
            let before = looks_at_rules();
            let judgement = judged.judge(rules, &publisher(topic));
            (judgement.shown, judgement.usable, looks_at_rules() - before)
        };
        assert_eq!(judge(&closed, "/open"), (true, true, 1));
        assert_eq!(judge(&closed, "/open"), (true, true, 0));
        // The endpoint's session created another endpoint with the same GID.
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
