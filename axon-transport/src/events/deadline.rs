//! Deadlines: the longest permitted time between two samples.

/// Monitors one deadline, from the first sample on. A writer that never sent a sample has missed no
/// deadline (DDS 1.4, 2.2.3.7: the deadline belongs to an instance, which the first sample creates).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Deadline {
    period: u64,
    /// The next expiry. `None` before the first sample.
    due: Option<u64>,
}

impl Deadline {
    /// Creates a deadline of `period` nanoseconds; 0 counts as 1.
    pub(crate) fn new(period: u64) -> Self {
        Self { period: period.max(1), due: None }
    }

    /// Records a sample that was sent or received at `at`. A sample older than the newest one changes
    /// nothing.
    pub(crate) fn sample(&mut self, at: u64) {
        let due = at.saturating_add(self.period);
        self.due = Some(self.due.map_or(due, |known| known.max(due)));
    }

    /// Returns the number of deadlines missed until `now`, since the last call: one for each period without
    /// a sample.
    pub(crate) fn missed(&mut self, now: u64) -> u64 {
        let Some(due) = self.due.filter(|due| *due <= now) else { return 0 };
        let missed = (now - due) / self.period + 1;
        self.due = Some(due.saturating_add(missed.saturating_mul(self.period)));
        missed
    }

    /// Returns the time of the next check, or `None` before the first sample.
    pub(crate) fn due(&self) -> Option<u64> {
        self.due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_missed_before_the_first_sample() {
        let mut deadline = Deadline::new(10);
        assert_eq!((deadline.missed(u64::MAX), deadline.due()), (0, None));
    }

    #[test]
    fn every_period_without_a_sample_is_one_missed() {
        let mut deadline = Deadline::new(10);
        deadline.sample(100);
        assert_eq!((deadline.missed(109), deadline.due()), (0, Some(110)));
        assert_eq!((deadline.missed(110), deadline.due()), (1, Some(120)));
        assert_eq!(deadline.missed(110), 0);
        // A late call counts all deadlines that passed meanwhile.
        assert_eq!((deadline.missed(149), deadline.due()), (3, Some(150)));
        deadline.sample(155);
        assert_eq!((deadline.missed(164), deadline.due()), (0, Some(165)));
    }

    #[test]
    fn a_sample_from_before_does_not_turn_the_clock_back() {
        let mut deadline = Deadline::new(10);
        deadline.sample(100);
        deadline.sample(50);
        assert_eq!(deadline.due(), Some(110));
    }

    #[test]
    fn the_end_of_time_is_no_panic() {
        let mut deadline = Deadline::new(0);
        deadline.sample(0);
        assert_eq!(deadline.missed(u64::MAX), u64::MAX);
        deadline.sample(u64::MAX);
        assert_eq!(deadline.missed(u64::MAX), 1);
        let mut slow = Deadline::new(u64::MAX);
        slow.sample(5);
        assert_eq!(slow.missed(u64::MAX - 1), 0);
    }
}
