//! Limits log lines about many samples to one a second. Each line has the number of samples since the previous one.

use std::{
    sync::{Mutex, PoisonError},
    time::Duration,
};

const BETWEEN: Duration = Duration::from_secs(1);

/// Counts the events of one log line.
#[derive(Debug, Default)]
pub struct LogLimit(Mutex<LogCount>);

#[derive(Debug, Default)]
struct LogCount {
    last: Option<Duration>,
    since: u64,
}

impl LogLimit {
    /// Counts one more event at `now`, a time since any fixed start. If a line is due, returns the number of events
    /// since the last line, including this one.
    pub fn count(&self, now: Duration) -> Option<u64> {
        let mut said = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        said.since += 1;
        let due = said.last.is_none_or(|last| now.saturating_sub(last) >= BETWEEN);
        due.then(|| {
            said.last = Some(now);
            std::mem::take(&mut said.since)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_log_lines_are_counted_once_a_second() {
        let limit = LogLimit::default();
        let at = |milliseconds| limit.count(Duration::from_millis(milliseconds));
        assert_eq!([0, 1, 500, 999].map(at), [Some(1), None, None, None]);
        assert_eq!([1000, 1001, 2500].map(at), [Some(4), None, Some(2)]);
    }
}
