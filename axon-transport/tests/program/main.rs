//! Random programs over several processes against a reference model: who is matched with whom, what
//! every process's graph shows, which samples a subscription takes and in which order, and that none
//! is lost; which requests a server gets and which responses a client; and what a wait set finds ready.
//! Endpoints come and go, processes are killed, and so is the daemon.
//!
//! A bounded sample of them; more: `PROGRAMS=200 cargo test -p axon-transport --test program`. One that
//! failed says its seed, and `PROGRAM_SEED=...` repeats it alone.

mod cast;
mod model;
mod stage;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod support;

use stage::Stage;

const STEPS: usize = 60;
/// Programs of an ordinary run.
const FEW: u64 = 3;

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
fn processes_see_and_take_what_the_model_says() {
    if std::env::var("PLAY").is_ok() {
        return;
    }
    let number = |name: &str| std::env::var(name).ok().map(|n| n.parse::<u64>().unwrap());
    let seeds = match number("PROGRAM_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("PROGRAMS").unwrap_or(FEW),
    };
    for seed in seeds {
        let running = Running(seed);
        let mut stage = Stage::new(seed);
        let mut steps = Vec::new();
        for _ in 0..STEPS {
            steps.push(stage.step());
            stage.settle();
        }
        // What is left is taken, too.
        for _ in 0..4 * stage.subscriptions() {
            stage.take();
            stage.wait();
        }
        for step in ["create", "publish", "take", "end"] {
            assert!(steps.contains(&step), "no program without {step}");
        }
        drop(running);
    }
}
