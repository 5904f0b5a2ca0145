//! The daemon for tests: like `axon_daemon`, and it ends with its standard input when it is told
//! to by `--while-stdin`.

use std::process::ExitCode;

use axon_transport::{
    daemon::{self, ErasingHeap, Start},
    session::daemon::spawn::{DETACHED, SPAWNED},
};

#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    let start = match std::env::args().nth(1).as_deref() {
        Some(SPAWNED) => Start::Spawned,
        Some(DETACHED) => Start::Detached,
        Some("--while-stdin") => {
            std::thread::spawn(axon_tests::end_with_stdin);
            Start::Foreground
        }
        _ => Start::Foreground,
    };
    daemon::main(start)
}
