//! Endpoints come and go.

use std::{sync::Arc, time::Duration};

use super::{
    Client, EndpointSpec, Publisher, Server, Session, SessionError, Subscription,
    events::EndpointEvents,
    message::{self, EndpointRole, Message},
    publisher::PublisherInner,
    rings::{Lanes, Rings},
    state::Outgoing,
    subscription::SubscriptionInner,
};
use crate::{
    config::DaemonPolicy,
    graph::{Endpoint, EndpointKind, Pairing, pairing},
    ids::Gid,
    qos::Qos,
    shm::{RingOptions, ShmError, Writer},
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
        if endpoint.is_sane() {
            Ok(endpoint)
        } else {
            Err(SessionError::Endpoint { topic: endpoint.topic })
        }
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
        role: EndpointRole,
    ) -> Result<Publisher, SessionError> {
        let options = self.ring(&endpoint, endpoint.qos);
        let writer = Arc::new(Writer::create(self.shared().segment.clone(), options)?);
        let rings = Rings::Shared(writer.clone());
        let inner = Arc::new(PublisherInner::new(endpoint, role, rings));
        self.announce(Some(&inner), None);
        Ok(Publisher { inner, writer, session: self.clone() })
    }

    pub(super) fn add_subscription(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        stands_for: Vec<Gid>,
    ) -> Subscription {
        self.add_reader(SubscriptionInner::new(endpoint, role, stands_for))
    }

    pub(super) fn add_reader(&self, inner: SubscriptionInner) -> Subscription {
        let inner = Arc::new(inner);
        self.announce(None, Some(&inner));
        Subscription { inner, session: self.clone() }
    }

    pub(super) fn add_client(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
    ) -> Result<Client, SessionError> {
        let options = self.ring(&endpoint, Qos::keep_all());
        let writer = Arc::new(Writer::create(self.shared().segment.clone(), options)?);
        let (requests, responses) = self.add_both(endpoint, role, Rings::Shared(writer.clone()));
        Ok(Client::new(requests, responses, writer, self.clone()))
    }

    pub(super) fn add_server(&self, endpoint: Endpoint, role: EndpointRole) -> Server {
        let options = self.ring(&endpoint, Qos::keep_all());
        let lanes = Arc::new(Lanes::new(self.shared().segment.clone(), options));
        let (responses, requests) = self.add_both(endpoint, role, Rings::Each(lanes.clone()));
        Server::new(responses, requests, lanes, self.clone())
    }

    /// The two sides of an endpoint that writes and reads.
    fn add_both(
        &self,
        endpoint: Endpoint,
        role: EndpointRole,
        rings: Rings,
    ) -> (Arc<PublisherInner>, Arc<SubscriptionInner>) {
        let writes = Arc::new(PublisherInner::new(endpoint.clone(), role, rings));
        let reads = Arc::new(SubscriptionInner::new(endpoint, role, Vec::new()));
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
        let mut state = self.shared().state();
        if state.nodes.remove(gid).is_some() {
            // The daemon may never have heard of it, and will then not say that it is gone.
            Arc::make_mut(&mut state.graph).endpoints.remove(gid);
        }
        let publisher = state.publishers.remove(gid);
        let subscription = state.subscriptions.remove(gid);
        let publisher = publisher.as_ref().map(|p| (&p.endpoint, p.role));
        let subscription = subscription.as_ref().map(|s| (&s.endpoint, s.role));
        match publisher.or(subscription) {
            Some((_, EndpointRole::StandIn | EndpointRole::Relay)) => {}
            Some((endpoint, EndpointRole::Application)) => {
                state.unindex(endpoint);
                state.tombstones.insert(*gid);
            }
            None => drop(state.tombstones.insert(*gid)),
        }
        let gone = message::Gone { gid: *gid };
        state.outgoing.push_back(Outgoing::Message(Box::new(Message::EndpointGone(gone))));
        drop(state);
        self.shared().wake();
    }

    /// A relay stands for others than before: its writers and the daemon hear of it.
    pub(super) fn renew(&self, gid: Gid) {
        if self.is_forked() {
            return;
        }
        self.shared().tell(Outgoing::Announce(gid));
    }

    /// Waits until a new endpoint is matched with all that the graph shows and that go with it: whoever
    /// counts them reaches them. Not for long, and not where nobody could do it.
    pub(super) fn await_pairs(&self, own: &Endpoint, matched: impl Fn(&Gid) -> bool) {
        let shared = self.shared();
        if shared.control.get() == Some(&std::thread::current().id()) {
            return;
        }
        let goes = |other: &Endpoint| {
            pairing(own, other) == Pairing::Match || pairing(other, own) == Pairing::Match
        };
        // Of its own session's endpoints it is sure, and both ends are waited for.
        let (mut others, mut publishers, mut subscriptions) = (Vec::new(), Vec::new(), Vec::new());
        let graph = {
            let state = shared.state();
            if state.daemon.is_none() && shared.config.daemon != DaemonPolicy::Off {
                return;
            }
            let ignores = state.subscriptions.get(&own.gid).is_some_and(|s| s.ignores_local);
            let others = state.topics.get(&own.topic).filter(|_| !ignores);
            for gid in others.into_iter().flatten() {
                publishers.extend(state.publishers.get(gid).filter(|p| goes(&p.endpoint)).cloned());
                let hears = |s: &&Arc<SubscriptionInner>| goes(&s.endpoint) && !s.ignores_local;
                subscriptions.extend(state.subscriptions.get(gid).filter(hears).cloned());
            }
            state.graph.clone()
        };
        let foreign = graph.endpoints.values().map(|other| &other.endpoint);
        let foreign = foreign.filter(|other| other.gid.0[..12] != own.gid.0[..12] && goes(other));
        others.extend(foreign.map(|other| other.gid));
        drop(graph);
        let there = |other: &Gid| shared.state().graph.endpoints.contains_key(other);
        let stands = |other: &Gid, theirs: &EndpointEvents| {
            let ends = matched(other) && theirs.is_matched(&own.gid);
            let state = shared.state();
            ends || !(state.publishers.contains_key(other)
                || state.subscriptions.contains_key(other))
        };
        shared.wait_changed(PAIRS, || {
            publishers.iter().all(|p| stands(&p.endpoint.gid, &p.events))
                && subscriptions.iter().all(|s| stands(&s.endpoint.gid, &s.events))
                && others.iter().all(|other| matched(other) || !there(other))
        });
    }
}
