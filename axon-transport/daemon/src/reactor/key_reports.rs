//! Schedules reads of the counters of the keys for status. They happen on another thread, since the ledger may wait for
//! the disk.

use std::time::Duration;

/// Between two reports of the keys.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// The reports of the keys. One is under way at a time: a disk that hangs gets no queue of them.
#[derive(Debug, Default)]
pub(super) struct KeyReports {
    next: Duration,
    is_asked: bool,
}

impl KeyReports {
    /// Returns when [`begin`](Self::begin) is due; `None` until the last report has come.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        (!self.is_asked).then_some(self.next)
    }

    /// Begins a report if one is due. Returns whether it did: the caller then asks for the report.
    pub(super) fn begin(&mut self, now: Duration) -> bool {
        let due = self.poll_timeout().is_some_and(|due| due <= now);
        if due {
            (self.next, self.is_asked) = (now + REPORT_INTERVAL, true);
        }
        due
    }

    /// Records that the report came.
    pub(super) fn handle_report(&mut self) {
        self.is_asked = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_of_keys_are_requested_once_a_second_one_at_a_time() {
        let mut reports = KeyReports::default();
        assert!(reports.begin(Duration::ZERO));
        let later = Duration::from_secs(60);
        assert!(!reports.begin(later), "the disk hangs");
        assert_eq!(reports.poll_timeout(), None, "the loop is not woken for it");
        reports.handle_report();
        assert!(reports.begin(later));
        reports.handle_report();
        assert!(!reports.begin(later + REPORT_INTERVAL / 2));
        assert_eq!(reports.poll_timeout(), Some(later + REPORT_INTERVAL));
    }
}
