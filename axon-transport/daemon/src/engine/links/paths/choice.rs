//! Decides when the traffic of a peer moves to the second path because that one is better.

use std::time::Duration;

/// Time for which the second path must be better.
const STEADY: Duration = Duration::from_secs(10);
/// Time after a change in which no other follows.
const PAUSE: Duration = Duration::from_secs(60);
/// A path is better if its round trip is at most this part of the other one's, a half, and shorter by a notable time.
const PART: u32 = 2;
const NOTABLE: Duration = Duration::from_millis(2);
/// Time over which packets are counted for the share of lost ones, and the least number of packets.
const COUNTED: (Duration, u64) = (Duration::from_secs(5), 50);
/// A path that loses this share of its packets is left for one that loses at most a third of that.
const LOSES: f64 = 0.1;
const LOSS_PART: f64 = 3.0;
/// A shorter path is not better if it loses more than the other one by this share.
const MORE_LOSS: f64 = 0.02;
/// A path that loses less is not better if its round trip is longer than the other one's by this factor and this time.
const LONGER: (u32, Duration) = (2, Duration::from_millis(20));

/// What QUIC measured of a path since the link began.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::engine::links) struct PathQuality {
    /// The shortest round trip. Unlike the present one it is without the queue that the link's own samples make.
    pub(in crate::engine::links) round_trip: Duration,
    pub(in crate::engine::links) sent: u64,
    pub(in crate::engine::links) lost: u64,
}

/// The comparison of the two paths to a peer. A state machine as `docs/architecture.md` describes them.
#[derive(Debug, Default)]
pub(in crate::engine::links) struct PathChoice {
    in_use: LossCount,
    standby: LossCount,
    /// The time since which the second path is better.
    better_since: Option<Duration>,
    /// The time of the latest change.
    changed_at: Option<Duration>,
}

impl PathChoice {
    /// Handles that another link is in use, or stands by: the comparison begins anew.
    pub(in crate::engine::links) fn handle_links(&mut self) {
        *self = Self { changed_at: self.changed_at, ..Self::default() };
    }

    /// Compares the paths, once a second. Returns whether the link that stands by is to be put in use.
    pub(in crate::engine::links) fn handle_second(
        &mut self,
        now: Duration,
        in_use: PathQuality,
        standby: PathQuality,
    ) -> bool {
        self.in_use.count(now, in_use);
        self.standby.count(now, standby);
        if !self.is_better(in_use.round_trip, standby.round_trip) {
            self.better_since = None;
            return false;
        }
        let since = *self.better_since.get_or_insert(now);
        let is_pause = self.changed_at.is_some_and(|changed| now < changed + PAUSE);
        if is_pause || now < since + STEADY {
            return false;
        }
        (self.better_since, self.changed_at) = (None, Some(now));
        true
    }

    fn is_better(&self, in_use: Duration, standby: Duration) -> bool {
        let is_shorter = standby * PART <= in_use && standby + NOTABLE <= in_use;
        let loses_more = match (self.in_use.share, self.standby.share) {
            (Some(in_use), Some(standby)) => standby > in_use + MORE_LOSS,
            (None, Some(standby)) => standby > MORE_LOSS,
            (_, None) => false,
        };
        let loses_less = match (self.in_use.share, self.standby.share) {
            (Some(in_use), Some(standby)) => in_use >= LOSES && standby * LOSS_PART <= in_use,
            _ => false,
        };
        let is_longer = standby > in_use * LONGER.0 + LONGER.1;
        (is_shorter && !loses_more) || (loses_less && !is_longer)
    }
}

/// Counts lost packets.
#[derive(Debug, Default)]
struct LossCount {
    /// When the count began, with the packets sent and lost until then.
    begun: Option<(Duration, u64, u64)>,
    /// The share of the latest count.
    share: Option<f64>,
}

impl LossCount {
    fn count(&mut self, now: Duration, path: PathQuality) {
        let (begun, sent, lost) = *self.begun.get_or_insert((now, path.sent, path.lost));
        let sent = path.sent.saturating_sub(sent);
        if now < begun + COUNTED.0 {
            return;
        }
        let share = path.lost.saturating_sub(lost) as f64 / sent.max(1) as f64;
        self.share = (sent >= COUNTED.1).then_some(share);
        self.begun = Some((now, path.sent, path.lost));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares two paths for so many seconds: each a round trip in milliseconds, and lost packets of a hundred a second.
    /// Returns the seconds at which the second path was put in use.
    fn changes(
        choice: &mut PathChoice,
        seconds: std::ops::Range<u64>,
        [in_use, standby]: [(u64, u64); 2],
    ) -> Vec<u64> {
        let quality = |second: u64, (round_trip, lost): (u64, u64)| PathQuality {
            round_trip: Duration::from_millis(round_trip),
            sent: second * 100,
            lost: second * lost,
        };
        let changes = seconds.filter(|second| {
            let now = Duration::from_secs(*second);
            choice.handle_second(now, quality(*second, in_use), quality(*second, standby))
        });
        changes.collect()
    }

    #[test]
    fn shorter_path_is_put_in_use_after_ten_seconds() {
        for (in_use, standby, is_better) in [
            (10, 2, true),
            (10, 5, true),
            (10, 6, false),
            (10, 10, false),
            (2, 10, false),
            // Both are quick.
            (2, 1, false),
        ] {
            let mut choice = PathChoice::default();
            let changes = changes(&mut choice, 0..60, [(in_use, 0), (standby, 0)]);
            assert_eq!(changes, if is_better { vec![10] } else { vec![] }, "{in_use}, {standby}");
        }
    }

    #[test]
    fn path_that_loses_much_is_left_for_one_that_does_not() {
        for (in_use, standby, is_better) in [
            ((5, 20), (5, 1), true),
            ((5, 20), (25, 6), true),
            ((5, 20), (40, 0), false),
            ((5, 20), (5, 10), false),
            ((5, 5), (5, 0), false),
            // It is shorter, and loses more.
            ((10, 0), (2, 5), false),
            ((10, 5), (2, 5), true),
        ] {
            let mut choice = PathChoice::default();
            // The shares are known after five seconds.
            let changes = changes(&mut choice, 0..60, [in_use, standby]);
            assert_eq!(!changes.is_empty(), is_better, "{in_use:?}, {standby:?}");
        }
    }

    #[test]
    fn changes_are_a_minute_apart() {
        let mut choice = PathChoice::default();
        let pair = [(10, 0), (2, 0)];
        let mut all = Vec::new();
        for second in 0..200 {
            let change = changes(&mut choice, second..second + 1, pair);
            if !change.is_empty() {
                choice.handle_links();
            }
            all.extend(change);
        }
        assert_eq!(all, [10, 70, 130, 190]);
    }

    #[test]
    fn comparison_begins_anew_with_another_link() {
        let mut choice = PathChoice::default();
        let pair = [(10, 0), (2, 0)];
        assert!(changes(&mut choice, 0..9, pair).is_empty());
        choice.handle_links();
        assert_eq!(changes(&mut choice, 9..25, pair), [19]);
    }
}
