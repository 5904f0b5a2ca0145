//! What an envelope costs over the bare AEAD, as the tables of `benches/README.md`.
//!
//! `cargo bench -p axon-envelope --all-features`, on a machine with little else to do. Envelope and
//! bare AEAD take turns within one run, batch by batch, so that whatever disturbs the machine hits
//! both; that is why this is no Criterion benchmark, which measures one after the other.

#![allow(clippy::print_stdout, reason = "the tables")]

mod bed;
mod fixed;
mod ratio;

use std::time::Duration;

use axon_envelope::aead::Aead;

/// How long to measure.
#[derive(Clone, Copy)]
struct Effort {
    /// For each number of a table.
    time: Duration,
    /// Rounds at least.
    rounds: usize,
}

fn tables<A: Aead>(effort: Effort) {
    ratio::table::<A>(effort);
    fixed::aead_table::<A>(effort);
}

fn main() {
    // Without `--bench` this is `cargo test`, which only wants to see it run.
    let effort = if std::env::args().any(|argument| argument == "--bench") {
        Effort { time: Duration::from_millis(800), rounds: 25 }
    } else {
        Effort { time: Duration::ZERO, rounds: 1 }
    };
    #[cfg(feature = "aws-lc-rs")]
    tables::<axon_envelope::aead::AwsLc>(effort);
    #[cfg(feature = "rust-crypto")]
    tables::<axon_envelope::aead::RustCrypto>(effort);
    fixed::envelope_table(effort);
}
