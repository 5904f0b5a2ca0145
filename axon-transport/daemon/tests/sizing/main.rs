//! The cost of many processes with many endpoints: what each holds because of the others, if each
//! reads from each ([`held`]), and how soon all know all if they start at once ([`startup`]).
//!
//! In the full size: `SIZING=50 cargo test --release -p axon-daemon --test sizing -- --nocapture`
#![expect(clippy::print_stdout, reason = "what it prints is its result")]

mod held;
mod startup;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "what other tests need of it")]
mod support;

/// Number of topics. Each process or session has a publisher and a subscription for each.
const TOPICS: usize = 10;

/// Returns the number of processes: `few` in an ordinary run.
fn size(few: usize) -> usize {
    std::env::var("SIZING").ok().map_or(few, |n| n.parse().unwrap())
}

/// The code of the processes; not a test of its own.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let (part, number) = part.split_once(' ').unwrap();
    let number = number.parse().unwrap();
    match part {
        "held" => held::play(number),
        "sessions" => startup::play_sessions(number),
        "node" => startup::play_node(number),
        _ => panic!("{part}"),
    }
}
