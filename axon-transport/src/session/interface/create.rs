//! Creates publishers, subscriptions, clients, servers, nodes and guard conditions of a session.

use super::Node;
use crate::{
    graph::{Endpoint, EndpointKind},
    qos::Qos,
    session::{
        core::GuardCondition,
        endpoint_state::SubscriptionInner,
        endpoints::{Client, EndpointFactory, Publisher, Server, Subscription},
        error::SessionError,
        handle::Session,
        options::EndpointSpec,
    },
    wire::session::EndpointRole,
};

impl Session {
    /// Creates a publisher. It is matched with the readers that the graph shows, unless they take more than some
    /// milliseconds; other readers are matched later: see [`Publisher::wait_matched`].
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_publisher(&self, spec: EndpointSpec) -> Result<Publisher, SessionError> {
        let expected_len = spec.expected_len;
        let endpoint = EndpointFactory(self).endpoint(spec, EndpointKind::Publisher)?;
        let publisher = EndpointFactory(self).add_publisher(endpoint, expected_len)?;
        let inner = &publisher.inner;
        self.shared().meet(&inner.endpoint);
        self.shared().await_pairs(&inner.endpoint, |other| inner.events.is_matched(other));
        Ok(publisher)
    }

    /// Creates a subscription. It is matched with the publishers that the graph shows, unless they take more than some
    /// milliseconds; other publishers are matched later: see [`Subscription::wait_matched`].
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_subscription(&self, spec: EndpointSpec) -> Result<Subscription, SessionError> {
        let ignores_local = spec.ignore_local;
        let endpoint = EndpointFactory(self).endpoint(spec, EndpointKind::Subscription)?;
        let mut inner = SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new());
        inner.ignores_local = ignores_local;
        let subscription = EndpointFactory(self).add_reader(inner);
        let inner = &subscription.inner;
        self.shared().meet(&inner.endpoint);
        self.shared().await_pairs(&inner.endpoint, |other| inner.events.is_matched(other));
        Ok(subscription)
    }

    /// Creates a server of a service. Its clients are matched as a publisher's readers are. A KEEP_LAST server keeps
    /// the newest untaken requests of each client, as many as its depth.
    ///
    /// # Errors
    /// When the specification is out of bounds.
    pub fn create_server(&self, spec: EndpointSpec) -> Result<Server, SessionError> {
        let endpoint = EndpointFactory(self).endpoint(spec, EndpointKind::Server)?;
        let reads = unread(&endpoint.qos);
        let server = EndpointFactory(self).add_server(
            endpoint,
            EndpointRole::Application,
            reads,
            false,
            None,
        );
        self.shared().meet(server.endpoint());
        server.await_clients();
        Ok(server)
    }

    /// Creates a client of a service. Its servers are matched as a publisher's readers are; see
    /// [`Client::wait_available`]. A KEEP_LAST client keeps the newest untaken responses of each server, as many as its
    /// depth.
    ///
    /// # Errors
    /// When the specification is out of bounds or there is no memory.
    pub fn create_client(&self, spec: EndpointSpec) -> Result<Client, SessionError> {
        let endpoint = EndpointFactory(self).endpoint(spec, EndpointKind::Client)?;
        let reads = unread(&endpoint.qos);
        let client = EndpointFactory(self).add_client(
            endpoint,
            EndpointRole::Application,
            reads,
            false,
            None,
        )?;
        self.shared().meet(client.endpoint());
        client.await_servers();
        Ok(client)
    }

    /// Creates a node, which is in the graph until it is dropped.
    ///
    /// # Errors
    /// When the name is empty, or a name is out of bounds.
    pub fn create_node(
        &self,
        name: &str,
        namespace: &str,
        enclave: &str,
    ) -> Result<Node, SessionError> {
        // Fields that nodes do not use keep their defaults.
        let spec = EndpointSpec {
            node: name.to_owned(),
            namespace: namespace.to_owned(),
            ..EndpointSpec::new("", "", Qos::default())
        };
        let described = Endpoint {
            enclave: enclave.to_owned(),
            ..EndpointFactory(self).describe(spec, EndpointKind::Node)?
        };
        if !described.is_sane() {
            return Err(SessionError::Node { name: described.node });
        }
        Ok(self.adopt_node(described))
    }

    /// Creates a condition that the program triggers itself, for wait sets of the session.
    pub fn create_guard_condition(&self) -> GuardCondition {
        GuardCondition::new(self.core())
    }
}

/// Returns the QoS that a client or server of this profile requests for reading: no message is lost except for its
/// depth.
fn unread(qos: &Qos) -> Qos {
    Qos::keep_all().with_history(qos.history).with_depth(qos.depth)
}
