//! The scenarios of the measurement. Each prints its figures and returns them as JSON.

mod camera;
mod cut;
mod flood;
mod losses;
mod paths;
mod slow;

use std::time::Duration;

pub(crate) use camera::camera;
pub(crate) use cut::cut;
pub(crate) use flood::flood;
pub(crate) use losses::losses;
pub(crate) use paths::paths;
pub(crate) use slow::slow;

use crate::{
    path::Settings,
    place::{Carrier, Outcome, Plan},
};

/// The options of all scenarios.
#[derive(Clone, Debug)]
pub(crate) struct Options {
    /// The path, without losses.
    pub(crate) path: Settings,
    /// How long a scenario, or each stream of one, takes; its own time if `None`.
    pub(crate) time: Option<Duration>,
    /// The losses that are tried.
    pub(crate) losses: Vec<f64>,
    /// Packets that are lost in a row, on average.
    pub(crate) burst: f64,
    /// The hosts.
    pub(crate) plan: Plan,
    /// Whether TCP is measured, too.
    pub(crate) with_tcp: bool,
}

impl Options {
    /// How long each stream flows.
    fn time(&self) -> Duration {
        self.time.unwrap_or(TIME)
    }

    /// What is measured.
    fn carriers(&self) -> &'static [Carrier] {
        if self.with_tcp { &Carrier::ALL } else { &Carrier::ALL[..1] }
    }
}

/// How long each stream flows if nothing else is said.
const TIME: Duration = Duration::from_secs(20);
const MS: u64 = 1_000_000;

impl Outcome {
    /// Ages of the messages that arrived while these were sent, in nanoseconds, in order.
    fn ages(&self) -> Vec<u64> {
        let mut ages: Vec<u64> =
            self.taken.arrivals.iter().map(|a| a.arrived.saturating_sub(a.sent)).collect();
        ages.sort_unstable();
        ages
    }

    /// Returns the share of the messages that arrived within this time, in percent.
    fn within(&self, time: Duration) -> f64 {
        let most = time.as_nanos() as u64;
        let count = self.ages().iter().filter(|age| **age <= most).count();
        100.0 * count as f64 / self.sent.messages.max(1) as f64
    }

    /// How many samples were published.
    fn published(&self) -> u64 {
        self.sent.messages - self.sent.refused
    }

    /// How many messages arrived, each counted once.
    fn numbers(&self) -> usize {
        let mut numbers: Vec<u64> = self.taken.arrivals.iter().map(|a| a.number).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers.len()
    }

    /// The share that arrived at all, in percent.
    fn arrived(&self) -> f64 {
        self.within(Duration::MAX)
    }
}

/// Returns the age that `percent` percent of the messages do not exceed, in milliseconds.
fn quantile(ages: &[u64], percent: usize) -> Option<f64> {
    let at = (ages.len().checked_sub(1)? * percent) / 100;
    Some(ages[at] as f64 / MS as f64)
}

fn ms(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.1} ms"))
}
