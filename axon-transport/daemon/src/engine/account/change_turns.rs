//! Limits the pace of work on a peer's control messages: turns for the work that they cause, so that a busy peer leaves
//! time for other peers.

use std::time::Duration;

use crate::token_bucket::TokenBucket;

/// Number of turns at once, and per second.
const TURNS: (u32, u32) = (32, 10);
/// Factor for the pause after a turn: other peers get this many times its duration.
const OTHERS: u32 = 9;

/// The time of the next turn, in which the consequences of a peer's changes are computed. Changes in between are
/// handled together: the newest state counts.
#[derive(Debug)]
pub(crate) struct ChangeTurns {
    bucket: TokenBucket,
    not_before: Option<Duration>,
}

impl Default for ChangeTurns {
    fn default() -> Self {
        Self { bucket: TokenBucket::new(TURNS.0, TURNS.1), not_before: None }
    }
}

impl ChangeTurns {
    /// Returns the time until the next turn.
    pub(crate) fn wait(&mut self, now: Duration) -> Duration {
        self.rest(now).max(self.bucket.wait(now))
    }

    /// Takes a turn if it is time for one. Returns whether it did.
    pub(crate) fn take(&mut self, now: Duration) -> bool {
        self.rest(now).is_zero() && self.bucket.take(now)
    }

    /// Records that a turn which began at `began` is over.
    pub(crate) fn over(&mut self, began: Duration, now: Duration) {
        self.not_before = Some(now + now.saturating_sub(began) * OTHERS);
    }

    fn rest(&self, now: Duration) -> Duration {
        self.not_before.map_or(Duration::ZERO, |at| at.saturating_sub(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1000);

    fn second(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn single_changes_follow_at_once_and_those_of_a_flood_together() {
        let (mut turns, start) = (ChangeTurns::default(), NOW);
        for _ in 0..TURNS.0 {
            assert!(turns.take(start));
            turns.over(start, start);
        }
        assert!(!turns.take(start));
        assert_eq!(turns.wait(start), second(100));
        let floods = (0..10_000).filter(|at| turns.take(start + second(*at))).count();
        assert!((99..=101).contains(&floods), "{floods} turns in ten seconds");
    }

    #[test]
    fn a_turn_that_takes_long_leaves_the_others_nine_times_as_long() {
        let (mut turns, start) = (ChangeTurns::default(), NOW);
        assert!(turns.take(start));
        turns.over(start, start + second(50));
        assert!(!turns.take(start + second(499)));
        assert_eq!(turns.wait(start + second(400)), second(100));
        assert!(turns.take(start + second(500)));
    }
}
