//! The graph that the session shows, as the daemon's messages change it.

use std::{collections::BTreeSet, sync::Arc, time::Instant};

use super::pending_endpoints::PendingEndpoints;
use crate::{
    graph::{Endpoint, EndpointKind, GraphEntry, Pairing, pairing},
    ids::Gid,
    session::{
        core::SessionEvent,
        endpoint_state::EventSource,
        state::{IndexedView, SessionShared, SessionState},
    },
    wire::session::Pair,
};

/// The graph that the session shows, as the daemon's messages change it.
pub(super) struct GraphFollower {
    shared: Arc<SessionShared>,
    /// A full graph that is still incomplete.
    building: Option<IndexedView>,
    arrivals: PendingEndpoints,
    /// True if the graph changed since it was last reported.
    changed: bool,
}

impl GraphFollower {
    /// Creates the follower of a graph that is empty yet.
    pub(super) fn new(shared: Arc<SessionShared>) -> Self {
        Self { shared, building: None, arrivals: PendingEndpoints::default(), changed: false }
    }

    /// Forgets an incomplete graph of the previous daemon.
    pub(super) fn handle_connected(&mut self) {
        self.building = None;
    }

    /// Begins a full graph, which replaces the shown one when it is complete.
    pub(super) fn begin_whole(&mut self) {
        self.building = Some(IndexedView::default());
        self.arrivals.restart();
    }

    /// Removes endpoints that ended.
    pub(super) fn remove(&mut self, removed: Vec<Gid>) {
        {
            let mut state = self.shared.state();
            removed.iter().for_each(|gid| {
                state.graph.tombstones.remove(gid);
            });
        }
        removed.iter().for_each(|gid| self.disappear(gid));
    }

    /// Adds endpoints, or changes of endpoints. They appear once their pairs with endpoints of this session
    /// are attached.
    pub(super) fn add(&mut self, added: impl IntoIterator<Item = GraphEntry>) {
        added.into_iter().for_each(|entry| self.appear(entry));
    }

    /// Sets the version up to which the daemon has sent the graph.
    pub(super) fn set_version(&mut self, version: u64) {
        self.view(|view| view.set_version(version));
    }

    /// Shows the full graph that was begun, if any.
    pub(super) fn end_whole(&mut self) {
        let Some(mut whole) = self.building.take() else { return };
        let mut state = self.shared.state();
        // The daemon may have sent the full graph before it received the newest endpoints.
        for own in state.shown() {
            if !whole.contains(&own.gid) {
                let endpoint = Arc::new(own.clone());
                whole.insert(GraphEntry { endpoint, daemon: None, reach: None });
            }
        }
        state.graph.indexed = whole;
    }

    /// Records that the graph, or the availability of a service, changed.
    pub(super) fn set_changed(&mut self) {
        self.changed = true;
    }

    /// Shows the endpoint that waited for this pair and for no other.
    pub(super) fn handle_matched(&mut self, pair: &Pair) {
        if let Some(entry) = self.arrivals.pair_up(pair) {
            self.show(entry);
        }
    }

    /// Shows the endpoints that waited only for pairs with this endpoint of the session, because it ended.
    pub(super) fn handle_own_gone(&mut self, gid: &Gid) {
        for entry in self.arrivals.own_gone(gid) {
            self.show(entry);
        }
    }

