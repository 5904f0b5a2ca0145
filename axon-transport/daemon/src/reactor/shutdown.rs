//! Shutdown: samples in the send queues leave first, while there is progress, for at most 5 s.

use std::time::Duration;

/// Limits of the whole, and of a time without progress.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(5);
const PROGRESS_TIMEOUT: Duration = Duration::from_secs(2);
/// Between two looks. A sample that was just published is read from its ring within this time.
const CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// The progress of a shutdown.
#[derive(Debug)]
pub(super) struct ShutdownDrain {
    begun: Duration,
    /// Bytes that had left the queues at the last look, and since when the number is the same.
    released: usize,
    since: Duration,
    next: Duration,
    /// Whether no byte waited at the last look.
    empty: bool,
}

impl ShutdownDrain {
    /// Creates a shutdown that begins now.
    pub(super) fn new(now: Duration) -> Self {
        Self { begun: now, released: 0, since: now, next: now + CHECK_INTERVAL, empty: false }
    }

    /// Returns when to [look](Self::is_over) again.
    pub(super) fn poll_timeout(&self) -> Duration {
        self.next
    }

    /// Returns whether the shutdown is over. `backlog` is the result of
    /// [`Engine::backlog`](crate::engine::Engine::backlog). The number of waiting bytes alone does not show progress,
    /// since publishers go on.
    pub(super) fn is_over(&mut self, backlog: (usize, usize), now: Duration) -> bool {
        let (waiting, released) = backlog;
        self.next = now + CHECK_INTERVAL;
        if released != self.released {
            (self.released, self.since) = (released, now);
        }
        let was_empty = std::mem::replace(&mut self.empty, waiting == 0);
        (was_empty && self.empty)
            || now.saturating_sub(self.begun) >= DRAIN_TIMEOUT
            || now.saturating_sub(self.since) >= PROGRESS_TIMEOUT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_ends_when_nothing_waits_twice_or_without_progress() {
        let looks = |at: fn(u32) -> (usize, usize)| {
            let mut finishing = ShutdownDrain::new(Duration::ZERO);
            (1..).find(|look| finishing.is_over(at(*look), CHECK_INTERVAL * *look))
        };
        let [patience, longest] =
            [PROGRESS_TIMEOUT, DRAIN_TIMEOUT].map(|t| t.div_duration_f64(CHECK_INTERVAL) as u32);
        assert_eq!(looks(|_| (0, 9)), Some(2), "a publisher may have written just now");
        assert_eq!(looks(|look| (3_usize.saturating_sub(look as usize), look as usize)), Some(4));
        assert_eq!(looks(|_| (7, 0)), Some(patience));
        assert_eq!(looks(|look| (7, look.min(10) as usize)), Some(10 + patience));
        assert_eq!(looks(|look| (7, look as usize)), Some(longest), "publishers go on for ever");
    }
}
