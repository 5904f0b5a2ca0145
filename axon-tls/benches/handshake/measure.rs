//! All cases by turns.

use std::time::{Duration, Instant};

use crate::cases::{Case, Traffic};

/// How long to measure.
#[derive(Clone, Copy)]
pub(crate) struct Effort {
    /// For all cases of a table together.
    pub(crate) time: Duration,
    /// Rounds at least.
    pub(crate) rounds: usize,
    /// Handshakes of a case in each round.
    pub(crate) batch: u32,
}

/// What was measured of one case.
pub(crate) struct Measured {
    /// Seconds of one handshake, in each round.
    pub(crate) rounds: Vec<f64>,
    /// Bytes of a handshake.
    pub(crate) traffic: Traffic,
}

/// Measures `cases`; the round's number is the same in all of them.
pub(crate) fn measure(cases: &mut [Case], effort: Effort) -> Vec<Measured> {
    let mut measured: Vec<Measured> = cases
        .iter_mut()
        .map(|case| Measured { rounds: Vec::new(), traffic: (case.handshake)() })
        .collect();
    let start = Instant::now();
    let mut round = 0;
    while round < effort.rounds || start.elapsed() < effort.time {
        for turn in 0..cases.len() {
            let at = (round + turn) % cases.len();
            let before = processor_time();
            for _ in 0..effort.batch {
                (cases[at].handshake)();
            }
            let took = processor_time() - before;
            measured[at].rounds.push((took / effort.batch).as_secs_f64());
        }
        round += 1;
    }
    measured
}

/// What this thread has had of a processor: waiting for one does not count.
#[cfg(unix)]
fn processor_time() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

#[cfg(not(unix))]
fn processor_time() -> Duration {
    static START: std::sync::LazyLock<Instant> = std::sync::LazyLock::new(Instant::now);
    START.elapsed()
}

pub(crate) fn least(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}

pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
