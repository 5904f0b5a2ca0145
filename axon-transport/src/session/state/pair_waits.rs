//! Limits how long new endpoints wait for their pairs. For one endpoint, the wait is convenient. A thousand endpoints that
//! are created one after the other would keep their program waiting for seconds on a busy host, and for a minute where
//! other hosts are involved. They can be matched together.
//!
//! Plain data.

use std::time::{Duration, Instant};

/// Pairs on one host take less than this.
const LOCAL_PAIR_TIME: Duration = Duration::from_millis(5);
/// Factor for the pause after waiting: for this many times its duration, other endpoints do not wait.
const PAUSE_FACTOR: u32 = 9;
/// The time that endpoints may wait one after the other before the pause applies to pairs on one host.
const ALLOWANCE: Duration = Duration::from_millis(100);

/// The waits of one session.
#[derive(Debug, Default)]
pub(super) struct PairWaits {
    not_before: Option<Instant>,
    /// The time that was waited and that pauses have not paid off, at the time of the last wait.
    owed: Option<(Duration, Instant)>,
}

impl PairWaits {
    /// Returns whether a new endpoint waits at all now.
    pub(super) fn are_due(&self, now: Instant) -> bool {
        self.owed_at(now) < ALLOWANCE
    }

    /// Returns whether a new endpoint also waits for endpoints of other hosts now.
    pub(super) fn are_due_far(&self, now: Instant) -> bool {
        self.not_before.is_none_or(|due| due <= now)
    }

    /// Records that an endpoint has waited for this time; `far` if for an endpoint of another host.
    pub(super) fn waited(&mut self, time: Duration, far: bool, now: Instant) {
        if far && time > LOCAL_PAIR_TIME {
            // A slow host must not use up the time for pairs on this one.
            self.not_before = Some(now + PAUSE_FACTOR * time);
            return;
        }
        // Threads that wait at the same time wait once for the program.
        self.owed = Some(((self.owed_at(now) + time).min(2 * ALLOWANCE), now));
    }

    fn owed_at(&self, now: Instant) -> Duration {
        let owed = |(owed, at): (Duration, Instant)| {
            owed.saturating_sub(now.saturating_duration_since(at) / PAUSE_FACTOR)
        };
        self.owed.map(owed).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates endpoints that take `time` if they wait, otherwise a millisecond. Returns how many waited.
    fn waited(endpoints: usize, time: Duration, far: bool) -> usize {
        let (mut waits, mut now) = (PairWaits::default(), Instant::now());
        let mut waited = 0;
        for _ in 0..endpoints {
            if waits.are_due(now) && (!far || waits.are_due_far(now)) {
                now += time;
                waits.waited(time, far, now);
                waited += 1;
            }
            now += Duration::from_millis(1);
        }
        waited
    }

    #[test]
    fn far_endpoints_wait_a_tenth_of_the_time_where_each_takes_long() {
        assert_eq!(waited(1000, Duration::from_millis(50), true), 3);
    }

    #[test]
    fn endpoints_wait_each_time_where_that_is_short() {
        assert_eq!(waited(1000, Duration::from_micros(100), false), 1000);
        assert_eq!(waited(20, LOCAL_PAIR_TIME, false), 20);
        assert_eq!(waited(20, LOCAL_PAIR_TIME, true), 20);
    }

    #[test]
    fn near_endpoints_wait_for_the_allowance_and_then_a_tenth_of_the_time() {
        let time = Duration::from_millis(2);
        let waited = waited(1000, time, false) as u32;
        let whole = Duration::from_secs(1) + waited * time;
        assert!(waited * time <= ALLOWANCE + whole / PAUSE_FACTOR + time, "{waited} waited");
        assert!(waited >= 50, "the allowance is used: {waited}");
    }

    #[test]
    fn waits_of_many_threads_at_the_same_time_count_as_few() {
        let (mut waits, now) = (PairWaits::default(), Instant::now());
        (0..100).for_each(|_| waits.waited(Duration::from_millis(50), false, now));
        assert!(!waits.are_due(now));
        assert!(waits.are_due(now + PAUSE_FACTOR * (ALLOWANCE + LOCAL_PAIR_TIME)));
    }

    #[test]
    fn wait_for_another_host_leaves_the_time_for_pairs_on_this_one() {
        let (mut waits, now) = (PairWaits::default(), Instant::now());
        (0..10).for_each(|_| waits.waited(Duration::from_millis(50), true, now));
        assert!(waits.are_due(now) && !waits.are_due_far(now));
    }

    #[test]
    fn allowance_is_restored_and_not_saved_up() {
        let (mut waits, now) = (PairWaits::default(), Instant::now());
        waits.waited(ALLOWANCE, false, now);
        assert!(!waits.are_due(now));
        assert!(waits.are_due(now + Duration::from_millis(10)));
        waits.waited(ALLOWANCE, false, now + PAUSE_FACTOR * ALLOWANCE);
        assert!(!waits.are_due(now + PAUSE_FACTOR * ALLOWANCE), "it is not saved up");
    }
}
