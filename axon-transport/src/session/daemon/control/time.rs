//! Deadlines and leases: checked when the next one may expire, and never if none is finite.

use std::time::{Duration, Instant};

use super::Control;
use crate::session::{clock, events::Source};

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
            self.shared.segment.notify();
        }
        self.timed = Some(timed);
    }

    /// Has those who wait look again, where the time for it has come. When it will, else.
    pub(super) fn look_again(&self) -> Option<Instant> {
        let mut state = self.shared.state();
        let again = state.again.take_if(|again| *again <= Instant::now());
        let next = state.again;
        drop(state);
        if again.is_some() {
            self.shared.segment.mark_all_active();
            self.shared.segment.notify();
        }
        next
    }

    /// How long until the next look.
    pub(super) fn until_alarm(&self) -> Option<Duration> {
        let alarm = self.alarm?;
        Some(Duration::from_nanos(alarm.saturating_sub(clock::monotonic())))
    }

    fn find_timed(&self) -> Vec<Source> {
        let (publishers, subscriptions) = self.endpoints();
        let publishers = publishers.into_iter().filter(|publisher| {
            publisher.endpoint.qos.deadline.is_some() || publisher.endpoint.qos.lease.is_some()
        });
        let subscriptions = subscriptions.into_iter().filter(|subscription| {
            subscription.endpoint.qos.deadline.is_some() || subscription.lock().offers_lease()
        });
        let publishers = publishers.map(Source::Publisher);
        publishers.chain(subscriptions.map(Source::Subscription)).collect()
    }
}
