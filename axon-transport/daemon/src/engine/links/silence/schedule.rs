//! The schedule of link checks: for silence every second, of certificates every minute.

use std::time::Duration;

/// Time between two checks.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// Checks per check of certificates.
const MINUTE: u32 = 60;

/// The scope of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::links) struct CheckKind {
    /// True if certificates are checked, too, which costs signature verifications.
    pub(in crate::engine::links) at_certificates: bool,
}

/// The time of the next check, and the number of checks so far.
#[derive(Debug)]
pub(in crate::engine::links) struct CheckSchedule {
    next: Duration,
    passed: u32,
}

impl CheckSchedule {
    /// Creates a schedule whose first check is due a second after the engine's start.
    pub(in crate::engine::links) fn new() -> Self {
        Self { next: CHECK_INTERVAL, passed: 0 }
    }

    /// Returns when the next check is due, while there are links.
    pub(in crate::engine::links) fn poll_timeout(&self) -> Duration {
        self.next
    }

    /// Returns the check that is due, if one is.
    pub(in crate::engine::links) fn take_due(&mut self, now: Duration) -> Option<CheckKind> {
        if now < self.next {
            return None;
        }
        self.next = now + CHECK_INTERVAL;
        self.passed = self.passed.wrapping_add(1);
        Some(CheckKind { at_certificates: self.passed.is_multiple_of(MINUTE) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_second_has_a_look_and_each_minute_one_at_certificates() {
        let mut looks = CheckSchedule::new();
        let mut at_certificates = Vec::new();
        for second in 1..=120 {
            assert_eq!(looks.poll_timeout(), Duration::from_secs(second));
            assert_eq!(looks.take_due(looks.poll_timeout() - Duration::from_nanos(1)), None);
            let look = looks.take_due(looks.poll_timeout()).unwrap();
            at_certificates.extend(look.at_certificates.then_some(second));
        }
        assert_eq!(at_certificates, [60, 120]);
    }

    #[test]
    fn looks_that_were_missed_are_not_made_up_for() {
        let mut looks = CheckSchedule::new();
        let now = Duration::from_secs(100);
        assert_eq!(looks.take_due(now), Some(CheckKind { at_certificates: false }));
        assert_eq!((looks.take_due(now), looks.poll_timeout()), (None, now + CHECK_INTERVAL));
    }
}
