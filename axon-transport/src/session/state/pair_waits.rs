//! Limits how long new endpoints wait for endpoints of other hosts. For one endpoint, the wait is convenient; a
//! thousand endpoints that are created one after the other would keep their program waiting for a minute, while they
//! could be matched together.
//!
//! Plain data.

use std::time::{Duration, Instant};

/// Pairs on one host take less than this.
const LOCAL_PAIR_TIME: Duration = Duration::from_millis(5);
/// Factor for the pause after a longer wait: for so many times its duration, other endpoints do not wait.
const PAUSE_FACTOR: u32 = 9;

/// The waits of one session.
#[derive(Debug, Default)]
pub(super) struct PairWaits {
    not_before: Option<Instant>,
}

impl PairWaits {
    /// Returns whether a new endpoint waits for endpoints of other hosts now.
    pub(super) fn are_due(&self, now: Instant) -> bool {
        self.not_before.is_none_or(|due| due <= now)
    }

    /// Records that an endpoint has waited for this time.
    pub(super) fn waited(&mut self, time: Duration, now: Instant) {
        if time > LOCAL_PAIR_TIME {
            self.not_before = Some(now + PAUSE_FACTOR * time);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_wait_a_tenth_of_the_time_where_each_takes_long() {
        let (mut waits, mut now) = (PairWaits::default(), Instant::now());
        let mut waited = 0;
        // Each endpoint takes a millisecond, or fifty if it waits.
        for _ in 0..1000 {
            if waits.are_due(now) {
                let time = Duration::from_millis(50);
                now += time;
                waits.waited(time, now);
                waited += 1;
            }
            now += Duration::from_millis(1);
        }
        assert_eq!(waited, 3);
    }

    #[test]
    fn endpoints_wait_each_time_where_that_is_short() {
        let (mut waits, mut now) = (PairWaits::default(), Instant::now());
        for _ in 0..1000 {
            assert!(waits.are_due(now));
            now += LOCAL_PAIR_TIME;
            waits.waited(LOCAL_PAIR_TIME, now);
        }
    }
}
