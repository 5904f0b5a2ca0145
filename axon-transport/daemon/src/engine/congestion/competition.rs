//! What to do about a queue that others fill.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use quinn_proto::congestion::{Controller, Cubic, CubicConfig};

/// A queue that stands for so long, while the window shrinks so often, may be of others.
const STANDING: (Duration, u32) = (Duration::from_secs(1), 4);
/// The window must shrink to this share before it says anything.
const SHRUNK: f64 = 0.75;
/// While CUBIC decides, the controller looks this often whether the queue is gone.
const LOOK_EVERY: Duration = Duration::from_secs(2);
/// Rounds of a look. The packets of the first one left before it.
const LOOK_ROUNDS: u32 = 3;
/// So many looks after the first one must find the same until the path counts as longer.
const ALIKE: u32 = 2;

/// A queue that stands although the window shrinks.
#[derive(Debug, Clone)]
pub(super) struct Standing {
    since: Instant,
    /// The window before it shrank.
    peak: u64,
    /// The window and the bytes a second to compare with. They are those of the second time: at the first one the rate
    /// may be of the time before the queue.
    window: u64,
    rate: f64,
    /// Times that the window shrank since.
    times: u32,
}

impl Standing {
    pub(super) fn new(now: Instant, window: u64, rate: f64) -> Self {
        Self { since: now, peak: window, window, rate, times: 0 }
    }

    /// Takes that the window is about to shrink once more. Returns the window from before if others fill the queue:
    /// the rate shrank with the window. A queue of this link alone keeps its rate.
    pub(super) fn shrink(&mut self, now: Instant, window: u64, rate: f64) -> Option<u64> {
        self.times += 1;
        if self.times == 2 {
            (self.window, self.rate) = (window, rate);
        }
        let share = window as f64 / self.window as f64;
        let is_long = now.saturating_duration_since(self.since) >= STANDING.0;
        let is_telling = is_long && self.times >= STANDING.1 && share <= SHRUNK;
        (is_telling && rate < self.rate * (1.0 + share) / 2.0).then_some(self.peak)
    }
}

/// What a round of competition shows.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// CUBIC goes on.
    Goes,
    /// The queue is gone.
    Over,
    /// The path is longer than before: nobody else was there.
    Longer(Duration),
}

/// CUBIC decides, since something else fills the queue or the path became longer. Now and then a look, with hardly
/// anything on the way, shows which.
#[derive(Debug, Clone)]
pub(super) struct Competition {
    cubic: Cubic,
    next_look: Instant,
    /// Rounds that are left of a look.
    looking: u32,
    /// The shortest round trip of this look.
    seen: Option<Duration>,
    /// What the last look found.
    before: Duration,
    /// Looks in a row that found the same.
    alike: u32,
}

impl Competition {
    /// Begins with a window. `shortest` is what a round without much on the way has just shown.
    pub(super) fn new(now: Instant, window: u64, mtu: u64, shortest: Duration) -> Self {
        let mut config = CubicConfig::default();
        config.initial_window(window * 10 / 7);
        let mut cubic = Cubic::new(Arc::new(config), now, mtu as u16);
        // It begins as after a loss, with 0.7 of that window: a new one would double until it lost packets.
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

    /// CUBIC, to be told what happens; `None` during a look, which is not its doing.
    pub(super) fn cubic(&mut self) -> Option<&mut Cubic> {
        (self.looking == 0).then_some(&mut self.cubic)
    }

    /// CUBIC, to be told what is also true during a look.
    pub(super) fn cubic_always(&mut self) -> &mut Cubic {
        &mut self.cubic
    }

    /// The window; `None` during a look, when it is the smallest.
    pub(super) fn window(&self) -> Option<u64> {
        (self.looking == 0).then(|| self.cubic.window())
    }

    /// The window that CUBIC has.
    pub(super) fn share(&self) -> u64 {
        self.cubic.window()
    }

    /// Ends a round on a path whose shortest round trip and wanted queue are these.
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
        // The queue of somebody else is never twice the same.
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
        // Of this link alone: the rate stays.
        let mut own = Standing::new(start, 100_000, 1e6);
        for time in 1..20_u32 {
            let window = 100_000 >> time.min(6);
            assert_eq!(own.shrink(start + millis(200) * time, window, 1e6), None);
        }
        let mut others = Standing::new(start, 100_000, 1e6);
        let mut shrink = |time: u32, window: u64| {
            others.shrink(start + millis(200) * time, window, window as f64 * 10.0)
        };
        assert_eq!(shrink(1, 50_000), None, "it may still drain");
        assert_eq!(shrink(2, 25_000), None);
        assert_eq!(shrink(3, 12_500), None);
        assert_eq!(shrink(5, 6_250), Some(100_000));
    }

    /// Ends rounds of 40 ms until a look is over, which sees `shortest`.
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
