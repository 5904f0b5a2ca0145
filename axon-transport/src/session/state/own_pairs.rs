//! Pairs of endpoints within one session. The thread that creates the second endpoint attaches them, and the thread
//! that drops the first one detaches them, before the call returns. A publisher may stay longer for readers of other
//! sessions.
//!
//! The daemon announces such a pair like any other, when the pair is already attached. A writer that is asked again
//! for the same lane repeats its grant. If the thread cannot attach the pair at once, for example for lack of
//! memory, the daemon's announcement attaches it later.

use std::{
    sync::{Arc, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use axon_shm::{
    ShmError,
    internal::{ReaderInfo, RingPeer, Terms},
};

use super::SessionShared;
use crate::{
    graph::{Endpoint, Pairing, pairing},
    ids::Gid,
    session::{
        core::Outgoing,
        endpoint_state::{Accept, EventSource, NumberKind, PublisherInner, SubscriptionInner},
    },
    wire::session::EndpointRole,
};

/// Maximum time that a publisher which the application has dropped stays for readers that have not taken up their
/// grant.
const EXPECTED: Duration = Duration::from_secs(if cfg!(test) { 3600 } else { 10 });

impl SessionShared {
    /// Takes the lock under which pairs of the session's own endpoints come and go.
    pub(in crate::session) fn lock_own_pairs(&self) -> MutexGuard<'_, ()> {
        self.own_pairs.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Attaches a new endpoint to the matching endpoints of its session, and shows it in the session's graph.
    pub(in crate::session) fn meet(&self, own: &Endpoint) {
        let held = self.lock_own_pairs();
        let pairs = self.pairs_of(&own.gid);
        let mut changed = Vec::new();
        for (writer, reader) in pairs {
            match self.join(&writer, &reader) {
                Ok(()) => changed
                    .extend([EventSource::Publisher(writer), EventSource::Subscription(reader)]),
                Err(error) => {
                    let topic = &writer.endpoint.topic;
                    tracing::debug!(topic, %error, "two endpoints of a session do not meet at once");
                }
            }
        }
        drop(held);
        self.rematch(changed);
        self.state().graph.show(own);
        self.core.wake();
    }

    fn pairs_of(&self, own: &Gid) -> Vec<(Arc<PublisherInner>, Arc<SubscriptionInner>)> {
        let state = self.state();
        let (writer, reader) =
            (state.endpoints.publishers.get(own), state.endpoints.subscriptions.get(own));
        let endpoint = writer.map(|w| &w.endpoint).or(reader.map(|r| &r.endpoint));
        let others = endpoint.into_iter().flat_map(|own| state.endpoints.topics.counterparts(own));
        let mut pairs = Vec::new();
        for other in others {
            let out = (writer, state.endpoints.subscriptions.get(other));
            let back = (state.endpoints.publishers.get(other), reader);
            for (writer, reader) in [out, back] {
                if let (Some(writer), Some(reader)) = (writer, reader)
                    && pairing(&writer.endpoint, &reader.endpoint) == Pairing::Match
                    && !reader.ignores_local
                {
                    pairs.push((Arc::clone(writer), Arc::clone(reader)));
                }
            }
        }
        pairs
    }

    fn join(&self, writer: &PublisherInner, reader: &SubscriptionInner) -> Result<(), ShmError> {
        let (from, gid, peer) =
            (writer.endpoint.gid, reader.endpoint.gid, RingPeer::Local(self.core.segment.clone()));
        // One lock covers all steps: between two steps, the control thread would request another lane.
        let mut matched_readers = reader.lock();
        let lane = matched_readers.lane_for(from, || self.core.segment.allocate_lane())?.lane;
        let reads = ReaderInfo { gid, lane, qos: reader.qos, peer: peer.clone(), stands_for: None };
        let (grant, after, ring) = writer.attach(reads, Terms::default())?;
        if let Accept::Map(lane) = matched_readers.accept(from, grant) {
            let max_message = self.core.config.max_message;
            let mapped = reader.map(from, peer, ring, lane, grant, max_message)?;
            matched_readers.add(mapped, Some(after), NumberKind::None);
        }
        Ok(())
    }

    /// Removes an endpoint or node that the application has dropped: detaches it from the other endpoints of the
    /// session, and removes it from the session. A publisher stays for readers that have not taken up their grant,
    /// hidden in this session's graph, for at most [`EXPECTED`].
    pub(in crate::session) fn part(&self, gid: &Gid) {
        let link = &self.core.link;
        let held = self.lock_own_pairs();
        let mut state = self.state();
        let node = state.endpoints.nodes.remove(gid);
        let stays = state
            .endpoints
            .publishers
            .get(gid)
            .is_some_and(|publisher| publisher.expects_readers());
        let publisher = if stays {
            state.endpoints.leaving.insert(*gid, Instant::now() + EXPECTED);
            state.endpoints.publishers.get(gid).cloned()
        } else {
            let publisher = state.endpoints.publishers.remove(gid);
            publisher.iter().for_each(|publisher| state.leave_unmet(publisher, link));
            publisher
        };
        let subscription = state.endpoints.subscriptions.remove(gid);
        let writes = publisher.as_ref().map(|p| (&p.endpoint, p.role));
        let reads = subscription.as_ref().map(|s| (&s.endpoint, s.role));
        let mut others = Vec::new();
        match writes.or(reads) {
            // Their GIDs are not in the graph, or stand for remote endpoints in it.
            Some((_, EndpointRole::StandIn | EndpointRole::Relay)) => {
                link.queue(Outgoing::gone(*gid))
            }
            Some((endpoint, EndpointRole::Application)) => {
                state.endpoints.topics.remove(endpoint);
                if stays {
                    state.graph.hide(gid);
                } else {
                    state.remove_dead(gid, link);
                }
                for other in state.endpoints.topics.counterparts(endpoint) {
                    others.extend(
                        state.endpoints.publishers.get(other).cloned().map(EventSource::Publisher),
                    );
                    let reads = state.endpoints.subscriptions.get(other).cloned();
                    others.extend(reads.map(EventSource::Subscription));
                }
            }
            None => state.remove_dead(gid, link),
        }
        drop(state);
        others.retain(|other| {
            other.events().forget(gid);
            match other {
                EventSource::Publisher(writer) => writer.detach(*gid),
                EventSource::Subscription(reader) => reader.lock().end(gid),
            }
        });
        drop(held);
        drop((node, publisher, subscription));
        self.rematch(others);
    }

    /// Removes the publishers that stayed and are not needed any more, or all. Returns whether others remain.
    pub(in crate::session) fn part_leaving(&self, all: bool) -> bool {
        let link = &self.core.link;
        let mut state = self.state();
        if state.endpoints.leaving.is_empty() {
            return false;
        }
        let now = Instant::now();
        let is_over = |(gid, until): &(&Gid, &Instant)| {
            let publisher = state.endpoints.publishers.get(*gid);
            all || **until <= now || !publisher.is_some_and(|p| p.expects_readers())
        };
        let over: Vec<Gid> =
            state.endpoints.leaving.iter().filter(is_over).map(|(gid, _)| *gid).collect();
        let mut parted = Vec::new();
        for gid in over {
            state.endpoints.leaving.remove(&gid);
            let publisher = state.endpoints.publishers.remove(&gid);
            publisher.iter().for_each(|publisher| state.leave_unmet(publisher, link));
            parted.extend(publisher);
            state.remove_dead(&gid, link);
        }
        let others = !state.endpoints.leaving.is_empty();
        drop(state);
        drop(parted);
        others
    }

    /// Counts the changes to the pairs of `endpoints`. The control thread reports them.
    fn rematch(&self, endpoints: Vec<EventSource>) {
        let news = endpoints.into_iter().map(|endpoint| (endpoint.rematch(), endpoint));
        let news: Vec<_> = news.filter(|(changes, _)| !changes.is_empty()).collect();
        if news.is_empty() {
            return;
        }
        let mut state = self.state();
        state.rematched.extend(news);
        drop(state);
        self.notify(None);
        self.core.segment.notify();
        self.core.wake();
    }
}
