//! Retention policy for large-sample memory: a publisher keeps the memory as long as it publishes large samples,
//! and keeps about as much as they need. Plain data; the caller passes the time.

use std::time::{Duration, Instant};

/// Memory that holds no sample and was not used for this long is released.
pub(crate) const IDLE: Duration = Duration::from_secs(10);
/// Memory is released if this factor less was enough for [`IDLE`].
const SURPLUS: u64 = 4;
/// Memory up to this size in bytes is never too much.
const MODEST: u64 = 1 << 20;

/// The recent use of a segment.
#[derive(Debug)]
pub(crate) struct Retention {
    /// True if there was a large sample since the last check.
    used: bool,
    /// The last check that found a large sample.
    last: Instant,
    /// The most bytes in use since `since`.
    peak: u64,
    since: Instant,
}

impl Retention {
    pub(crate) fn begin(now: Instant) -> Self {
        Self { used: true, last: now, peak: 0, since: now }
    }

    /// Records a large sample, with which `bytes` are in use.
    #[inline]
    pub(crate) fn used(&mut self, bytes: u64) {
        self.used = true;
        self.peak = self.peak.max(bytes);
    }

    /// Checks a segment with `backed` bytes of memory, of which `bytes` are in use. Returns whether the publisher
    /// should leave it.
    pub(crate) fn is_over(&mut self, now: Instant, bytes: u64, backed: u64) -> bool {
        if std::mem::take(&mut self.used) {
            self.last = now;
        }
        if bytes == 0 && now.saturating_duration_since(self.last) >= IDLE {
            return true;
        }
        if now.saturating_duration_since(self.since) < IDLE {
            return false;
        }
        let peak = std::mem::replace(&mut self.peak, bytes).max(bytes);
        self.since = now;
        backed > MODEST && backed / SURPLUS > peak
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    fn seconds(start: Instant, count: u64) -> Instant {
        start + Duration::from_secs(count)
    }

    #[test]
    fn unused_memory_is_released_after_the_retention_time() {
        let start = Instant::now();
        let mut retention = Retention::begin(start);
        retention.used(MIB);
        for second in 1..=10 {
            assert!(!retention.is_over(seconds(start, second), 0, MIB), "used {second} s ago");
        }
        assert!(retention.is_over(seconds(start, 11), 0, MIB), "10 s after the look that saw it");
    }

    #[test]
    fn a_sample_that_stands_keeps_its_memory() {
        let start = Instant::now();
        let mut retention = Retention::begin(start);
        retention.used(20 * MIB);
        for second in 1..1000 {
            assert!(!retention.is_over(seconds(start, second), 20 * MIB, 40 * MIB));
        }
    }

    #[test]
    fn memory_in_use_stays_for_ever() {
        let start = Instant::now();
        let mut retention = Retention::begin(start);
        for second in 1..1000 {
            retention.used(20 * MIB);
            assert!(!retention.is_over(seconds(start, second), 20 * MIB, 64 * MIB));
        }
    }

    #[test]
    fn far_too_much_memory_is_left_after_a_while() {
        let start = Instant::now();
        let mut retention = Retention::begin(start);
        retention.used(256 * MIB);
        let mut left = None;
        for second in 1..60 {
            retention.used(2 * MIB);
            if retention.is_over(seconds(start, second), 2 * MIB, 256 * MIB) {
                left = Some(second);
                break;
            }
        }
        assert_eq!(left, Some(20), "a whole period went by with little in use");
    }

    #[test]
    fn a_small_amount_of_memory_is_always_kept() {
        let start = Instant::now();
        let mut retention = Retention::begin(start);
        for second in 1..60 {
            retention.used(8192);
            assert!(!retention.is_over(seconds(start, second), 8192, MIB));
        }
    }
}
