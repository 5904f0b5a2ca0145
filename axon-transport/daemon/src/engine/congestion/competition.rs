//! Handling of a queue that other traffic fills.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use quinn_proto::congestion::{Controller, Cubic, CubicConfig};

/// A queue may belong to others if it lasts for this time while the window shrinks this often.
const STANDING: (Duration, u32) = (Duration::from_secs(1), 4);
/// A queue may also belong to others if it lasts for this time while the window is too small to shrink.
const UNCLEAR: Duration = Duration::from_secs(3);
/// A comparison needs a window that has shrunk to this share.
const SHRUNK: f64 = 0.75;
/// Time between probes for the end of the queue, while CUBIC decides.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Rounds of a probe. The packets of the first round were sent before the probe.
const LOOK_ROUNDS: u32 = 3;
/// The path counts as longer once this many probes in a row repeat the result of the one before.
const ALIKE: u32 = 2;

/// A queue that remains although the window shrinks.
#[derive(Debug, Clone)]
pub(super) struct PersistentQueue {
    since: Instant,
    /// The window before it shrank.
    peak: u64,
    /// The window and the rate in bytes per second to compare with. Both are from the second reduction: at
    /// the first one the rate may still be from before the queue.
    window: u64,
    rate: f64,
    /// The number of times that the window shrank since.
    times: u32,
}

impl PersistentQueue {
    pub(super) fn new(now: Instant, window: u64, rate: f64) -> Self {
        Self { since: now, peak: window, window, rate, times: 0 }
    }

    /// Records that the window is about to shrink. `least` is the smallest window. Returns the original
    /// window if the queue belongs to others: the rate shrank with the window. A queue of this link alone
    /// keeps its rate. A window that is too small to shrink is no evidence; CUBIC then finds out.
    pub(super) fn shrink(
        &mut self,
        now: Instant,
        window: u64,
        rate: f64,
        least: u64,
    ) -> Option<u64> {
        self.times += 1;
        if self.times == 2 {
            (self.window, self.rate) = (window, rate);
        }
        let share = window as f64 / self.window as f64;
        let time = now.saturating_duration_since(self.since);
        let is_telling = time >= STANDING.0 && self.times >= STANDING.1;
        let has_less = share <= SHRUNK && rate < self.rate * (1.0 + share) / 2.0;
        let cannot_shrink = time >= UNCLEAR && self.window as f64 * SHRUNK < least as f64;
        (is_telling && (has_less || cannot_shrink)).then_some(self.peak)
    }
}

/// The result of a round of competition.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// CUBIC continues.
    Goes,
    /// The queue is gone.
    Over,
    /// The path is longer than before, and no other traffic fills the queue.
    Longer(Duration),
}

/// The phase in which CUBIC decides, because other traffic fills the queue or the path became longer. From
/// time to time a probe, with hardly anything in flight, shows which of the two.
#[derive(Debug, Clone)]
pub(super) struct Competition {
    cubic: Cubic,
    next_look: Instant,
    /// Remaining rounds of a probe.
    looking: u32,
    /// The shortest round trip of this probe.
    seen: Option<Duration>,
    /// The result of the last probe.
    before: Duration,
    /// Consecutive probes with the same result.
    alike: u32,
}

impl Competition {
    /// Starts with a window. `shortest` is the round trip of a round that just had little in flight.
    pub(super) fn new(now: Instant, window: u64, mtu: u64, shortest: Duration) -> Self {
        let mut config = CubicConfig::default();
        config.initial_window(window * 10 / 7);
        let mut cubic = Cubic::new(Arc::new(config), now, mtu as u16);
        // CUBIC starts as after a loss, with 0.7 of that window: a new instance would double its window until
        // it lost packets.
        cubic.on_congestion_event(now, now, false, 0);
        Self {
            cubic,
            next_look: now + LOOK_EVERY,
            looking: 0,
            seen: None,
            before: shortest,
            alike: 0,
        }
    }

    /// Returns CUBIC, to report events to it; `None` during a probe, which CUBIC did not cause.
    pub(super) fn cubic(&mut self) -> Option<&mut Cubic> {
        (self.looking == 0).then_some(&mut self.cubic)
    }

