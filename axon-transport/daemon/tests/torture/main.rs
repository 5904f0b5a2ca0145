//! Processes publish to each other and call each other. Meanwhile processes are killed, stopped and continued at
//! random, and the daemon is killed. Publishers, and processes, end 0.3 to 1 s after another process was continued. One
//! process of three is in its own PID namespace, with the outer or a new `/proc`, if the machine permits that;
//! otherwise the first line of output says so.
//!
//! Samples have 0 bytes to 25 MB and carry their number and a pattern of it. Some are published through loans that are
//! held while other samples go out; readers hold some samples. The test checks:
//!
//! - Every sample is whole.
//! - A KEEP_ALL subscription misses no sample of a living publisher, repeats none of any publisher, and takes all of
//!   one that ended. It counts the samples that it misses of a publisher that was killed, or that ended around a
//!   daemon's kill, even if it was never told of that publisher.
//! - Each server sees every call once, and each living server answers it once.
//! - No process fails or gets stuck.
//! - The memory that the processes hold together stays below a ceiling.
//!
//! At the end the disturbances cease. Then every process must get the last sample of every other, and every call its
//! answers. If something is missing, both processes print the history of the pair.
//!
//! There are three plans. `Brief`: eight processes are often stopped for some tenths of a second. `Stops`: twelve are
//! stopped for one to four seconds, while the daemon is killed. `Ends`: the same twelve, but the daemon lives; no
//! reader may miss a sample of a publisher that ended by itself, whether counted or not.
//!
//! By default, each plan runs one round of some seconds. For longer, `cargo test --release -p axon-daemon --test
//! torture -- --minutes 60` runs rounds of half a minute, each with another seed, and prints a line of a table for
//! each. The plans take turns; `--stops` leaves the first one out. `--seed N` begins with that seed: it gives the same
//! disturbances again, but not at the same moments.
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

mod child;
mod conductor;
mod pair_log;
mod sample;

use std::{
    env,
    process::ExitCode,
    time::{Duration, Instant},
};

use conductor::{Namespaces, Plan, Round};

/// Time for which the processes are disturbed in an ordinary run, by plan.
const SHORT: [(Plan, Duration); 3] = [
    (Plan::Brief, Duration::from_secs(6)),
    (Plan::Stops, Duration::from_secs(12)),
    (Plan::Ends, Duration::from_secs(8)),
];
/// The plans of a long run, in turn; `--stops` leaves the first one out.
const PLANS: [Plan; 3] = [Plan::Brief, Plan::Stops, Plan::Ends];
/// Time for which the processes are disturbed in each round of a long run.
const LONG: Duration = Duration::from_secs(25);

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let Ok(seed) = env::var(child::ROLE) {
        child::run(seed.parse().expect("a seed"));
        return ExitCode::SUCCESS;
    }
    if arguments.iter().any(|a| a == "--list") {
        println!("torture: test");
        return ExitCode::SUCCESS;
    }
    let value = |name: &str| {
        let at = arguments.iter().position(|a| a == name)?;
        arguments.get(at + 1)?.parse::<u64>().ok()
    };
    let seed = value("--seed").unwrap_or(1);
    let namespaces = Namespaces::find();
    if !namespaces.are_there() {
        println!("skipped: PID namespaces, which `unshare` cannot make here");
    }
    println!("{}", Round::heading());
    let Some(minutes) = value("--minutes") else {
        for (plan, time) in SHORT {
            println!("{}", conductor::run(plan, time, seed, &namespaces));
        }
        return ExitCode::SUCCESS;
    };
    let stops = usize::from(arguments.iter().any(|a| a == "--stops"));
    let (start, time) = (Instant::now(), Duration::from_secs(60 * minutes));
    for (seed, plan) in (seed..).zip(PLANS[stops..].iter().cycle()) {
        println!("{}", conductor::run(*plan, LONG, seed, &namespaces));
        if start.elapsed() >= time {
            break;
        }
    }
    ExitCode::SUCCESS
}
