//! Random programs over several processes against a reference model: every node and endpoint in every
//! process's graph, field by field; who is matched with whom and why others are not, by ROS 2's rules;
//! what each endpoint's statuses say; which samples a subscription takes, in which order and under which
//! numbers, which of the rest are lost, too old or passed over, and what its event counts of them; whom a
//! publisher waits for; which requests a server gets and which responses a client; and what a wait finds
//! ready. Nodes and endpoints come and go, processes are killed, and so is the daemon.
//!
//! A bounded sample of them; more: `PROGRAMS=200 cargo test -p axon-daemon --test program`. One that
//! failed says its seed, and `PROGRAM_SEED=...` repeats it alone.

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
/// Programs of an ordinary run.
const FEW: u64 = 12;

/// Not a test of its own: what each of the processes does.
#[test]
fn child() {
    if std::env::var("PLAY").is_ok() {
        cast::play();
    }
}

/// Says which program failed.
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
    // One alone need not come across all.
    if one.is_none() {
        let not_seen = steps::not_seen(&sights);
        assert!(not_seen.is_empty(), "no program had {not_seen:?}, only {sights:#?}");
    }
}
