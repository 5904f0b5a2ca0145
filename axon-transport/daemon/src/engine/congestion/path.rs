//! The round trip of a path without queues.

use std::time::{Duration, Instant};

/// A shortest round trip is believed for one to two of these. It is measured anew each time that a queue drains.
const AGE: Duration = Duration::from_secs(15);

/// The shortest round trip of the last fifteen to thirty seconds.
#[derive(Debug, Clone)]
pub(super) struct Path {
    since: Instant,
    /// The shortest since then, and of the time before.
    recent: Duration,
    before: Duration,
}

impl Path {
    /// A path of which nothing is known.
    pub(super) fn new(now: Instant) -> Self {
        Self { since: now, recent: Duration::MAX, before: Duration::MAX }
    }

    /// A path that is known to be so long.
    pub(super) fn of(now: Instant, rtt: Duration) -> Self {
        Self { since: now, recent: rtt, before: Duration::MAX }
    }

    /// The shortest round trip; the longest possible where none was seen.
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