    /// Returns the time at which the next endpoint has waited long enough for its pairs.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.arrivals.due()
    }

    /// Shows the endpoints that have waited long enough, and reports the graph if it changed.
    pub(super) fn report_changes(&mut self) {
        for entry in self.arrivals.overdue(Instant::now()) {
            self.show(entry);
        }
        if std::mem::take(&mut self.changed) {
            self.shared.notify(Some(&SessionEvent::Graph));
        }
    }

    fn appear(&mut self, entry: GraphEntry) {
        let endpoint = &entry.endpoint;
        let own = endpoint.gid.0[..12] == self.shared.core.id.0[..12];
        if own {
            let state = self.shared.state();
            // The endpoint may have ended since it was announced: the daemon will report that.
            if state.graph.tombstones.contains(&endpoint.gid)
                || state.endpoints.leaving.contains_key(&endpoint.gid)
                || state.graph.refused.contains_key(&endpoint.gid)
            {
                return;
            }
        }
        self.relate(endpoint);
        let shown =
            self.building.is_some() && self.shared.state().graph.indexed.contains(&endpoint.gid);
        let missing = if own || shown { BTreeSet::new() } else { self.missing(endpoint) };
        if missing.is_empty() {
            self.show(entry);
        } else {
            self.arrivals.hold(entry, missing, Instant::now());
        }
    }

    fn disappear(&mut self, gid: &Gid) {
        let mut entry = self.arrivals.remove(gid);
        self.view(|view| entry = view.remove(gid).or(entry.take()));
        let Some(entry) = entry else { return };
        for own in self.counterparts(&entry.endpoint) {
            own.events().forget(gid);
        }
    }

    fn show(&mut self, entry: GraphEntry) {
        self.changed = true;
        self.view(|view| view.insert(entry));
    }

    /// Changes the view that is being built, otherwise the one that is shown.
    fn view(&mut self, change: impl FnOnce(&mut IndexedView)) {
        match &mut self.building {
            Some(view) => change(view),
            None => change(&mut self.shared.state().graph.indexed),
        }
    }

    /// Returns the pairs of an endpoint with the session's own endpoints that are not attached yet.
    fn missing(&self, other: &Endpoint) -> BTreeSet<Pair> {
        let state = self.shared.state();
        let mut missing = BTreeSet::new();
        for own in state.endpoints.topics.counterparts(other) {
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

    /// Reports an endpoint to the session's endpoints that are incompatible with it. If it is an endpoint
    /// of this session, also reports incompatible endpoints to it. The endpoint that comes second finds the
    /// first.
    fn relate(&self, endpoint: &Endpoint) {
        let mut found = Vec::new();
        let source = {
            let state = self.shared.state();
            // An own endpoint may have ended since it was announced. Own endpoints that began later never met
            // it.
            let is_own = |one: &Endpoint| one.gid.is_of(&self.shared.core.id);
            let ended = |one: &Endpoint| is_own(one) && !state.endpoints.topics.contains(one);
            if ended(endpoint) {
                return;
            }
            let source = is_own(endpoint).then(|| source(&state, &endpoint.gid)).flatten();
            if source.is_some() {
                // Own endpoints that are not announced yet are compared once more when they are announced.
                let shown = self.building.as_ref().unwrap_or(&state.graph.indexed);
                let arrivals = self.arrivals.entries();
                let arrivals = arrivals.filter(|one| one.endpoint.topic == endpoint.topic);
                let shown = shown.counterparts(endpoint).chain(arrivals);
                found.extend(
                    shown.filter(|one| !ended(&one.endpoint)).map(|one| one.endpoint.clone()),
                );
            }
            source
        };
        for own in self.counterparts(endpoint) {
            self.report(&own, endpoint);
        }
        if let Some(source) = source {
            found.iter().for_each(|other| self.report(&source, other));
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

    /// Returns the session's publishers or subscriptions on the topic of `other`, of the kind that communicates with it.
    fn counterparts(&self, other: &Endpoint) -> Vec<EventSource> {
        let state = self.shared.state();
        state.endpoints.topics.counterparts(other).filter_map(|own| source(&state, own)).collect()
    }
}

/// Returns the session's publisher or subscription with this GID. The sides of services have no such events.
fn source(state: &SessionState, own: &Gid) -> Option<EventSource> {
    let publisher = state.endpoints.publishers.get(own);
    if let Some(inner) = publisher.filter(|p| p.endpoint.kind == EndpointKind::Publisher) {
        return Some(EventSource::Publisher(inner.clone()));
    }
    let subscription = state.endpoints.subscriptions.get(own);
    let inner = subscription.filter(|s| s.endpoint.kind == EndpointKind::Subscription)?;
    Some(EventSource::Subscription(inner.clone()))
}
