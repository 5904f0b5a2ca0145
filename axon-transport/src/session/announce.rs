//! Adds endpoints to a session and announces them to the daemon. Removes them when they are dropped.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    ShmError,
    internal::{Allowance, RingOptions, Writer},
};

use super::{
    Client, EndpointSpec, Publisher, Server, Session, SessionError, Subscription,
    publisher::PublisherInner,
    rings::{Rings, RingsByClient},
    state::Outgoing,
    subscription::SubscriptionInner,
};
use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing},
    ids::Gid,
    qos::Qos,
    wire::session::EndpointRole,
};

/// How long a new endpoint waits for those that it is matched with.
const PAIRS: Duration = Duration::from_millis(50);

impl Session {
    pub(super) fn endpoint(
        &self,
        spec: EndpointSpec,
        kind: EndpointKind,
    ) -> Result<Endpoint, SessionError> {
        let endpoint = self.describe(spec, kind)?;
        if !endpoint.is_sane() {
            return Err(SessionError::Endpoint { topic: endpoint.topic });
        }
        #[cfg(feature = "sros2")]
        self.shared().permit(&endpoint)?;
        Ok(endpoint)
    }

    /// An endpoint with a GID of its own.
    pub(super) fn describe(
        &self,
        spec: EndpointSpec,
        kind: EndpointKind,
    ) -> Result<Endpoint, SessionError> {
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let number = {
            let mut state = self.shared().state();
            state.next_entity += 1;
            state.next_entity
        };
        let EndpointSpec { topic, type_name, type_hash, qos, node, namespace, .. } = spec;
        Ok(Endpoint {
            gid: Gid::new(self.shared().id, number),
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

    pub(super) fn add_publisher(
        &self,
        endpoint: Endpoint,
        expected_len: u64,
    ) -> Result<Publisher, SessionError> {
        let role = EndpointRole::Application;
        self.add_writer(endpoint, expected_len, None, |e, rings| {
            PublisherInner::new(e, role, rings)
        })
    }

    /// A publisher that is alive when it is said to be. It takes the memory for its samples of `allowance`, if there is one.
    pub(super) fn add_asserted(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        allowance: Option<&Arc<Allowance>>,
    ) -> Result<Publisher, SessionError> {
        self.add_writer(endpoint, 0, allowance, |e, rings| {
            PublisherInner::new(e, role, rings).asserted()
        })
    }

    fn add_writer(
        &self,
        endpoint: Endpoint,
        expected: u64,
        allowance: Option<&Arc<Allowance>>,
        inner: impl FnOnce(Endpoint, Rings) -> PublisherInner,
    ) -> Result<Publisher, SessionError> {
        let options = RingOptions { expected, ..self.ring(&endpoint, endpoint.qos) };
        let writer = Arc::new(Writer::create(self.shared().segment.clone(), options)?);
        allowance.into_iter().for_each(|allowance| writer.share(allowance));
        let inner = Arc::new(inner(endpoint, Rings::Shared(writer.clone())));
        self.announce(Some(&inner), None);
        Ok(Publisher { inner, writer, session: self.clone() })
    }

    pub(super) fn add_reader(&self, inner: SubscriptionInner) -> Subscription {
        let inner = Arc::new(inner);
        self.announce(None, Some(&inner));
        Subscription { inner, session: self.clone() }
    }

    /// A client, of whose responses those stand that `reads` asks for. One that `carries` them to another process says
    /// which of them are there.
    pub(super) fn add_client(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        carries: bool,
        allowance: Option<&Arc<Allowance>>,
    ) -> Result<Client, SessionError> {
        let options = self.ring(&endpoint, Qos::keep_all());
        let segment = self.shared().segment.clone();
        let writer = Arc::new(Writer::create_for_calls(segment, options)?);
        allowance.into_iter().for_each(|allowance| writer.share(allowance));
        let rings = Rings::Shared(writer.clone());
        let (requests, responses) = self.add_both(endpoint, role, reads, rings, carries);
        responses.calls.set_ring(writer.clone());
        Ok(Client::new(requests, responses, writer, self.clone()))
    }

    /// A server, of whose requests those stand that `reads` asks for. One that `carries` them to another process says
    /// which of them are there.
    pub(super) fn add_server(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        carries: bool,
        allowance: Option<&Arc<Allowance>>,
    ) -> Server {
        let options = self.ring(&endpoint, Qos::keep_all());
        let shared = self.shared();
        let (segment, room) = (shared.segment.clone(), shared.room.clone());
        let by_client = RingsByClient::new(segment, options, room, allowance.cloned());
        let by_client = Arc::new(by_client);
        let rings = Rings::Each(by_client.clone());
        let (responses, requests) = self.add_both(endpoint, role, reads, rings, carries);
        Server::new(responses, requests, by_client, self.clone())
    }

    /// The two sides of an endpoint that writes and reads.
    fn add_both(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        reads: Qos,
        rings: Rings,
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
        let config = &self.shared().config;
        let (budget, max_message) = (config.ring_bytes, config.max_message);
        RingOptions { gid: endpoint.gid, qos, budget, max_message, expected: 0 }
    }

    /// Keeps an endpoint's sides for the control thread, and has it told of.
    fn announce(
        &self,
        writes: Option<&Arc<PublisherInner>>,
        reads: Option<&Arc<SubscriptionInner>>,
    ) {
        let shared = self.shared();
        let mut state = shared.state();
        let (mut endpoint, mut role) = (None, EndpointRole::Application);
        if let Some(inner) = writes {
            state.publishers.insert(inner.endpoint.gid, inner.clone());
            (endpoint, role) = (Some(&inner.endpoint), inner.role);
        }
        if let Some(inner) = reads {
            state.subscriptions.insert(inner.endpoint.gid, inner.clone());
            (endpoint, role) = (Some(&inner.endpoint), inner.role);
        }
        let Some(endpoint) = endpoint else { return };
        if role == EndpointRole::Application {
            state.index(endpoint);
        }
        state.outgoing.push_back(Outgoing::Announce(endpoint.gid));
        drop(state);
        shared.wake();
    }

    /// An endpoint's or a node's handle is dropped.
    pub(super) fn forget_endpoint(&self, gid: &Gid) {
        // In a forked child it is the parent's still, and its locks may be held.
        if self.is_forked() {
            return;
        }
        self.shared().part(gid);
        self.shared().wake();
    }

    /// A relay stands for others than before: its writers and the daemon hear of it.
    pub(super) fn renew(&self, gid: Gid) {
        if self.is_forked() {
            return;
        }
        self.shared().tell(Outgoing::Announce(gid));
    }

    /// Waits until a new endpoint is matched with all that the graph shows and that go with it: a
    /// caller that counts them reaches them. Not for long, and not where nobody could do it. Those of other hosts are
    /// not awaited while many endpoints are created ([`PairWaits`](super::pair_waits::PairWaits)).
    pub(super) fn await_pairs(&self, own: &Endpoint, matched: impl Fn(&Gid) -> bool) {
        let shared = self.shared();
        if shared.control.get() == Some(&std::thread::current().id()) {
            return;
        }
        let goes = |other: &Endpoint| {
            pairing(own, other) == Pairing::Match || pairing(other, own) == Pairing::Match
        };
        let graph = {
            let state = shared.state();
            if state.daemon.is_none() {
                return;
            }
            state.graph.clone()
        };
        let begun = Instant::now();
        let far = shared.pair_waits().are_due(begun);
        let foreign = graph.endpoints.values().filter(|entry| {
            let other = &entry.endpoint;
            (far || entry.daemon.is_none()) && !other.gid.is_of_session_of(&own.gid) && goes(other)
        });
        let (mut others, mut waits_far) = (Vec::new(), false);
        for entry in foreign {
            others.push(entry.endpoint.gid);
            waits_far |= entry.daemon.is_some();
        }
        drop(graph);
        let there = |other: &Gid| shared.state().graph.endpoints.contains_key(other);
        shared.wait_changed(PAIRS, || others.iter().all(|other| matched(other) || !there(other)));
        if waits_far {
            let now = Instant::now();
            shared.pair_waits().waited(now - begun, now);
        }
    }
}
