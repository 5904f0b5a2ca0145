//! Counts the pairs of the session's endpoints, and reports changes as events.

use std::{collections::BTreeMap, sync::Arc};

use super::{graph::GraphFollower, time::TimedEndpoints};
use crate::{
    graph::EndpointKind,
    ids::Gid,
    session::{
        core::SessionEvent,
        endpoint_state::{Changes, EventSource, PublisherInner, SubscriptionInner},
        state::SessionShared,
    },
    wire::session::Pair,
};

/// The endpoints of the session whose pairs changed since the last count. If many pairs of an endpoint
/// change at once, they are counted once.
pub(super) struct ChangedMatches {
    shared: Arc<SessionShared>,
    writers: BTreeMap<Gid, Arc<PublisherInner>>,
    readers: BTreeMap<Gid, Arc<SubscriptionInner>>,
}

impl ChangedMatches {
    /// Creates an empty list.
    pub(super) fn new(shared: Arc<SessionShared>) -> Self {
        Self { shared, writers: BTreeMap::new(), readers: BTreeMap::new() }
    }

    /// Records that a publisher's, server's or client's readers changed.
    pub(super) fn add_writer(&mut self, publisher: &Arc<PublisherInner>) {
        self.writers.insert(publisher.endpoint.gid, publisher.clone());
    }

    /// Records that a subscription's, server's or client's writers changed.
    pub(super) fn add_reader(&mut self, subscription: &Arc<SubscriptionInner>) {
        self.readers.insert(subscription.endpoint.gid, subscription.clone());
    }

    /// Counts the pairs of the recorded endpoints, and reports the changes.
    pub(super) fn report(&mut self, graph: &mut GraphFollower, timed: &mut TimedEndpoints) {
        let writers = std::mem::take(&mut self.writers).into_values().map(EventSource::Publisher);
        let readers = std::mem::take(&mut self.readers).into_values();
        for source in writers.chain(readers.map(EventSource::Subscription)) {
            self.report_of(source.rematch(), &source, graph, timed);
        }
    }

    /// Reports the changes that other threads of the session made.
    pub(super) fn report_others(&self, graph: &mut GraphFollower, timed: &mut TimedEndpoints) {
        let (rematched, graph_changed) = {
            let mut state = self.shared.state();
            (std::mem::take(&mut state.rematched), state.graph.take_changed())
        };
        if graph_changed {
            graph.set_changed();
        }
        for (changes, source) in rematched {
            self.report_of(changes, &source, graph, timed);
        }
    }

    fn report_of(
        &self,
        changes: Changes,
        source: &EventSource,
        graph: &mut GraphFollower,
        timed: &mut TimedEndpoints,
    ) {
        let own = source.endpoint();
        for other in changes.added {
            graph.handle_matched(&match source {
                EventSource::Publisher(_) => Pair { reader: other, writer: own.gid },
                EventSource::Subscription(_) => Pair { reader: own.gid, writer: other },
            });
        }
        timed.handle_changed(source);
        // A service is available if its server and client are matched.
        if matches!(own.kind, EndpointKind::Server | EndpointKind::Client) {
            graph.set_changed();
        }
        self.shared.notify(Some(&SessionEvent::Matched(own.gid)));
    }
}
