//! Runs random programs over several processes and compares them with a reference model. Compared are:
//!
//! - every node and endpoint in every process's graph, field by field;
//! - the matches, and the reasons for mismatches, by ROS 2's rules;
//! - the statuses of each endpoint;
//! - the samples that a subscription takes, their order and numbers; the samples that are lost, expired or skipped, and
//!   the losses that its event counts;
//! - the readers for which a publisher waits;
//! - the requests of each server, and the responses of each client;
//! - the results of a wait.
//!
//! Nodes and endpoints come and go, processes are killed, and so is the daemon.
//!
//! An ordinary run executes a bounded number of programs; for more: `PROGRAMS=200 cargo test -p axon-daemon --test
//! program`. A failed program prints its seed, and `PROGRAM_SEED=...` repeats it alone.

mod cast;
mod model;
mod orders;
#[path = "../support/rules.rs"]
mod rules;
mod stage;
mod steps;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod support;
mod watch;

use std::collections::BTreeMap;

use stage::Stage;

const STEPS: usize = 100;
/// Number of programs of an ordinary run.
const FEW: u64 = 12;

/// The code of the processes; not a test of its own.
#[test]
fn child() {
    if std::env::var("PLAY").is_ok() {
        cast::play();
    }
}

/// Reports which program failed.
struct Running(u64);

impl Drop for Running {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("PROGRAM_SEED={} repeats this", self.0);
        }
    }
}

#[test]
fn processes_see_and_take_as_the_model_predicts() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let number = |name: &str| std::env::var(name).ok().map(|n| n.parse::<u64>().unwrap());
    let one = number("PROGRAM_SEED");
    let seeds = match one {
        Some(seed) => seed..seed + 1,
        None => 0..number("PROGRAMS").unwrap_or(FEW).max(FEW),
    };
    let mut sights: BTreeMap<String, u64> = BTreeMap::new();
    for seed in seeds {
        let running = Running(seed);
        let mut stage = Stage::new(seed);
        for _ in 0..STEPS {
            stage.step();
            stage.settle();
        }
        stage.drain();
        for (sight, count) in &stage.sights {
            *sights.entry(sight.clone()).or_default() += count;
        }
        drop(running);
    }
    eprintln!("{sights:#?}");
    // A single program need not come across everything.
    if one.is_none() {
        let not_seen = steps::not_seen(&sights);
        assert!(not_seen.is_empty(), "no program had {not_seen:?}, only {sights:#?}");
    }
}