    /// Returns CUBIC, to report the events that also count during a probe.
    pub(super) fn cubic_always(&mut self) -> &mut Cubic {
        &mut self.cubic
    }

    /// Returns the window; `None` during a probe, which uses the smallest window.
    pub(super) fn window(&self) -> Option<u64> {
        (self.looking == 0).then(|| self.cubic.window())
    }

    /// Returns CUBIC's window.
    pub(super) fn share(&self) -> u64 {
        self.cubic.window()
    }

    /// Ends a round. `shortest` is its shortest round trip, `path` that of the path, and `wanted` the wanted
    /// queue.
    pub(super) fn end_round(
        &mut self,
        now: Instant,
        shortest: Duration,
        path: Duration,
        wanted: Duration,
    ) -> Outcome {
        if self.looking == 0 {
            if now >= self.next_look {
                (self.looking, self.seen) = (LOOK_ROUNDS, None);
            }
            return Outcome::Goes;
        }
        self.looking -= 1;
        if self.looking < LOOK_ROUNDS - 1 {
            self.seen = Some(self.seen.map_or(shortest, |seen| seen.min(shortest)));
        }
        if self.looking > 0 {
            return Outcome::Goes;
        }
        self.next_look = now + LOOK_EVERY;
        let found = self.seen.unwrap_or(shortest);
        if found.saturating_sub(path) < wanted {
            return Outcome::Over;
        }
        // A queue of other traffic never has the same length twice.
        let same = Duration::from_millis(1).max(found / 20);
        self.alike = if found.abs_diff(self.before) < same { self.alike + 1 } else { 0 };
        self.before = found;
        if self.alike >= ALIKE { Outcome::Longer(found) } else { Outcome::Goes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn millis(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn a_rate_that_falls_with_the_window_says_that_others_fill_the_queue() {
        let start = Instant::now();
        // The queue belongs to this link alone: the rate stays.
        let mut own = PersistentQueue::new(start, 100_000, 1e6);
        for time in 1..20_u32 {
            let window = 100_000 >> time.min(6);
            assert_eq!(own.shrink(start + millis(200) * time, window, 1e6, 1_000), None);
        }
        let mut others = PersistentQueue::new(start, 100_000, 1e6);
        let mut shrink = |time: u32, window: u64| {
            others.shrink(start + millis(200) * time, window, window as f64 * 10.0, 1_000)
        };
        assert_eq!(shrink(1, 50_000), None, "it may still drain");
        assert_eq!(shrink(2, 25_000), None);
        assert_eq!(shrink(3, 12_500), None);
        assert_eq!(shrink(5, 6_250), Some(100_000));
    }

    #[test]
    fn a_queue_that_stands_before_the_smallest_window_is_not_of_this_link() {
        let start = Instant::now();
        let mut standing = PersistentQueue::new(start, 100_000, 1e6);
        for time in 1..=5 {
            assert_eq!(standing.shrink(start + millis(590) * time, 4_000, 5e4, 4_000), None);
        }
        assert_eq!(standing.shrink(start + millis(3_000), 4_000, 5e4, 4_000), Some(100_000));
    }

    /// Ends rounds of 40 ms until a probe is over, which measures `shortest`.
    fn look(competition: &mut Competition, now: &mut Instant, shortest: Duration) -> Outcome {
        loop {
            *now += millis(40);
            let was_looking = competition.window().is_none();
            let outcome = competition.end_round(*now, shortest, millis(3), millis(3));
            if was_looking && competition.window().is_some() {
                return outcome;
            }
            assert_eq!(outcome, Outcome::Goes);
        }
    }

    #[test]
    fn looks_tell_a_longer_path_from_the_queue_of_others() {
        let mut now = Instant::now();
        let mut longer = Competition::new(now, 50_000, 1_400, millis(40));
        assert_eq!(look(&mut longer, &mut now, millis(40)), Outcome::Goes);
        assert_eq!(look(&mut longer, &mut now, millis(41)), Outcome::Longer(millis(41)));

        let mut queue = Competition::new(now, 50_000, 1_400, millis(40));
        for seen in [30, 36, 27, 33, 38, 26] {
            assert_eq!(look(&mut queue, &mut now, millis(seen)), Outcome::Goes);
        }
        assert_eq!(look(&mut queue, &mut now, millis(5)), Outcome::Over);
    }
}
