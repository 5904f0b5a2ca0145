//! From single times to what is reported.

use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::{Map, Value, json};

/// Those that are reported, in percent.
pub(crate) const PERCENTILES: [f64; 13] =
    [0.0, 1.0, 5.0, 10.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0, 99.9, 99.99, 100.0];

/// How long to measure.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Effort {
    /// Turns of each medium.
    pub(crate) rounds: usize,
    /// Length of a turn, about.
    pub(crate) turn: Duration,
    /// Messages of a turn at least, and at most.
    pub(crate) messages: [u64; 2],
    /// Turns of each medium where messages have a pace.
    pub(crate) paced_rounds: usize,
    /// Messages of such a turn.
    pub(crate) paced_messages: u64,
}

impl Effort {
    /// For figures.
    pub(crate) const FULL: Self = Self {
        rounds: 21,
        turn: Duration::from_millis(10),
        messages: [3, 50_000],
        paced_rounds: 5,
        paced_messages: 100,
    };
    /// To see it run.
    pub(crate) const QUICK: Self = Self {
        rounds: 3,
        turn: Duration::from_millis(1),
        messages: [4, 1_000],
        paced_rounds: 3,
        paced_messages: 4,
    };

    /// How many messages fill a turn when `messages` took `elapsed`.
    pub(crate) fn count(&self, messages: u64, elapsed: Duration) -> u64 {
        let [least, most] = self.messages;
        let each = (elapsed.as_secs_f64() / messages as f64).max(1e-9);
        ((self.turn.as_secs_f64() / each).round() as u64).clamp(least, most)
    }
}

/// One turn's times in nanoseconds.
#[derive(Clone, Debug)]
pub(crate) struct Summary {
    /// How many times there were.
    pub(crate) count: usize,
    pub(crate) mean: f64,
    /// At [`PERCENTILES`].
    pub(crate) at: [f64; PERCENTILES.len()],
}

impl Summary {
    /// The median of the turn's times.
    pub(crate) fn p50(&self) -> f64 {
        self.at[5]
    }

    /// A percentile of [`PERCENTILES`], where there were enough times to tell it from the worst.
    pub(crate) fn tail(&self, percent: f64) -> Option<f64> {
        let index = PERCENTILES.iter().position(|p| *p == percent)?;
        let beyond = self.count as f64 * (100.0 - percent) / 100.0;
        (beyond.round() >= 1.0).then_some(self.at[index])
    }
}

impl Summary {
    fn json(&self) -> Value {
        let percentiles: Map<String, Value> = PERCENTILES
            .iter()
            .zip(self.at)
            .map(|(percent, ns)| (format!("p{percent}"), json!(tenths(ns))))
            .collect();
        json!({
            "count": self.count, "mean_ns": tenths(self.mean), "percentiles_ns": percentiles,
        })
    }
}

fn tenths(ns: f64) -> f64 {
    (ns * 10.0).round() / 10.0
}

/// Sums times up, and sorts them.
fn summarize(times: &mut [f64]) -> Summary {
    times.sort_by(f64::total_cmp);
    let last = times.len() - 1;
    let at =
        PERCENTILES.map(|p| times[((p / 100.0 * times.len() as f64).round() as usize).min(last)]);
    Summary { count: times.len(), mean: times.iter().sum::<f64>() / times.len() as f64, at }
}

/// All turns of one medium under one load.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rounds {
    turns: Vec<Summary>,
    /// The times of all turns.
    times: Vec<f64>,
    /// Processor time of a message, by turns, in nanoseconds.
    cpu: Vec<f64>,
}

impl Rounds {
    /// Adds a turn's times, and the nanoseconds of processor time that a message took in all
    /// processes.
    pub(crate) fn add(&mut self, mut times: Vec<f64>, cpu: f64) {
        self.turns.push(summarize(&mut times));
        self.times.append(&mut times);
        self.cpu.push(cpu);
    }

    /// Nanoseconds of processor time of a message, in all processes: the median of the turns.
    pub(crate) fn cpu(&self) -> f64 {
        median(self.cpu.clone())
    }

