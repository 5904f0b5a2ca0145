//! The graph that the session shows, and the matches of its own endpoints.

use std::{collections::BTreeSet, sync::Arc, time::Instant};

use super::{Control, Rematching};
use crate::{
    graph::{Endpoint, EndpointKind, GraphEntry, GraphView, Pairing, pairing},
    ids::Gid,
    session::{
        core::SessionEvent,
        sides::{Changes, EventSource, PublisherInner, SubscriptionInner},
    },
    wire::session::{Pair, SessionGraph},
};

impl Control {
    /// The daemon tells of a change, or a part of the whole.
    pub(super) fn graph(&mut self, graph: SessionGraph) {
        if graph.whole {
            self.building = Some(GraphView::default());
            self.topics.clear();
            self.arrivals.restart();
            self.peers.recount();
            self.pairs.begin_whole();
        }
        let over = graph.ended.unwrap_or_default();
        {
            let mut state = self.shared.state();
            graph.removed.iter().for_each(|gid| {
                state.graph.tombstones.remove(gid);
            });
        }
        for gid in graph.removed {
            self.disappear(&gid);
        }
        for item in graph.added {
            self.appear(GraphEntry {
                endpoint: Arc::new(item.endpoint),
                daemon: item.daemon,
                reach: item.reach,
            });
        }
        self.view(|view| view.version = graph.version);
        if !graph.more
            && let Some(mut view) = self.building.take()
        {
            let mut state = self.shared.state();
            // The daemon may have told of the whole before it heard of the newest of them.
            for own in state.shown() {
                let entry =
                    || GraphEntry { endpoint: Arc::new(own.clone()), daemon: None, reach: None };
                view.endpoints.entry(own.gid).or_insert_with(entry);
            }
            state.graph.view = Arc::new(view);
        }
        self.endpoints_over(&over);
        if !graph.more {
            let unrepeated = self.pairs.end_whole();
            let told = unrepeated.is_some();
            if let Some(unrepeated) = unrepeated {
                self.drop_pairs(&unrepeated);
                // An answer may have been among what was too much for this session.
                self.shared.core.memory.begins_anew();
            }
            self.drop_unread(told);
            self.graph_changed = true;
        }
    }

    /// A publisher's, server's or client's readers changed.
    pub(super) fn writer_changed(&mut self, publisher: &Arc<PublisherInner>) {
        self.rematching.writers.insert(publisher.endpoint.gid, publisher.clone());
    }

    /// A subscription's, server's or client's writers changed.
    pub(super) fn reader_changed(&mut self, subscription: &Arc<SubscriptionInner>) {
        self.rematching.readers.insert(subscription.endpoint.gid, subscription.clone());
    }

    /// Counts what became of pairs, once for each endpoint: where many come at a time, what is counted
    /// is all of them each time.
    pub(super) fn tell_matched(&mut self) {
        let Rematching { writers, readers } = std::mem::take(&mut self.rematching);
        let writers = writers.into_values().map(EventSource::Publisher);
        for source in writers.chain(readers.into_values().map(EventSource::Subscription)) {
            self.rematched(source.rematch(), &source);
        }
    }

    fn rematched(&mut self, changes: Changes, source: &EventSource) {
        let own = source.endpoint();
        for other in changes.added {
            self.stands(&match source {
                EventSource::Publisher(_) => Pair { reader: other, writer: own.gid },
                EventSource::Subscription(_) => Pair { reader: own.gid, writer: other },
            });
        }
        self.note_timed(source);
        // Whether a service is available is no more than that.
        self.graph_changed |= matches!(own.kind, EndpointKind::Server | EndpointKind::Client);
        self.shared.notify(Some(&SessionEvent::Matched(own.gid)));
    }

    /// Tells what other threads of the session changed.
    pub(super) fn tell_rematched(&mut self) {
        let (rematched, regraphed) = {
            let mut state = self.shared.state();
            (std::mem::take(&mut state.rematched), state.graph.take_changed())
        };
        self.graph_changed |= regraphed;
        for (changes, source) in rematched {
            self.rematched(changes, &source);
        }
    }

    /// An endpoint of the session is gone: nobody waits for its pairs.
    pub(super) fn own_gone(&mut self, gid: &Gid) {
        for entry in self.arrivals.own_gone(gid) {
            self.show(entry);
        }
    }

    /// Shows what has been held back for long enough, and tells of the graph where it changed.
    pub(super) fn tell_graph(&mut self) {
        for entry in self.arrivals.overdue(Instant::now()) {
            self.show(entry);
        }
        if std::mem::take(&mut self.graph_changed) {
            self.shared.notify(Some(&SessionEvent::Graph));
        }
    }

    fn stands(&mut self, pair: &Pair) {
        if let Some(entry) = self.arrivals.pair_up(pair) {
            self.show(entry);
        }
    }

