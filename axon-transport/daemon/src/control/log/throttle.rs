//! Limits how many log lines of one kind are written.

use std::{
    collections::HashMap,
    hash::Hash,
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Maximum number of lines of one kind that may follow each other at once.
const BURST: u32 = 10;
/// Interval of further lines after a burst.
const INTERVAL: Duration = Duration::from_secs(1);

/// A token bucket for each kind of line.
#[derive(Debug)]
pub(super) struct Throttle<K>(Mutex<HashMap<K, LineBucket>>);

#[derive(Debug)]
struct LineBucket {
    tokens: u32,
    filled: Instant,
    left_out: u64,
}

impl<K> Default for Throttle<K> {
    fn default() -> Self {
        Self(Mutex::new(HashMap::new()))
    }
}

impl<K: Eq + Hash> Throttle<K> {
    /// Returns `None` if a line of `kind` is not logged at `now`; otherwise the number of lines of this kind that were
    /// left out before it.
    pub(super) fn admit(&self, kind: K, now: Instant) -> Option<u64> {
        let mut buckets = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let bucket =
            buckets.entry(kind).or_insert(LineBucket { tokens: BURST, filled: now, left_out: 0 });
        let intervals = now.saturating_duration_since(bucket.filled).as_secs() / INTERVAL.as_secs();
        if intervals > 0 {
            let more = u32::try_from(intervals).unwrap_or(u32::MAX);
            bucket.tokens = bucket.tokens.saturating_add(more).min(BURST);
            bucket.filled += INTERVAL * more;
        }
        if bucket.tokens == 0 {
            bucket.left_out += 1;
            return None;
        }
        bucket.tokens -= 1;
        Some(std::mem::take(&mut bucket.left_out))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_one_kind_leaves_a_line_a_second_with_a_count() {
        let (throttle, start) = (Throttle::default(), Instant::now());
        let at = |ms: u64| throttle.admit("kind", start + Duration::from_millis(ms));
        let logged: Vec<_> = (0..10_000).filter_map(at).collect();
        let burst = BURST as usize;
        assert_eq!(logged.len(), burst + 9);
        assert_eq!(logged[..burst], [0; BURST as usize]);
        assert_eq!(logged[burst], 1_000 - u64::from(BURST));
        assert_eq!(logged[burst + 1..], [999; 8]);
        assert_eq!(at(3_600_000), Some(999), "a pause fills the bucket and forgets no count");
    }

    #[test]
    fn a_flood_of_one_kind_leaves_no_other_out() {
        let (throttle, now) = (Throttle::default(), Instant::now());
        for _ in 0..1_000 {
            throttle.admit("flood", now);
        }
        assert_eq!(throttle.admit("flood", now), None);
        assert_eq!(throttle.admit("other", now), Some(0));
    }
}
