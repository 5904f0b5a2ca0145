//! The age of a link's keys, which decides when a successor is dialled, and when the link ends.

use std::time::Duration;

/// The age of a link's keys. In `classic` they do not age.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::engine::links) struct Age {
    /// The time at which the side that dialled the link dials a successor.
    renew_at: Option<Duration>,
    /// The time after a failed dial at which the next one is due: before the key's age is reached.
    again: Duration,
    /// The time at which the link ends.
    until: Option<Duration>,
}

/// The due action for a link that ages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::engine::links) enum AgeStep {
    /// No successor came: the link ends.
    End,
    /// A successor is to be dialled.
    Renew,
}

impl Age {
    /// Creates the age of keys that are used from `now` on, for `max_age`. The side that dialled the link `renews` it.
    pub(in crate::engine::links) fn new(max_age: Duration, renews: bool, now: Duration) -> Self {
        Self {
            renew_at: renews.then(|| now + renewal_at(max_age)),
            again: max_age.mul_f64(0.04).max(Duration::from_secs(1)),
            until: Some(now + max_age),
        }
    }

    /// Returns when the link ends.
    pub(in crate::engine::links) fn until(&self) -> Option<Duration> {
        self.until
    }

    pub(in crate::engine::links) fn poll_timeout(&self) -> Option<Duration> {
        [self.renew_at, self.until].into_iter().flatten().min()
    }

    pub(in crate::engine::links) fn handle_timeout(&mut self, now: Duration) -> Option<AgeStep> {
        if self.until.is_some_and(|until| until <= now) {
            return Some(AgeStep::End);
        }
        self.renew_at.filter(|renew| *renew <= now)?;
        self.renew_at = Some(now + self.again);
        Some(AgeStep::Renew)
    }
}

/// Returns the age at which the successor of a link is dialled: a tenth of its maximum age before the end, but at least
/// ten seconds if that is no more than half of it, because the KMEs may be slow.
fn renewal_at(age: Duration) -> Duration {
    age - (age / 10).max(Duration::from_secs(10)).min(age / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1000);

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn keys_in_classic_do_not_age() {
        let mut age = Age::default();
        assert_eq!((age.poll_timeout(), age.until()), (None, None));
        assert_eq!(age.handle_timeout(Duration::MAX), None);
    }

    #[test]
    fn the_dialler_renews_before_the_end_and_again_if_the_dial_fails() {
        for (max, renewed, again) in [(3600, 3240, 144), (60, 50, 3), (12, 6, 1)] {
            let mut age = Age::new(seconds(max), true, NOW);
            let renew = NOW + seconds(renewed);
            assert_eq!(age.poll_timeout(), Some(renew), "{max}");
            assert_eq!(age.handle_timeout(renew - seconds(1)), None);
            assert_eq!(age.handle_timeout(renew), Some(AgeStep::Renew));
            assert_eq!(age.handle_timeout(renew), None, "once");
            let next = age.poll_timeout().unwrap();
            assert!(next >= renew + seconds(again.min(1)) && next < NOW + seconds(max), "{max}");
            assert_eq!(age.handle_timeout(next), Some(AgeStep::Renew));
            assert_eq!(age.handle_timeout(NOW + seconds(max)), Some(AgeStep::End));
        }
    }

    #[test]
    fn the_side_that_was_dialled_waits_for_the_end() {
        let mut age = Age::new(seconds(60), false, NOW);
        assert_eq!(age.poll_timeout(), Some(NOW + seconds(60)));
        assert_eq!(age.handle_timeout(NOW + seconds(59)), None);
        assert_eq!(age.handle_timeout(NOW + seconds(60)), Some(AgeStep::End));
    }
}
