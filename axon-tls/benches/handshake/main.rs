//! What a handshake costs: processor time of both ends, and bytes each way.
//!
//! ```text
//! cargo bench -p axon-tls --features quic --bench handshake -- --out ../docs/benchmarks
//! ```
//!
//! prints the tables of `docs/benchmarks.md` and writes `handshake.json` and `handshake.svg` to the
//! directory, or to the build's temporary one if none is given. Client and server are in one thread and
//! exchange buffers, so the time of a handshake is what both of them compute. All cases take turns
//! within one run, batch by batch and beginning with another one each round, so that whatever
//! disturbs the machine hits all of them; that is why this is no Criterion benchmark, which
//! measures one after the other.

#![allow(clippy::print_stdout, reason = "the tables")]

mod cases;
mod measure;
#[path = "../../tests/common/pair.rs"]
mod pair;
mod plot;
mod report;

use std::path::PathBuf;
use std::time::Duration;

use axon_tls::Cipher;
use cases::Transport;
use measure::{Effort, measure};
use report::Table;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    // Without `--bench` this is `cargo test`, which only wants to see it run.
    let effort = if arguments.iter().any(|argument| argument == "--bench") {
        Effort { time: Duration::from_secs(40), rounds: 50, batch: 10 }
    } else {
        Effort { time: Duration::ZERO, rounds: 1, batch: 1 }
    };
    let out = arguments.iter().skip_while(|argument| *argument != "--out").nth(1);
    let out = out.map_or_else(|| PathBuf::from(env!("CARGO_TARGET_TMPDIR")), PathBuf::from);

    let mut tables = Vec::new();
    for cipher in Cipher::ALL {
        for transport in Transport::ALL {
            let mut cases = cases::all(transport, cipher);
            let measured = measure(&mut cases, effort);
            let table = Table { transport, cipher, rows: report::rows(&cases, &measured) };
            println!("{}", table.markdown());
            tables.push(table);
        }
    }

    std::fs::create_dir_all(&out).unwrap();
    std::fs::write(out.join("handshake.json"), report::json(&tables)).unwrap();
    std::fs::write(out.join("handshake.svg"), plot::svg(&tables)).unwrap();
    println!("handshake.json and handshake.svg are in {}", out.display());
}
