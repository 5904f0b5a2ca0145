//! Deadlines and leases: checked when the next one may expire, and never if none is finite.

use std::{sync::Arc, time::Duration};

use crate::session::{clock, endpoint_state::EventSource, state::SessionShared};

/// The endpoints of the session with deadlines or leases.
pub(super) struct TimedEndpoints {
    shared: Arc<SessionShared>,
    /// The endpoints; `None` if the list must be rebuilt.
    endpoints: Option<Vec<EventSource>>,
    /// The time of the next check, in nanoseconds of the monotonic clock.
    due: Option<u64>,
}

impl TimedEndpoints {
    /// Creates the list of a session without endpoints.
    pub(super) fn new(shared: Arc<SessionShared>) -> Self {
        Self { shared, endpoints: None, due: None }
    }

    /// Records that an endpoint was created or that its matches changed. If it has a deadline or a lease, the list is
    /// rebuilt.
    pub(super) fn handle_changed(&mut self, source: &EventSource) {
        let is_listed = |endpoints: &Vec<EventSource>| {
            endpoints.iter().any(|other| other.endpoint().gid == source.endpoint().gid)
        };
        if is_timed(source) || self.endpoints.as_ref().is_some_and(is_listed) {
            self.endpoints = None;
        }
    }

    /// Records that an endpoint ended.
    pub(super) fn handle_gone(&mut self) {
        self.endpoints = None;
    }

    /// Returns the time until [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        Some(Duration::from_nanos(self.due?.saturating_sub(clock::monotonic())))
    }

    /// Checks deadlines and leases if one may have expired or the list must be rebuilt.
    pub(super) fn handle_timeout(&mut self) {
        let now = clock::monotonic();
        let endpoints = match self.endpoints.take() {
            Some(endpoints) if self.due.is_none_or(|due| due > now) => {
                self.endpoints = Some(endpoints);
                return;
            }
            Some(endpoints) => endpoints,
            None => self.find(),
        };
        let mut any_event = false;
        self.due = None;
        for source in &endpoints {
            let (due, is_event) = source.look_at_time(now);
            self.due = self.due.into_iter().chain(due).min();
            any_event |= is_event;
        }
        if any_event {
            // Wakes the threads that wait for events.
            self.shared.core.segment.notify();
        }
        self.endpoints = Some(endpoints);
    }

    fn find(&self) -> Vec<EventSource> {
        let (publishers, subscriptions) = self.shared.state().endpoints.all();
        let publishers = publishers.into_iter().map(EventSource::Publisher);
        let all = publishers.chain(subscriptions.into_iter().map(EventSource::Subscription));
        all.filter(is_timed).collect()
    }
}

/// Returns whether an endpoint has a deadline, or a lease of its own or of a publisher.
fn is_timed(source: &EventSource) -> bool {
    match source {
        EventSource::Publisher(publisher) => {
            let qos = &publisher.endpoint.qos;
            qos.deadline.is_some() || qos.lease.is_some()
        }
        EventSource::Subscription(subscription) => {
            subscription.endpoint.qos.deadline.is_some()
                || subscription.lock().slots().offers_lease()
        }
    }
}
