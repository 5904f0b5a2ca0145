//! The description of one endpoint for sessions and peers.

use minicbor::{Decode, Encode};
use serde::Serialize;

use crate::{ids::Gid, qos::Qos};

/// The kind of an endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Encode, Decode, Serialize)]
#[cbor(index_only)]
#[serde(rename_all = "snake_case")]
pub enum EndpointKind {
    /// Sends samples of a topic.
    #[n(0)]
    Publisher,
    /// Receives samples of a topic.
    #[n(1)]
    Subscription,
    /// Answers requests.
    #[n(2)]
    Server,
    /// Sends requests.
    #[n(3)]
    Client,
    /// A node, which has a name and possibly no endpoints.
    #[n(4)]
    Node,
}

/// An endpoint as sessions, daemons and peers describe it to each other.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(map)]
#[non_exhaustive]
pub struct Endpoint {
    /// The identity.
    #[n(0)]
    pub gid: Gid,
    /// The kind.
    #[n(1)]
    pub kind: EndpointKind,
    /// The full topic or service name; empty for a node.
    #[n(2)]
    pub topic: String,
    /// The type's name. Endpoints match on topic and type. Empty for a node.
    #[n(3)]
    pub type_name: String,
    /// The type's hash; empty if unknown.
    #[cbor(n(4), with = "minicbor::bytes")]
    pub type_hash: Vec<u8>,
    /// QoS that is offered or requested.
    #[n(5)]
    pub qos: Qos,
    /// The name of the node; empty without a node.
    #[n(6)]
    pub node: String,
    /// The node's namespace.
    #[n(7)]
    pub namespace: String,
    /// For a node, the security enclave that it runs in; otherwise empty.
    #[cbor(n(8), default)]
    pub enclave: String,
}

/// Upper bounds on the descriptions of a peer or session.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Bytes of a topic, type, node or namespace name.
    pub name: usize,
    /// Bytes of a type hash.
    pub type_hash: usize,
    /// Endpoints of one session or one peer.
    pub endpoints: usize,
}

/// The bounds in force.
pub const LIMITS: Limits = Limits { name: 512, type_hash: 64, endpoints: 65_536 };

/// Bytes that an endpoint takes in tables, without its names and type hash.
const ENTRY: usize = size_of::<Endpoint>() + 128;

impl Endpoint {
    /// Creates an endpoint of a topic or service and a type, with the default QoS, no type hash and no
    /// node.
    pub fn new(
        gid: Gid,
        kind: EndpointKind,
        topic: impl Into<String>,
        type_name: impl Into<String>,
    ) -> Self {
        Self {
            gid,
            kind,
            topic: topic.into(),
            type_name: type_name.into(),
            type_hash: Vec::new(),
            qos: Qos::default(),
            node: String::new(),
            namespace: String::new(),
            enclave: String::new(),
        }
    }

    /// Sets the QoS.
    #[must_use]
    pub fn with_qos(self, qos: Qos) -> Self {
        Self { qos, ..self }
    }

    /// Sets the hash of the type.
    #[must_use]
    pub fn with_type_hash(self, type_hash: Vec<u8>) -> Self {
        Self { type_hash, ..self }
    }

    /// Sets the node and its namespace.
    #[must_use]
    pub fn with_node(self, node: impl Into<String>, namespace: impl Into<String>) -> Self {
        Self { node: node.into(), namespace: namespace.into(), ..self }
    }

    /// Sets the security enclave of a node.
    #[must_use]
    pub fn with_enclave(self, enclave: impl Into<String>) -> Self {
        Self { enclave: enclave.into(), ..self }
    }

    /// Returns the bytes that count towards memory limits: the names, the type hash and the table entries.
    pub fn bytes(&self) -> usize {
        let names = [&self.topic, &self.type_name, &self.node, &self.namespace, &self.enclave];
        ENTRY + self.type_hash.len() + names.iter().map(|name| name.len()).sum::<usize>()
    }

    /// Returns whether every field is within [`LIMITS`], no name contains NUL, the kind has the names that
    /// it requires and no others, and the history depth is at least 1.
    pub fn is_sane(&self) -> bool {
        let names = [&self.topic, &self.type_name, &self.node, &self.namespace, &self.enclave];
        let named = if self.kind == EndpointKind::Node {
            !self.node.is_empty() && self.topic.is_empty() && self.type_name.is_empty()
        } else {
            !self.topic.is_empty() && self.enclave.is_empty()
        };
        names.iter().all(|n| n.len() <= LIMITS.name && !n.contains('\0'))
            && named
            && self.type_hash.len() <= LIMITS.type_hash
            && self.qos.depth >= 1
    }
}

#[cfg(test)]
impl Endpoint {
    /// Creates an endpoint of the topic `/t` and the type `T`, with the default QoS and no node.
    pub(crate) fn example(gid: Gid, kind: EndpointKind) -> Self {
        Self::new(gid, kind, "/t", "T")
    }
}
