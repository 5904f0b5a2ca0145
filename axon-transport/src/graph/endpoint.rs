//! The description of one endpoint for sessions and peers.

use minicbor::{Decode, Encode};
use serde::Serialize;

use crate::{ids::Gid, qos::Qos};

/// What an endpoint does.
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
    /// Is there: a node has a name, whether or not it has endpoints.
    #[n(4)]
    Node,
}

/// An endpoint as sessions, daemons and peers describe it to each other.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode, Serialize)]
#[cbor(map)]
#[non_exhaustive]
pub struct Endpoint {
    /// Its identity.
    #[n(0)]
    pub gid: Gid,
    /// What it does.
    #[n(1)]
    pub kind: EndpointKind,
    /// The full topic or service name; empty for a node.
    #[n(2)]
    pub topic: String,
    /// The type's name. Endpoints match on topic and type. Empty for a node.
    #[n(3)]
    pub type_name: String,
    /// The type's hash; empty when unknown.
    #[cbor(n(4), with = "minicbor::bytes")]
    pub type_hash: Vec<u8>,
    /// What it offers or requests.
    #[n(5)]
    pub qos: Qos,
    /// The node it belongs to; empty when it belongs to none.
    #[n(6)]
    pub node: String,
    /// That node's namespace.
    #[n(7)]
    pub namespace: String,
    /// For a node, the security enclave that it runs in; else empty.
    #[cbor(n(8), default)]
    pub enclave: String,
}

/// Upper bounds on what a peer or session may describe.
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

/// Bytes that an endpoint takes in the tables that know it, its names aside.
const ENTRY: usize = size_of::<Endpoint>() + 128;

impl Endpoint {
    /// An endpoint of a topic or service and a type, with the default QoS, without a type hash and of no node.
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

    /// With this QoS.
    #[must_use]
    pub fn with_qos(self, qos: Qos) -> Self {
        Self { qos, ..self }
    }

    /// With this hash of its type.
    #[must_use]
    pub fn with_type_hash(self, type_hash: Vec<u8>) -> Self {
        Self { type_hash, ..self }
    }

    /// Of this node in this namespace.
    #[must_use]
    pub fn with_node(self, node: impl Into<String>, namespace: impl Into<String>) -> Self {
        Self { node: node.into(), namespace: namespace.into(), ..self }
    }

    /// In this security enclave: for a node.
    #[must_use]
    pub fn with_enclave(self, enclave: impl Into<String>) -> Self {
        Self { enclave: enclave.into(), ..self }
    }

    /// Bytes that count for it where memory is bounded: its names and what keeps it.
    pub fn bytes(&self) -> usize {
        let names = [&self.topic, &self.type_name, &self.node, &self.namespace, &self.enclave];
        ENTRY + self.type_hash.len() + names.iter().map(|name| name.len()).sum::<usize>()
    }

    /// Whether every field is within [`LIMITS`], what must be named is, and the depth is usable.
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
    /// An endpoint of the topic `/t` and the type `T`, with the default QoS and of no node.
    pub(crate) fn example(gid: Gid, kind: EndpointKind) -> Self {
        Self::new(gid, kind, "/t", "T")
    }
}
