//! Queries on a graph: nodes, topics, services and their types.

use std::collections::{BTreeMap, BTreeSet};

use super::{EndpointKind, GraphEntry, GraphView};

/// A node as the graph lists it. The graph lists each node, even if two have the same name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub struct NodeName {
    /// The namespace.
    pub namespace: String,
    /// The name.
    pub name: String,
    /// The security enclave that the node runs in.
    pub enclave: String,
}

/// Types by topic or service name, both sorted.
pub type NamesAndTypes = BTreeMap<String, BTreeSet<String>>;

/// Kinds of the endpoints of a topic.
pub const TOPIC_KINDS: [EndpointKind; 2] = [EndpointKind::Publisher, EndpointKind::Subscription];
/// Kinds of the endpoints of a service.
pub const SERVICE_KINDS: [EndpointKind; 2] = [EndpointKind::Server, EndpointKind::Client];

impl GraphView {
    /// Returns all nodes, sorted.
    pub fn nodes(&self) -> Vec<NodeName> {
        let mut nodes: Vec<NodeName> = self
            .of(&[EndpointKind::Node])
            .map(|entry| NodeName {
                namespace: entry.endpoint.namespace.clone(),
                name: entry.endpoint.node.clone(),
                enclave: entry.endpoint.enclave.clone(),
            })
            .collect();
        nodes.sort();
        nodes
    }

    /// Returns whether a node has this name and namespace.
    pub fn has_node(&self, name: &str, namespace: &str) -> bool {
        self.of(&[EndpointKind::Node]).any(|entry| belongs(entry, name, namespace))
    }

    /// Returns the names of the endpoints of the given `kinds`, with their types.
    pub fn names_and_types(&self, kinds: &[EndpointKind]) -> NamesAndTypes {
        collect(self.of(kinds))
    }

    /// Like [`names_and_types`](Self::names_and_types), for one node's endpoints. Returns `None` if the
    /// node does not exist.
    pub fn names_and_types_of(
        &self,
        name: &str,
        namespace: &str,
        kinds: &[EndpointKind],
    ) -> Option<NamesAndTypes> {
        let of_node = self.of(kinds).filter(|entry| belongs(entry, name, namespace));
        self.has_node(name, namespace).then(|| collect(of_node))
    }

    /// Returns the endpoints of a kind under a topic or service name, sorted by GID.
    pub fn endpoints_of(&self, kind: EndpointKind, topic: &str) -> Vec<&GraphEntry> {
        let named = |entry: &&GraphEntry| entry.endpoint.topic == topic;
        let mut entries: Vec<&GraphEntry> = self.of(&[kind]).filter(named).collect();
        entries.sort_by_key(|entry| entry.endpoint.gid);
        entries
    }

    /// Returns the endpoints of a kind, sorted by topic or service name and GID.
    pub fn endpoints_of_kind(&self, kind: EndpointKind) -> Vec<&GraphEntry> {
        let mut entries: Vec<&GraphEntry> = self.of(&[kind]).collect();
        entries.sort_by_key(|entry| (&entry.endpoint.topic, entry.endpoint.gid));
        entries
    }

    /// Returns the number of endpoints of a kind under a topic or service name.
    pub fn count(&self, kind: EndpointKind, topic: &str) -> usize {
        self.of(&[kind]).filter(|entry| entry.endpoint.topic == topic).count()
    }

    fn of(&self, kinds: &[EndpointKind]) -> impl Iterator<Item = &GraphEntry> {
        self.endpoints.values().filter(|entry| kinds.contains(&entry.endpoint.kind))
    }
}

fn belongs(entry: &GraphEntry, name: &str, namespace: &str) -> bool {
    entry.endpoint.node == name && entry.endpoint.namespace == namespace
}

