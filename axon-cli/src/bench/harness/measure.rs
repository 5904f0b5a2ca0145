//! Computes the reported figures from single times.

use std::time::{Duration, Instant};

use serde::Serialize;
use serde_json::{Map, Value, json};

/// The reported percentiles, in percent.
pub(crate) const PERCENTILES: [f64; 13] =
    [0.0, 1.0, 5.0, 10.0, 25.0, 50.0, 75.0, 90.0, 95.0, 99.0, 99.9, 99.99, 100.0];

/// The length of a measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Effort {
    /// The turns of each medium.
    pub(crate) rounds: usize,
    /// The approximate length of a turn.
    pub(crate) turn: Duration,
    /// The fewest and the most messages of a turn.
    pub(crate) messages: [u64; 2],
    /// The turns of each medium under a load with a pace.
    pub(crate) paced_rounds: usize,
    /// The messages of a turn under a load with a pace.
    pub(crate) paced_messages: u64,
}

impl Effort {
    /// The effort for figures to report.
    pub(crate) const FULL: Self = Self {
        rounds: 21,
        turn: Duration::from_millis(10),
        messages: [3, 50_000],
        paced_rounds: 5,
        paced_messages: 100,
    };
    /// The effort for a trial run.
    pub(crate) const QUICK: Self = Self {
        rounds: 3,
        turn: Duration::from_millis(1),
        messages: [4, 1_000],
        paced_rounds: 3,
        paced_messages: 4,
    };

    /// Returns how many messages fill a turn if `messages` took `elapsed`.
    pub(crate) fn count(&self, messages: u64, elapsed: Duration) -> u64 {
        let [least, most] = self.messages;
        let each = (elapsed.as_secs_f64() / messages as f64).max(1e-9);
        ((self.turn.as_secs_f64() / each).round() as u64).clamp(least, most)
    }
}

/// The times of one turn, or of several, in nanoseconds.
#[derive(Clone, Debug)]
pub(crate) struct Summary {
    /// The number of times.
    pub(crate) count: usize,
    pub(crate) mean: f64,
    /// The times at [`PERCENTILES`].
    pub(crate) at: [f64; PERCENTILES.len()],
}

impl Summary {
    /// Returns the median of the times.
    pub(crate) fn p50(&self) -> f64 {
        self.at[5]
    }

    /// Returns a percentile of [`PERCENTILES`], if there were enough times to distinguish it from
    /// the maximum.
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

/// Sorts times and summarizes them.
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
    /// The processor time of a message in each turn, in nanoseconds.
    cpu: Vec<f64>,
}

impl Rounds {
    /// Adds a turn's times, and the processor time of a message in all processes, in nanoseconds.
    pub(crate) fn add(&mut self, mut times: Vec<f64>, cpu: f64) {
        self.turns.push(summarize(&mut times));
        self.times.append(&mut times);
        self.cpu.push(cpu);
    }

    /// Returns the processor time of a message in all processes, in nanoseconds, as the median of
    /// the turns.
    pub(crate) fn cpu(&self) -> f64 {
        median(self.cpu.clone())
    }

    /// Returns a summary of all times, including those that the machine disturbed.
    pub(crate) fn all(&self) -> Summary {
        summarize(&mut self.times.clone())
    }

    /// Returns the turn with the smallest median, which was disturbed least.
    pub(crate) fn best(&self) -> &Summary {
        let least = |a: &&Summary, b: &&Summary| a.p50().total_cmp(&b.p50());
        self.turns.iter().min_by(least).expect("there is a round at least")
    }

    /// Returns the median of the turns' medians.
    pub(crate) fn typical(&self) -> f64 {
        median(self.turns.iter().map(Summary::p50).collect())
    }

    /// Returns the best turn and all turns.
    pub(crate) fn json(&self) -> Value {
        json!({
            "best_round": self.best().json(),
            "all_rounds": self.all().json(),
            "median_of_p50_ns": tenths(self.typical()),
            "cpu_ns_a_message": tenths(self.cpu()),
            "rounds": self.turns.len(),
        })
    }

    /// Returns the ratio of these times to those of `limit`.
    pub(crate) fn to(&self, limit: &Self) -> Ratio {
        let rounds = self.turns.iter().zip(&limit.turns).map(|(own, of)| own.p50() / of.p50());
        Ratio { best: self.best().p50() / limit.best().p50(), median: median(rounds.collect()) }
    }
}

/// The ratio of one medium's times to another's.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Ratio {
    /// The ratio of the best turns.
    pub(crate) best: f64,
    /// The median of the rounds' ratios.
    pub(crate) median: f64,
}

/// Returns the median of `values`, which must not be empty.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Returns the time that one reading of the clock takes, in nanoseconds. It is subtracted from each
/// time, because each message needs one reading.
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
