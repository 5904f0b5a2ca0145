//! Access rules for endpoints. The gateway checks endpoints of other hosts, the registry those of other users.

use super::{Endpoint, EndpointKind};
use crate::access::{Permissions, Verb};

/// Returns the action of an endpoint's owner on its topic or service, or `None` for a node.
pub fn verb_of(kind: EndpointKind) -> Option<Verb> {
    Some(match kind {
        EndpointKind::Publisher => Verb::Publish,
        EndpointKind::Subscription => Verb::Subscribe,
        EndpointKind::Server => Verb::Serve,
        EndpointKind::Client => Verb::Call,
        EndpointKind::Node => return None,
    })
}

/// Returns the action of the endpoint's owner on the other side of a pair.
pub fn other_end(verb: Verb) -> Verb {
    match verb {
        Verb::Publish => Verb::Subscribe,
        Verb::Subscribe => Verb::Publish,
        Verb::Serve => Verb::Call,
        Verb::Call => Verb::Serve,
        Verb::See => Verb::See,
    }
}

/// Returns whether a party may have this endpoint. It may have a node if it may publish, subscribe to, serve or call
/// anything.
pub fn permits(party: &Permissions, endpoint: &Endpoint) -> bool {
    match verb_of(endpoint.kind) {
        Some(verb) => party.allows(verb, &endpoint.topic),
        None => party.allow_any_use(),
    }
}

/// Returns whether a party may own the other end of another party's endpoint.
pub fn permits_use(party: &Permissions, endpoint: &Endpoint) -> bool {
    let denied = |verb| !party.allows(other_end(verb), &endpoint.topic);
    party.are_unrestricted() || !verb_of(endpoint.kind).is_some_and(denied)
}

/// Returns whether a party may see another party's endpoint. It may if it may see the topic, or needs the endpoint as
/// the other end of its own. For a node, the full name decides.
pub fn shows(party: &Permissions, endpoint: &Endpoint) -> bool {
    if party.are_unrestricted() {
        return true;
    }
    match verb_of(endpoint.kind) {
        Some(verb) => {
            party.allows(Verb::See, &endpoint.topic)
                || party.allows(other_end(verb), &endpoint.topic)
        }
        None => {
            let namespace = endpoint.namespace.strip_suffix('/').unwrap_or(&endpoint.namespace);
            party.allows(Verb::See, &format!("{namespace}/{}", endpoint.node))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        access::{AccessRules, Principal},
        ids::Gid,
    };

    #[test]
    fn a_party_is_shown_endpoints_that_it_may_see_or_needs() {
        let rules = "[[allow]]\npeer = \"a\"\npublish = \"/in\"\nsubscribe = \"/out\"\nserve = \"/s\"\n\
                     call = \"/c\"\nsee = [\"/seen\", \"/ns/node\", \"/root\"]";
        let party = AccessRules::parse(rules, "f").unwrap().permissions(Principal::Name("a"));
        use EndpointKind::{Client, Node, Publisher, Server, Subscription};
        let of = |kind, topic: &str| {
            let mut endpoint = Endpoint::example(Gid([1; 16]), kind);
            endpoint.topic = topic.into();
            endpoint
        };
        for (kind, topic, has, sees) in [
            (Publisher, "/in", true, false),
            (Subscription, "/in", false, true),
            (Publisher, "/out", false, true),
            (Subscription, "/out", true, false),
            (Server, "/s", true, false),
            (Client, "/s", false, true),
            (Server, "/c", false, true),
            (Client, "/c", true, false),
            (Publisher, "/seen", false, true),
            (Subscription, "/other", false, false),
        ] {
            let endpoint = of(kind, topic);
            assert_eq!(
                (permits(&party, &endpoint), shows(&party, &endpoint)),
                (has, sees),
                "{kind:?} {topic}"
            );
            let uses = sees && topic != "/seen";
            assert_eq!(permits_use(&party, &endpoint), uses, "{kind:?} {topic}");
        }
        for (namespace, node, sees) in [
            ("/ns", "node", true),
            ("/ns", "other", false),
            ("/", "root", true),
            ("/ns/", "node", true),
        ] {
            let node = of(Node, "").with_node(node, namespace);
            assert!(permits(&party, &node), "a party that may do something");
            assert_eq!(shows(&party, &node), sees, "{node:?}");
        }
        let hidden = "[[deny]]\npeer = \"a\"\nsee = \"/secret\"";
        let hidden = AccessRules::parse(hidden, "f").unwrap().permissions(Principal::Name("a"));
        for kind in [Publisher, Subscription, Server, Client] {
            let [secret, other] = ["/secret", "/x"].map(|topic| of(kind, topic));
            assert!(!shows(&hidden, &secret) && !permits(&hidden, &secret), "{kind:?}");
            assert!(shows(&hidden, &other) && permits(&hidden, &other), "{kind:?}");
        }
        let both =
            "[[deny]]\npeer = \"a\"\nsee = \"**\"\n[[allow]]\npeer = \"a\"\nsubscribe = \"/scan\"";
        let both = AccessRules::parse(both, "f").unwrap().permissions(Principal::Name("a"));
        assert!(
            shows(&both, &of(Publisher, "/scan")) && permits(&both, &of(Subscription, "/scan"))
        );
        for (kind, topic) in [(Subscription, "/scan"), (Publisher, "/odom"), (Server, "/scan")] {
            assert!(!shows(&both, &of(kind, topic)), "{kind:?} {topic}");
        }
        let all = "publish = \"**\"\nsubscribe = \"/**\"\nserve = \"**\"\ncall = \"**\"";
        for (rules, has_nodes) in [
            ("default = \"allow\"".to_owned(), true),
            ("default = \"deny\"".to_owned(), false),
            ("[[allow]]\npeer = \"a\"\nsee = \"**\"".to_owned(), false),
            ("[[allow]]\npeer = \"a\"\ncall = \"/c\"".to_owned(), true),
            ("[[allow]]\npeer = \"b\"\nsee = \"**\"".to_owned(), true),
            (format!("[[deny]]\npeer = \"a\"\n{all}"), false),
            (format!("[[deny]]\npeer = \"a\"\n{all}\n[[allow]]\npeer = \"a\"\n{all}"), false),
            ("[[deny]]\npeer = \"a\"\npublish = \"**\"".to_owned(), true),
            ("[[deny]]\npeer = \"a\"\nsee = \"**\"".to_owned(), false),
            ("[[deny]]\npeer = \"a\"\nsee = \"/*\"".to_owned(), true),
        ] {
            let party = AccessRules::parse(&rules, "f").unwrap().permissions(Principal::Name("a"));
            let node = of(Node, "").with_node("node", "/ns");
            assert_eq!(permits(&party, &node), has_nodes, "{rules}");
        }
        let nobody = Permissions::default();
        assert!(permits(&nobody, &of(Publisher, "/x")) && shows(&nobody, &of(Node, "")));
    }
}
