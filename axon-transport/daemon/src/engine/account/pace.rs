//! Limits how fast a peer's control messages are handled: a token bucket for the messages, and turns for
//! the work that follows, so that a busy peer leaves time for the others.

use std::time::{Duration, Instant};

/// A token bucket.
#[derive(Debug)]
pub(crate) struct Bucket {
    a_second: f64,
    most: f64,
    tokens: f64,
    at: Option<Instant>,
}

impl Bucket {
    /// A full one for `most` at once and so many a second.
    pub(crate) fn new(a_second: u32, most: u32) -> Self {
        let (a_second, most) = (f64::from(a_second), f64::from(most));
        Self { a_second, most, tokens: most, at: None }
    }

    /// Takes `cost`, if need be in advance: how long it is until that is made up for.
    pub(crate) fn owe(&mut self, cost: u32, now: Instant) -> Duration {
        self.fill(now);
        self.tokens -= f64::from(cost);
        self.until(0.0)
    }

    /// Takes one token if there is one; else how long it is until there is.
    pub(crate) fn take(&mut self, now: Instant) -> Duration {
        self.fill(now);
        let wait = self.until(1.0);
        if wait.is_zero() {
            self.tokens -= 1.0;
        }
        wait
    }

    /// How long it is until there is one.
    pub(crate) fn wait(&mut self, now: Instant) -> Duration {
        self.fill(now);
        self.until(1.0)
    }

    fn fill(&mut self, now: Instant) {
        let since = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        self.tokens = (self.tokens + since.as_secs_f64() * self.a_second).min(self.most);
        self.at = Some(now);
    }

    fn until(&self, tokens: f64) -> Duration {
        Duration::from_secs_f64(((tokens - self.tokens) / self.a_second).max(0.0))
    }
}

/// Turns at once, and a second.
const TURNS: (u32, u32) = (32, 10);
/// After a turn as many times as long as it took are the others'.
const OTHERS: u32 = 9;

/// When what follows from a peer's changes is worked out next. What changes in between is taken
/// together: the newest state counts.
#[derive(Debug)]
pub(crate) struct Turns {
    bucket: Bucket,
    not_before: Option<Instant>,
}

impl Default for Turns {
    fn default() -> Self {
        Self { bucket: Bucket::new(TURNS.1, TURNS.0), not_before: None }
    }
}

impl Turns {
    /// How long it is until the next one.
    pub(crate) fn wait(&mut self, now: Instant) -> Duration {
        self.rest(now).max(self.bucket.wait(now))
    }

    /// Whether it is time; the turn is taken then.
    pub(crate) fn take(&mut self, now: Instant) -> bool {
        self.rest(now).is_zero() && self.bucket.take(now).is_zero()
    }

    /// A turn that began at `began` is over.
    pub(crate) fn over(&mut self, began: Instant, now: Instant) {
        self.not_before = Some(now + now.saturating_duration_since(began) * OTHERS);
    }

    fn rest(&self, now: Instant) -> Duration {
        self.not_before.map_or(Duration::ZERO, |at| at.saturating_duration_since(now))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn second(milliseconds: u64) -> Duration {
        Duration::from_millis(milliseconds)
    }

    #[test]
    fn a_flood_is_taken_at_the_rate_and_who_rests_may_say_as_much_at_once_again() {
        let (mut bucket, start) = (Bucket::new(100, 50), Instant::now());
        assert_eq!(bucket.owe(50, start), Duration::ZERO);
        assert_eq!(bucket.owe(100, start), second(1000));
        // It waited for it.
        assert_eq!(bucket.owe(10, start + second(1000)), second(100));
        assert_eq!(bucket.owe(50, start + second(60_000)), Duration::ZERO);
    }

    #[test]
    fn single_changes_follow_at_once_and_those_of_a_flood_together() {
        let (mut turns, start) = (Turns::default(), Instant::now());
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
        let (mut turns, start) = (Turns::default(), Instant::now());
        assert!(turns.take(start));
        turns.over(start, start + second(50));
        assert!(!turns.take(start + second(499)));
        assert_eq!(turns.wait(start + second(400)), second(100));
        assert!(turns.take(start + second(500)));
    }
}