    fn appear(&mut self, entry: GraphEntry) {
        let endpoint = &entry.endpoint;
        let own = endpoint.gid.0[..12] == self.shared.core.id.0[..12];
        if own {
            let state = self.shared.state();
            // It may have ended since it was announced: the daemon will say so.
            if state.graph.tombstones.contains(&endpoint.gid)
                || state.endpoints.leaving.contains_key(&endpoint.gid)
                || state.graph.refused.contains_key(&endpoint.gid)
            {
                return;
            }
        }
        self.relate(endpoint);
        let shown = self.building.is_some()
            && self.shared.state().graph.view.endpoints.contains_key(&endpoint.gid);
        let missing = if own || shown { BTreeSet::new() } else { self.missing(endpoint) };
        if missing.is_empty() {
            self.show(entry);
        } else {
            self.arrivals.hold(entry, missing, Instant::now());
        }
    }

    fn disappear(&mut self, gid: &Gid) {
        let mut entry = self.arrivals.remove(gid);
        self.view(|view| entry = view.endpoints.remove(gid).or(entry.take()));
        let Some(entry) = entry else { return };
        if let Some(gids) = self.topics.get_mut(&entry.endpoint.topic) {
            gids.remove(gid);
            if gids.is_empty() {
                self.topics.remove(&entry.endpoint.topic);
            }
        }
        for own in self.own(&entry.endpoint.topic) {
            own.events().forget(gid);
        }
    }

    fn show(&mut self, entry: GraphEntry) {
        self.graph_changed = true;
        self.topics.entry(entry.endpoint.topic.clone()).or_default().insert(entry.endpoint.gid);
        self.view(|view| drop(view.endpoints.insert(entry.endpoint.gid, entry)));
    }

    /// Changes the view that is being built, or else the one that is shown.
    fn view(&mut self, change: impl FnOnce(&mut GraphView)) {
        match &mut self.building {
            Some(view) => change(view),
            None => change(Arc::make_mut(&mut self.shared.state().graph.view)),
        }
    }

    /// The pairs that an endpoint makes with the session's own and that do not stand yet.
    fn missing(&self, other: &Endpoint) -> BTreeSet<Pair> {
        let state = self.shared.state();
        let mut missing = BTreeSet::new();
        for own in state.endpoints.topics.get(&other.topic).into_iter().flatten() {
            if let Some(writer) = state.endpoints.publishers.get(own)
                && pairing(&writer.endpoint, other) == Pairing::Match
                && !writer.events.is_matched(&other.gid)
            {
                missing.insert(Pair { reader: other.gid, writer: *own });
            }
            if let Some(reader) = state.endpoints.subscriptions.get(own)
                && pairing(other, &reader.endpoint) == Pairing::Match
                && !reader.events.is_matched(&other.gid)
            {
                missing.insert(Pair { reader: *own, writer: other.gid });
            }
        }
        missing
    }

    /// Reports to the session's endpoints that one does not go with them, and, if it is of this
    /// session, to it that others do not. The endpoint that comes second finds the first.
    fn relate(&self, endpoint: &Endpoint) {
        let here = self.own(&endpoint.topic);
        // One of its own may have ended since it was announced, and others begun that never met it.
        let is_own = |gid: &Gid| gid.0[..12] == self.shared.core.id.0[..12];
        let ended = |gid: &Gid| is_own(gid) && here.iter().all(|own| own.endpoint().gid != *gid);
        if ended(&endpoint.gid) {
            return;
        }
        for source in here.iter().filter(|source| source.endpoint().gid != endpoint.gid) {
            self.report(source, endpoint);
        }
        let Some(source) = here.iter().find(|source| source.endpoint().gid == endpoint.gid) else {
            return;
        };
        let shown = self.shared.state().graph.view.clone();
        let shown = self.building.as_ref().unwrap_or(&shown);
        // The session's own that nobody was told of yet are met when they are told.
        let others = self.topics.get(&endpoint.topic).into_iter().flatten();
        let others = others.filter_map(|gid| shown.endpoints.get(gid));
        for other in others.chain(self.arrivals.entries()) {
            if !ended(&other.endpoint.gid) {
                self.report(source, &other.endpoint);
            }
        }
    }

    fn report(&self, own: &EventSource, other: &Endpoint) {
        let verdict = match own {
            EventSource::Publisher(writer) => pairing(&writer.endpoint, other),
            EventSource::Subscription(reader) => pairing(other, &reader.endpoint),
        };
        let differs = !matches!(verdict, Pairing::Match | Pairing::Unrelated);
        if differs && own.events().incompatible(other.gid, verdict) {
            self.shared.core.segment.notify();
        }
    }

    /// The session's publishers and subscriptions of a topic.
    fn own(&self, topic: &str) -> Vec<EventSource> {
        let state = self.shared.state();
        let mut own = Vec::new();
        for gid in state.endpoints.topics.get(topic).into_iter().flatten() {
            let publisher = state.endpoints.publishers.get(gid);
            if let Some(inner) = publisher.filter(|p| p.endpoint.kind == EndpointKind::Publisher) {
                own.push(EventSource::Publisher(inner.clone()));
            }
            let subscription = state.endpoints.subscriptions.get(gid);
            let is = |s: &&Arc<SubscriptionInner>| s.endpoint.kind == EndpointKind::Subscription;
            if let Some(inner) = subscription.filter(is) {
                own.push(EventSource::Subscription(inner.clone()));
            }
        }
        own
    }
}