fn collect<'a>(entries: impl Iterator<Item = &'a GraphEntry>) -> NamesAndTypes {
    let mut names = NamesAndTypes::new();
    for entry in entries {
        let types = names.entry(entry.endpoint.topic.clone()).or_default();
        types.insert(entry.endpoint.type_name.clone());
    }
    names
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use EndpointKind::{Client, Node, Publisher, Server, Subscription};

    use super::*;
    use crate::{graph::Endpoint, ids::Gid, qos::Qos};

    fn add(view: &mut GraphView, kind: EndpointKind, topic: &str, type_name: &str, node: &str) {
        let number = u8::try_from(view.endpoints.len() + 1).unwrap();
        let endpoint = Endpoint {
            gid: Gid([number; 16]),
            kind,
            topic: topic.into(),
            type_name: type_name.into(),
            type_hash: vec![],
            qos: Qos::default(),
            node: node.into(),
            namespace: "/ns".into(),
            enclave: if kind == Node { "/".into() } else { String::new() },
        };
        assert!(endpoint.is_sane(), "{endpoint:?}");
        let entry = GraphEntry { endpoint: Arc::new(endpoint), daemon: None, reach: None };
        view.endpoints.insert(entry.endpoint.gid, entry);
    }

    fn view() -> GraphView {
        let mut view = GraphView::default();
        add(&mut view, Node, "", "", "talker");
        add(&mut view, Node, "", "", "idle");
        add(&mut view, Node, "", "", "talker");
        add(&mut view, Publisher, "/chatter", "String", "talker");
        add(&mut view, Publisher, "/chatter", "Int", "talker");
        add(&mut view, Subscription, "/chatter", "String", "listener");
        add(&mut view, Subscription, "/scan", "LaserScan", "talker");
        add(&mut view, Server, "/add", "AddTwoInts", "talker");
        add(&mut view, Client, "/add", "AddTwoInts", "listener");
        view
    }

    fn names(found: &NamesAndTypes) -> Vec<(&str, Vec<&str>)> {
        found.iter().map(|(n, t)| (n.as_str(), t.iter().map(String::as_str).collect())).collect()
    }

    #[test]
    fn nodes_are_listed_in_order_as_often_as_they_are_there() {
        let nodes = view().nodes();
        let short: Vec<_> = nodes.iter().map(|n| (n.namespace.as_str(), n.name.as_str())).collect();
        assert_eq!(short, [("/ns", "idle"), ("/ns", "talker"), ("/ns", "talker")]);
        assert_eq!(nodes[0].enclave, "/");
    }

    #[test]
    fn topics_and_services_are_told_apart() {
        let view = view();
        let topics = view.names_and_types(&TOPIC_KINDS);
        let expected = [("/chatter", vec!["Int", "String"]), ("/scan", vec!["LaserScan"])];
        assert_eq!(names(&topics), expected);
        let services = view.names_and_types(&SERVICE_KINDS);
        assert_eq!(names(&services), [("/add", vec!["AddTwoInts"])]);
    }

    #[test]
    fn a_node_without_endpoints_is_not_a_node_that_is_not_there() {
        let view = view();
        assert_eq!(view.names_and_types_of("idle", "/ns", &TOPIC_KINDS), Some(BTreeMap::new()));
        assert_eq!(view.names_and_types_of("idle", "/", &TOPIC_KINDS), None);
        // Endpoints that name an unannounced node do not add the node.
        assert_eq!(view.names_and_types_of("listener", "/ns", &TOPIC_KINDS), None);
        let published = view.names_and_types_of("talker", "/ns", &[Publisher]).unwrap();
        assert_eq!(names(&published), [("/chatter", vec!["Int", "String"])]);
    }

    #[test]
    fn endpoints_are_counted_by_kind_and_name() {
        let view = view();
        assert_eq!(view.count(Publisher, "/chatter"), 2);
        assert_eq!(view.count(Subscription, "/chatter"), 1);
        assert_eq!(view.count(Server, "/add"), 1);
        assert_eq!(view.count(Publisher, "/chat"), 0);
        let gids: Vec<_> = view
            .endpoints_of(Publisher, "/chatter")
            .iter()
            .map(|entry| entry.endpoint.gid)
            .collect();
        assert_eq!(gids, [Gid([4; 16]), Gid([5; 16])]);
    }

    #[test]
    fn endpoints_with_missing_or_extra_names_are_not_sane() {
        let view = view();
        let node = view.endpoints[&Gid([1; 16])].endpoint.as_ref().clone();
        let talker = view.endpoints[&Gid([4; 16])].endpoint.as_ref().clone();
        for broken in [
            Endpoint { node: String::new(), ..node.clone() },
            Endpoint { topic: "/t".into(), ..node.clone() },
            Endpoint { type_name: "t".into(), ..node.clone() },
            Endpoint { enclave: "/e\0".into(), ..node },
            Endpoint { topic: String::new(), ..talker.clone() },
            Endpoint { enclave: "/".into(), ..talker },
        ] {
            assert!(!broken.is_sane(), "{broken:?}");
        }
    }
}
