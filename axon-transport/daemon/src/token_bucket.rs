//! A token bucket, for rate limits.

use std::time::Duration;

/// A bucket that holds `burst` tokens at most, and gains `per_second`. It begins full.
#[derive(Debug)]
pub(crate) struct TokenBucket {
    burst: f64,
    per_second: f64,
    /// Below zero where tokens were taken in advance.
    tokens: f64,
    filled: Duration,
}

impl TokenBucket {
    /// Creates a full bucket.
    pub(crate) fn new(burst: u32, per_second: u32) -> Self {
        let burst = f64::from(burst);
        Self { burst, per_second: f64::from(per_second), tokens: burst, filled: Duration::ZERO }
    }

    /// Takes a token, if there is one. Returns whether there was.
    pub(crate) fn take(&mut self, now: Duration) -> bool {
        let granted = self.wait(now).is_zero();
        if granted {
            self.tokens -= 1.0;
        }
        granted
    }

    /// Returns the time until there is a token.
    pub(crate) fn wait(&mut self, now: Duration) -> Duration {
        self.fill(now);
        self.until(1.0)
    }

    /// Takes `cost` tokens, on credit if there are fewer. Returns the time until the bucket has regained the tokens
    /// that it lent.
    pub(crate) fn owe(&mut self, cost: u32, now: Duration) -> Duration {
        self.fill(now);
        self.tokens -= f64::from(cost);
        self.until(0.0)
    }

    /// Returns whether the bucket is full.
    pub(crate) fn is_full(&mut self, now: Duration) -> bool {
        self.fill(now);
        self.tokens >= self.burst
    }

    fn fill(&mut self, now: Duration) {
        let passed = now.saturating_sub(self.filled);
        self.filled = self.filled.max(now);
        self.tokens = (self.tokens + passed.as_secs_f64() * self.per_second).min(self.burst);
    }

    fn until(&self, tokens: f64) -> Duration {
        Duration::from_secs_f64(((tokens - self.tokens) / self.per_second).max(0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(milliseconds: u64) -> Duration {
        Duration::from_secs(1000) + Duration::from_millis(milliseconds)
    }

    #[test]
    fn a_burst_passes_at_once_and_then_the_rate() {
        let mut bucket = TokenBucket::new(3, 10);
        assert!(bucket.is_full(at(0)));
        assert_eq!(
            [0, 0, 0, 0, 99, 100, 150].map(|ms| bucket.take(at(ms))),
            [true, true, true, false, false, true, false]
        );
        assert_eq!(bucket.wait(at(150)), Duration::from_millis(50));
        assert!(!bucket.is_full(at(399)) && bucket.is_full(at(400)));
        // Time that goes back gains nothing.
        assert_eq!([400, 0, 0, 0].map(|ms| bucket.take(at(ms))), [true, true, true, false]);
    }

    #[test]
    fn tokens_that_are_taken_in_advance_are_made_up_for() {
        let mut bucket = TokenBucket::new(50, 100);
        assert_eq!(bucket.owe(50, at(0)), Duration::ZERO);
        assert_eq!(bucket.owe(20, at(0)), Duration::from_millis(200));
        assert!(!bucket.take(at(200)));
        assert_eq!(bucket.wait(at(200)), Duration::from_millis(10));
        assert_eq!(bucket.owe(0, at(200)), Duration::ZERO);
    }
}
