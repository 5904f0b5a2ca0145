//! The pause of a session between the loss of its daemon and the search for the next one.

use std::time::{Duration, Instant};

const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// Minimum duration of a connection. A shorter one counts as refused.
const MIN_CONNECTION_TIME: Duration = Duration::from_secs(1);

/// The pause before the search for a daemon. It keeps a session whose connections do not last from
/// reconnecting at once, at the cost of all other sessions.
#[derive(Debug)]
pub(super) struct ReconnectPause {
    /// The time of the last connection.
    since: Instant,
    pause: Duration,
}

impl ReconnectPause {
    pub(super) fn new(now: Instant) -> Self {
        Self { since: now, pause: Duration::ZERO }
    }

    pub(super) fn handle_connected(&mut self, now: Instant) {
        self.since = now;
    }

    /// Returns the pause before the search.
    pub(super) fn handle_lost(&mut self, now: Instant) -> Duration {
        self.pause = if now.saturating_duration_since(self.since) < MIN_CONNECTION_TIME {
            next(self.pause)
        } else {
            Duration::ZERO
        };
        self.pause
    }
}

/// Returns the pause after another pause in which no daemon was found.
pub(super) fn next(pause: Duration) -> Duration {
    (pause * 2).clamp(MIN_PAUSE, MAX_PAUSE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_that_do_not_last_are_made_at_longer_and_longer_intervals() {
        let mut now = Instant::now();
        let mut pause = ReconnectPause::new(now);
        for millis in [100, 200, 400, 800, 1600, 2000, 2000] {
            pause.handle_connected(now);
            now += MIN_CONNECTION_TIME / 2;
            assert_eq!(pause.handle_lost(now), Duration::from_millis(millis));
        }
        pause.handle_connected(now);
        now += MIN_CONNECTION_TIME;
        assert_eq!(pause.handle_lost(now), Duration::ZERO, "it lasted");
        pause.handle_connected(now);
        assert_eq!(pause.handle_lost(now), MIN_PAUSE);
    }
}
