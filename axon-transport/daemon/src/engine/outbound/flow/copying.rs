//! Decides which samples of a flow also leave over the second path.

use std::time::Duration;

/// Maximum number of samples that wait together and are copied. More are bulk.
const LONE: u64 = 8;
/// Maximum number of samples in a period of a flow whose samples are copied, 2,000 a second: the second path may cost
/// money by the byte.
const MOST: u64 = 200;
const PERIOD: Duration = Duration::from_millis(100);

/// The samples of a flow that were sent lately.
#[derive(Debug, Default)]
pub(super) struct CopyRule {
    /// When the period began.
    since: Duration,
    sent: u64,
    /// True if the last period had too many samples.
    was_fast: bool,
}

impl CopyRule {
    /// Returns whether the samples of a batch are copied, of which `waiting` wait together.
    pub(super) fn takes(&mut self, waiting: u64, now: Duration) -> bool {
        if now >= self.since + PERIOD {
            let is_next = now < self.since + 2 * PERIOD;
            self.was_fast = is_next && self.sent > MOST;
            (self.since, self.sent) = (now, 0);
        }
        self.sent += waiting;
        waiting <= LONE && !self.was_fast && self.sent <= MOST
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns how many samples are copied of those of two seconds that come so many microseconds apart.
    fn copied(every: u64, together: u64) -> u64 {
        let mut rule = CopyRule::default();
        let times = (0..2_000_000 / every).map(|number| Duration::from_micros(number * every));
        times.filter(|now| rule.takes(together, *now)).count() as u64 * together
    }

    #[test]
    fn samples_of_control_loops_are_copied_and_streams_are_not() {
        assert_eq!(copied(10_000, 1), 200, "100 Hz");
        assert_eq!(copied(1000, 1), 2000, "1 kHz");
        assert_eq!(copied(100_000, 8), 160);
        assert_eq!(copied(100_000, 9), 0);
        assert!(copied(100, 1) <= 200, "of 20,000");
    }

    #[test]
    fn slow_samples_after_a_fast_burst_are_copied() {
        let mut rule = CopyRule::default();
        (0..1000).for_each(|_| _ = rule.takes(1, Duration::from_secs(1)));
        assert!(!rule.takes(1, Duration::from_millis(1150)));
        assert!(rule.takes(1, Duration::from_millis(1300)));
    }
}
