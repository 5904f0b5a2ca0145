//! The round trip of a path without queues.

use std::time::{Duration, Instant};

/// A shortest round trip stays valid for one to two times this period. It is measured anew each time that a queue
/// drains.
const AGE: Duration = Duration::from_secs(15);

/// The shortest round trip of the last fifteen to thirty seconds.
#[derive(Debug, Clone)]
pub(super) struct Path {
    since: Instant,
    /// The shortest round trip since then, and that of the period before.
    recent: Duration,
    before: Duration,
}

impl Path {
    /// Creates a path without a measurement.
    pub(super) fn new(now: Instant) -> Self {
        Self { since: now, recent: Duration::MAX, before: Duration::MAX }
    }

    /// Creates a path with a known round trip.
    pub(super) fn of(now: Instant, rtt: Duration) -> Self {
        Self { since: now, recent: rtt, before: Duration::MAX }
    }

    /// Returns the shortest round trip; the largest possible value if none was measured.
    pub(super) fn get(&self) -> Duration {
        self.recent.min(self.before)
    }

    /// Takes the round trip of a packet.
    pub(super) fn add(&mut self, now: Instant, rtt: Duration) {
        if now.saturating_duration_since(self.since) > AGE {
            self.before = std::mem::replace(&mut self.recent, Duration::MAX);
            self.since = now;
        }
        self.recent = self.recent.min(rtt);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shortest_round_trip_is_forgotten_after_two_ages_at_most() {
        let start = Instant::now();
        let mut path = Path::new(start);
        path.add(start, Duration::from_millis(3));
        for second in 1..=40 {
            path.add(start + Duration::from_secs(second), Duration::from_millis(40));
            let expected = if second <= 31 { 3 } else { 40 };
            assert_eq!(path.get(), Duration::from_millis(expected), "after {second} s");
        }
    }
}
