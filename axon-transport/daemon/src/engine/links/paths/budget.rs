//! A budget for events that a peer can cause: some may follow each other at once, further ones have a pause.

use std::time::Duration;

/// A rate of events.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rate {
    /// Time between two events in the long run.
    pub(super) pause: Duration,
    /// Number of events without a pause.
    pub(super) at_once: u32,
}

/// The events of a peer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Budget {
    /// The time from which on all events at once are permitted again.
    full_at: Duration,
}

impl Budget {
    /// Returns the time from which on the next event is permitted.
    pub(super) fn due(&self, rate: Rate) -> Duration {
        self.full_at.saturating_sub(rate.pause * rate.at_once.saturating_sub(1))
    }

    /// Records an event.
    pub(super) fn pay(&mut self, rate: Rate, now: Duration) {
        self.full_at = self.full_at.max(now) + rate.pause;
    }

    /// Returns whether no event counts any more.
    pub(super) fn is_full(&self, now: Duration) -> bool {
        self.full_at <= now
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: Rate = Rate { pause: Duration::from_secs(5), at_once: 3 };

    #[test]
    fn events_at_once_are_followed_by_one_each_pause() {
        // A daemon that has just started has the whole budget.
        for start in [Duration::ZERO, Duration::from_secs(1000)] {
            let mut budget = Budget::default();
            for _ in 0..3 {
                assert!(budget.due(RATE) <= start);
                budget.pay(RATE, start);
            }
            for event in 1..10 {
                assert_eq!(budget.due(RATE), start + RATE.pause * event);
                budget.pay(RATE, budget.due(RATE));
            }
            assert!(!budget.is_full(start + RATE.pause * 11));
            assert!(budget.is_full(start + RATE.pause * 12));
        }
    }
}
