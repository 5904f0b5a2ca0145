//! Processes publish to each other and call each other while some of them are killed, stopped and continued at
//! random, and the daemon is killed under them. Publishers, and processes, end 0.3 to 1 s after another process was
//! continued. One process of three is in a PID namespace of its own, with the outer or a new `/proc`, where the
//! machine allows that: the first line of output says where it does not.
//!
//! Samples are of 0 bytes to 25 MB and carry their number and a pattern of it. Some are published through loans that
//! are held while other samples go out; readers hold some. What must hold: every sample is whole; a KEEP_ALL
//! subscription misses none of a publisher that lives, repeats none of any, takes all of one that ended, and what it
//! misses of one that was killed, or that ended around a daemon's kill, it counts, that of a publisher included which
//! it was never told of; every call is seen once by each server, and answered once by each that lives; no process fails
//! or stands still; the memory they hold together stays below a ceiling. At the end the disturbances cease, every
//! process must come to have the last sample of every other, and every call its answers.
//! When something is missing, both processes print the history of the pair.
//!
//! There are three plans. `Brief`: eight processes, stopped for some tenths of a second, often. `Stops`: twelve, stopped
//! for one to four seconds, while the daemon is killed. `Ends`: the same twelve, and the daemon lives: there no reader may
//! miss anything of a publisher that ended by itself, counted or not.
//!
//! One round of some seconds of each by default. For longer, `cargo test --release -p axon-daemon
//! --test torture -- --minutes 60`: rounds of half a minute, each of another seed, and a line of a table
//! for each. The plans take turns; `--stops` leaves the first one out. `--seed N` begins with that one: the same
//! disturbances again, though not the same moments.
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

/// How long the processes are disturbed in an ordinary run, by each plan.
const SHORT: [(Plan, Duration); 3] = [
    (Plan::Brief, Duration::from_secs(6)),
    (Plan::Stops, Duration::from_secs(12)),
    (Plan::Ends, Duration::from_secs(8)),
];
/// The plans of a long run, in turn; the first is left out with `--stops`.
const PLANS: [Plan; 3] = [Plan::Brief, Plan::Stops, Plan::Ends];
/// The same of each round of a long run.
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
