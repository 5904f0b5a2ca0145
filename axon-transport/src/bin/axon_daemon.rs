//! The AXON daemon as a program of its own.
//!
//! Started by the first session of a user and domain, it ends when no session has needed it for its
//! grace time. Started by hand or by a service manager, it stays in the foreground until SIGTERM or
//! SIGINT. It takes its settings from the environment.

use std::process::ExitCode;

use axon_transport::{
    daemon::{self, ErasingHeap, Start},
    session::daemon::spawn::{DETACHED, SPAWNED},
};

#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let start = match arguments.as_slice() {
        [] => Start::Foreground,
        [flag] if flag == SPAWNED => Start::Spawned,
        [flag] if flag == DETACHED => Start::Detached,
        _ => return usage(),
    };
    daemon::main(start)
}

#[allow(clippy::print_stderr)]
fn usage() -> ExitCode {
    eprintln!("axon_daemon takes no arguments: its settings are environment variables");
    ExitCode::from(2)
}
