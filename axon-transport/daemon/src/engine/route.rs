//! The names of a route between two hosts, and the relays that the sending side opens for it.

use std::fmt;

use axon_envelope::Kind;
use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::graph::{Endpoint, EndpointKind};

/// The key of a route: kind, topic and type of the messages that it carries.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct RouteKey {
    /// Samples, requests or responses.
    pub(crate) kind: Kind,
    /// Topic or service name.
    pub(crate) topic: String,
    /// Type name.
    pub(crate) type_name: String,
}

impl fmt::Display for RouteKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = match self.kind {
            Kind::Topic => "",
            Kind::Request => " (requests)",
            Kind::Response => " (responses)",
        };
        write!(f, "{}{kind} [{}]", self.topic, self.type_name)
    }
}

impl RouteKey {
    /// Returns the key of a writer's route, or `None` for a reader or a node.
    pub(in crate::engine) fn of(writer: &Endpoint) -> Option<Self> {
        let kind = match writer.kind {
            EndpointKind::Publisher => Kind::Topic,
            EndpointKind::Client => Kind::Request,
            EndpointKind::Server => Kind::Response,
            EndpointKind::Subscription | EndpointKind::Node => return None,
        };
        let (topic, type_name) = (writer.topic.clone(), writer.type_name.clone());
        Some(Self { kind, topic, type_name })
    }

    /// Returns the length of both names in bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.topic.len() + self.type_name.len()
    }

    /// Returns the key of the same service in the other direction; for a topic its own key.
    pub(crate) fn other_way(&self) -> Self {
        let kind = match self.kind {
            Kind::Topic => Kind::Topic,
            Kind::Request => Kind::Response,
            Kind::Response => Kind::Request,
        };
        Self { kind, ..self.clone() }
    }
}

/// One relay subscription that the sending side opens for a topic's route.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RelaySpec {
    /// The QoS that it requests locally.
    pub(crate) qos: Qos,
    /// Largest history depth among the subscriptions that it stands for.
    pub(crate) depth: u32,
    /// The hash of its type, if the peer's subscriptions know it.
    pub(crate) type_hash: Vec<u8>,
    /// The peer's subscriptions that it stands for.
    pub(crate) stands_for: Vec<Gid>,
}

impl RelaySpec {
    /// Returns whether both have the same QoS and type hash. The subscriptions may differ.
    pub(crate) fn is(&self, other: &Self) -> bool {
        self.qos == other.qos && self.type_hash == other.type_hash
    }

    /// Returns the QoS of its queue.
    pub(crate) fn queued(&self) -> Qos {
        self.qos.with_depth(self.depth)
    }
}
