//! The AXON daemon as a program of its own.
//!
//! Started by the first session of a user and domain, it ends when no session has needed it for its
//! grace time. Started by hand or by a service manager, it stays in the foreground until SIGTERM or
//! SIGINT. It takes its settings from the environment.

use std::process::ExitCode;

use axon_daemon::{ErasingHeap, Start};

#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    match Start::from_arguments(std::env::args_os().skip(1)) {
        Some(start) => axon_daemon::main(start),
        None => usage(),
    }
}

#[allow(clippy::print_stderr)]
fn usage() -> ExitCode {
    eprintln!("axon_daemon takes no arguments: its settings are environment variables");
    ExitCode::from(2)
}
