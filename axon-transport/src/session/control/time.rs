//! Deadlines and leases: checked when the next one may expire, and never if none is finite.

use std::time::{Duration, Instant};

use super::Control;
use crate::session::{clock, sides::EventSource};

impl Control {
    pub(super) fn look_at_time(&mut self) {
        let now = clock::monotonic();
        let timed = match self.timed.take() {
            Some(timed) if self.alarm.is_none_or(|alarm| alarm > now) => {
                self.timed = Some(timed);
                return;
            }
            Some(timed) => timed,
            None => self.find_timed(),
        };
        let mut news = false;
        self.alarm = None;
        for source in &timed {
            let (due, some) = source.look_at_time(now);
            self.alarm = self.alarm.into_iter().chain(due).min();
            news |= some;
        }
        if news {
            // Wakes the threads that wait for events.
            self.shared.core.segment.notify();
        }
        self.timed = Some(timed);
    }

    /// Has those who wait look again, where the time for it has come. When it will, else.
    pub(super) fn look_again(&self) -> Option<Instant> {
        let (due, next) = self.shared.core.listening.take_due(Instant::now());
        if due {
            self.shared.core.segment.mark_all_active();
            self.shared.core.segment.notify();
        }
        next
    }

    /// How long until the next look.
    pub(super) fn until_alarm(&self) -> Option<Duration> {
        let alarm = self.alarm?;
        Some(Duration::from_nanos(alarm.saturating_sub(clock::monotonic())))
    }

    /// An endpoint came, or its matches changed. If it has times to be looked at, those of all are found anew.
    pub(super) fn note_timed(&mut self, source: &EventSource) {
        let watched = |timed: &Vec<EventSource>| {
            timed.iter().any(|other| other.endpoint().gid == source.endpoint().gid)
        };
        if is_timed(source) || self.timed.as_ref().is_some_and(watched) {
            self.timed = None;
        }
    }

    fn find_timed(&self) -> Vec<EventSource> {
        let (publishers, subscriptions) = self.endpoints();
        let publishers = publishers.into_iter().map(EventSource::Publisher);
        let all = publishers.chain(subscriptions.into_iter().map(EventSource::Subscription));
        all.filter(is_timed).collect()
    }
}

/// Whether somebody watches its deadlines or leases.
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
