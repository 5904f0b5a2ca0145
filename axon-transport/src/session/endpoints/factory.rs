//! Makes the endpoints of a session and announces them to the daemon.

use std::sync::Arc;

use axon_shm::{
    ShmError,
    internal::{MemoryBudget, RingOptions, Writer},
};

use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::Qos,
    session::{
        core::Outgoing,
        endpoint_state::{PublisherInner, RingsByClient, SubscriptionInner, WriterRings},
        error::SessionError,
        handle::Session,
        options::EndpointSpec,
    },
    wire::session::EndpointRole,
};

use super::{Client, Publisher, Server, Subscription};

/// Makes endpoints of one session, for the application, for relays and for the publishers of other hosts.
pub(in crate::session) struct EndpointFactory<'a>(pub(in crate::session) &'a Session);

impl EndpointFactory<'_> {
    /// Describes an endpoint that the session may have, with a GID of its own.
    pub(in crate::session) fn endpoint(
        &self,
        spec: EndpointSpec,
        kind: EndpointKind,
    ) -> Result<Endpoint, SessionError> {
        let endpoint = self.describe(spec, kind)?;
        if !endpoint.is_sane() {
            return Err(SessionError::Endpoint { topic: endpoint.topic });
        }
        #[cfg(feature = "sros2")]
        self.0.shared().permit(&endpoint)?;
        Ok(endpoint)
    }

    /// Describes an endpoint, with a GID of its own.
    pub(in crate::session) fn describe(
        &self,
        spec: EndpointSpec,
        kind: EndpointKind,
    ) -> Result<Endpoint, SessionError> {
        if self.0.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let number = self.0.shared().state().endpoints.next_number();
        let EndpointSpec { topic, type_name, type_hash, qos, node, namespace, .. } = spec;
        Ok(Endpoint {
            gid: Gid::new(self.0.shared().core.id, number),
            kind,
            topic,
            type_name,
            type_hash,
            qos,
            node,
            namespace,
            enclave: String::new(),
        })
    }

    pub(in crate::session) fn add_publisher(
        &self,
        endpoint: Endpoint,
        expected_len: u64,
    ) -> Result<Publisher, SessionError> {
        let role = EndpointRole::Application;
        self.add_writer(endpoint, expected_len, None, |e, rings| {
            PublisherInner::new(e, role, rings)
        })
    }

    /// Adds a publisher whose liveliness is asserted explicitly. It takes the memory for its samples from `budget`, if
    /// there is one.
    pub(in crate::session) fn add_asserted(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        budget: Option<&Arc<MemoryBudget>>,
    ) -> Result<Publisher, SessionError> {
        self.add_writer(endpoint, 0, budget, |e, rings| {
            PublisherInner::new(e, role, rings).asserted()
        })
    }

    fn add_writer(
        &self,
        endpoint: Endpoint,
        expected: u64,
        budget: Option<&Arc<MemoryBudget>>,
        inner: impl FnOnce(Endpoint, WriterRings) -> PublisherInner,
    ) -> Result<Publisher, SessionError> {
        let options = RingOptions { expected, ..self.ring(&endpoint, endpoint.qos) };
        let writer = Arc::new(Writer::create(self.0.shared().core.segment.clone(), options)?);
        budget.into_iter().for_each(|budget| writer.share(budget));
        let inner = Arc::new(inner(endpoint, WriterRings::Shared(writer.clone())));
        self.announce(Some(&inner), None);
        Ok(Publisher { inner, writer, session: self.0.clone() })
    }

    pub(in crate::session) fn add_reader(&self, inner: SubscriptionInner) -> Subscription {
        let inner = Arc::new(inner);
        self.announce(None, Some(&inner));
        Subscription { inner, session: self.0.clone() }
    }

    /// Creates a relay: a local reader that carries samples to the subscriptions `stands_for` of another process or
    /// host, of the publisher `only` if there is one. A publisher keeps a sample until a relay that `carries`
    /// [acknowledges](Subscription::acknowledge_of) it. That holds even where the relay stands for no remote
    /// subscription.
    pub(in crate::session) fn create_relay(
        &self,
        spec: EndpointSpec,
        only: Option<Gid>,
        stands_for: Vec<Gid>,
        carries: bool,
    ) -> Result<Subscription, SessionError> {
        let endpoint = self.endpoint(spec, EndpointKind::Subscription)?;
        let mut inner = SubscriptionInner::new(endpoint, EndpointRole::Relay, stands_for);
        inner.only = only;
        inner.carries = carries;
        Ok(self.add_reader(inner))
    }

    /// Adds a client. `reads` decides how many untaken responses it keeps. With `carries`, it carries the responses to
    /// another process and confirms their delivery.
    pub(in crate::session) fn add_client(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        carries: bool,
        budget: Option<&Arc<MemoryBudget>>,
    ) -> Result<Client, SessionError> {
        let options = self.ring(&endpoint, Qos::keep_all());
        let segment = self.0.shared().core.segment.clone();
        let writer = Arc::new(Writer::create_for_calls(segment, options)?);
        budget.into_iter().for_each(|budget| writer.share(budget));
        let rings = WriterRings::Shared(writer.clone());
        let (requests, responses) = self.add_both(endpoint, role, reads, rings, carries);
        responses.calls.set_ring(writer.clone());
        Ok(Client::new(requests, responses, writer, self.0.clone()))
    }

    /// Adds a server. `reads` decides how many untaken requests it keeps. With `carries`, it carries the requests to
    /// another process and confirms their delivery.
    pub(in crate::session) fn add_server(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        carries: bool,
        budget: Option<&Arc<MemoryBudget>>,
    ) -> Server {
        let options = self.ring(&endpoint, Qos::keep_all());
        let shared = self.0.shared();
        let (segment, room) = (shared.core.segment.clone(), shared.room.clone());
        let by_client = RingsByClient::new(segment, options, room, budget.cloned());
        let by_client = Arc::new(by_client);
        let rings = WriterRings::Each(by_client.clone());
        let (responses, requests) = self.add_both(endpoint, role, reads, rings, carries);
        Server::new(responses, requests, by_client, self.0.clone())
    }

    /// Creates and announces the two sides of an endpoint that writes and reads.
    fn add_both(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        rings: WriterRings,
        carries: bool,
    ) -> (Arc<PublisherInner>, Arc<SubscriptionInner>) {
        let writes = Arc::new(PublisherInner::new(endpoint.clone(), role, rings));
        let mut reads = SubscriptionInner::of_service(endpoint, role, reads);
        reads.carries = carries;
        let reads = Arc::new(reads);
        self.announce(Some(&writes), Some(&reads));
        (writes, reads)
    }

    fn ring(&self, endpoint: &Endpoint, qos: Qos) -> RingOptions {
        let config = &self.0.shared().core.config;
        let (budget, max_message) = (config.ring_bytes, config.max_message);
        RingOptions { gid: endpoint.gid, qos, budget, max_message, expected: 0 }
    }

    /// Stores an endpoint's sides for the control thread, and queues its announcement.
    fn announce(
        &self,
        writes: Option<&Arc<PublisherInner>>,
        reads: Option<&Arc<SubscriptionInner>>,
    ) {
        let shared = self.0.shared();
        let mut state = shared.state();
        let (mut endpoint, mut role) = (None, EndpointRole::Application);
        if let Some(inner) = writes {
            state.endpoints.publishers.insert(inner.endpoint.gid, inner.clone());
            (endpoint, role) = (Some(&inner.endpoint), inner.role);
        }
        if let Some(inner) = reads {
            state.endpoints.subscriptions.insert(inner.endpoint.gid, inner.clone());
            (endpoint, role) = (Some(&inner.endpoint), inner.role);
        }
        let Some(endpoint) = endpoint else { return };
        if role == EndpointRole::Application {
            state.endpoints.topics.insert(endpoint);
        }
        shared.core.link.queue(Outgoing::Announce(endpoint.gid));
        drop(state);
        shared.core.wake();
    }
}
