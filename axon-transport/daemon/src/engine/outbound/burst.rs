//! Decides whether the samples of a KEEP_LAST flow are a burst, which is lossless, or the flow is behind.

use std::time::Duration;

/// The maximum length of a burst.
const MAX_BURST: Duration = Duration::from_millis(500);

/// The time for which samples may wait before the flow is behind. It is used up while samples wait, and comes back at
/// the same rate while none waits. So a flow that catches up for a moment, between two samples that are too many, stays
/// behind.
#[derive(Debug)]
pub(super) struct Burst {
    /// The time that was left when samples began to wait, or when the flow caught up.
    left: Duration,
    /// The time since which samples wait, here or in the ring; `None` if none waits.
    since: Option<Duration>,
    /// The time at which the flow caught up.
    caught_up_at: Duration,
}

impl Default for Burst {
    fn default() -> Self {
        Self { left: MAX_BURST, since: None, caught_up_at: Duration::ZERO }
    }
}

impl Burst {
    /// Records that a sample waits.
    pub(super) fn handle_waiting(&mut self, now: Duration) {
        if self.since.is_none() {
            let idle = now.saturating_sub(self.caught_up_at);
            self.left = self.left.saturating_add(idle).min(MAX_BURST);
            self.since = Some(now);
        }
    }

    /// Records that no sample waits.
    pub(super) fn handle_caught_up(&mut self, now: Duration) {
        if let Some(since) = self.since.take() {
            self.left = self.left.saturating_sub(now.saturating_sub(since));
            self.caught_up_at = now;
        }
    }

    /// Returns whether samples have waited for so long that this is no burst.
    pub(super) fn is_over(&self, now: Duration) -> bool {
        self.since.is_some_and(|since| now.saturating_sub(since) >= self.left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn a_burst_may_be_long_after_a_pause_as_long() {
        let mut burst = Burst::default();
        burst.handle_waiting(at(1_000));
        assert!(!burst.is_over(at(1_499)) && burst.is_over(at(1_500)));
        burst.handle_caught_up(at(2_000));
        assert!(!burst.is_over(at(9_000)), "nothing waits");
        burst.handle_waiting(at(2_500));
        assert!(!burst.is_over(at(2_999)) && burst.is_over(at(3_000)));
    }

    #[test]
    fn a_flow_that_catches_up_for_moments_stays_behind() {
        let mut burst = Burst::default();
        for round in 0..10 {
            let now = at(1_000 * round);
            burst.handle_waiting(now);
            burst.handle_caught_up(now + at(990));
        }
        burst.handle_waiting(at(10_000));
        assert!(!burst.is_over(at(10_009)) && burst.is_over(at(10_010)));
    }

    #[test]
    fn samples_that_wait_a_little_each_use_up_nothing_that_does_not_come_back() {
        let mut burst = Burst::default();
        for round in 0..1_000 {
            let now = at(33 * round);
            burst.handle_waiting(now);
            burst.handle_waiting(now + at(5));
            burst.handle_caught_up(now + at(12));
        }
        burst.handle_waiting(at(40_000));
        assert!(!burst.is_over(at(40_499)));
    }
}