    /// All times together, whatever disturbed the machine meanwhile among them.
    pub(crate) fn all(&self) -> Summary {
        summarize(&mut self.times.clone())
    }

    /// The turn with the least median: the one that was disturbed least.
    pub(crate) fn best(&self) -> &Summary {
        let least = |a: &&Summary, b: &&Summary| a.p50().total_cmp(&b.p50());
        self.turns.iter().min_by(least).expect("there is a round at least")
    }

    /// The median of the turns' medians.
    pub(crate) fn typical(&self) -> f64 {
        median(self.turns.iter().map(Summary::p50).collect())
    }

    /// The best turn, and all of them.
    pub(crate) fn json(&self) -> Value {
        json!({
            "best_round": self.best().json(),
            "all_rounds": self.all().json(),
            "median_of_p50_ns": tenths(self.typical()),
            "cpu_ns_a_message": tenths(self.cpu()),
            "rounds": self.turns.len(),
        })
    }

    /// How many times what `limit` took this one took.
    pub(crate) fn to(&self, limit: &Self) -> Ratio {
        let rounds = self.turns.iter().zip(&limit.turns).map(|(own, of)| own.p50() / of.p50());
        Ratio { best: self.best().p50() / limit.best().p50(), median: median(rounds.collect()) }
    }
}

/// How many times longer one took than the other.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Ratio {
    /// Of the best turns.
    pub(crate) best: f64,
    /// The median of the rounds' ratios.
    pub(crate) median: f64,
}

/// The median of `values`, which are not empty.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// What one look at the clock takes, in nanoseconds: taken off each time, for there is one look a
/// message.
pub(crate) fn clock_cost() -> f64 {
    const LOOKS: u32 = 10_000;
    let batch = || {
        let start = Instant::now();
        for _ in 0..LOOKS {
            std::hint::black_box(Instant::now());
        }
        start.elapsed().as_secs_f64() * 1e9 / f64::from(LOOKS)
    };
    (0..20).map(|_| batch()).fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_sorted_times() {
        let mut times: Vec<f64> = (0..1000).rev().map(f64::from).collect();
        let summary = summarize(&mut times);
        assert_eq!((summary.count, summary.mean, summary.p50()), (1000, 499.5, 500.0));
        assert_eq!(summary.at.first().zip(summary.at.last()), Some((&0.0, &999.0)));
        assert_eq!((summary.tail(99.0), summary.tail(99.9)), (Some(990.0), Some(999.0)));
        assert_eq!(summary.tail(99.99), None, "of a thousand times nobody knows it");
        assert_eq!(summarize(&mut [7.0]).at, [7.0; PERCENTILES.len()]);
    }

    #[test]
    fn a_ratio_of_the_best_turns_and_the_median_of_the_rounds() {
        let rounds = |turns: [&[f64]; 3]| {
            let mut rounds = Rounds::default();
            turns
                .iter()
                .zip([3.0, 1.0, 2.0])
                .for_each(|(times, cpu)| rounds.add(times.to_vec(), cpu));
            rounds
        };
        let own = rounds([&[20.0], &[90.0], &[30.0]]);
        let limit = rounds([&[10.0], &[10.0], &[5.0]]);
        assert_eq!((own.all().count, own.all().mean), (3, 140.0 / 3.0));
        let ratio = own.to(&limit);
        assert_eq!((ratio.best, ratio.median), (4.0, 6.0));
        assert_eq!((own.best().p50(), own.typical(), own.cpu()), (20.0, 30.0, 2.0));
    }

    #[test]
    fn a_turn_has_as_many_messages_as_fill_it_within_bounds() {
        let effort = Effort { messages: [8, 50_000], ..Effort::FULL };
        assert_eq!(effort.count(10, Duration::from_micros(100)), 1_000);
        assert_eq!(effort.count(1, Duration::from_secs(1)), 8);
        assert_eq!(effort.count(1_000, Duration::ZERO), 50_000);
    }
}
