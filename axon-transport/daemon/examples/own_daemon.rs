//! A program that is its own daemon: what its first session starts is this program again.
//!
//! ```sh
//! cargo run -p axon-daemon --example own_daemon
//! ```
#![expect(clippy::print_stdout, clippy::print_stderr, reason = "what it prints is its result")]

use axon_daemon::{ErasingHeap, Start};
use axon_transport::{DaemonCommand, Session, SessionOptions, config::Config};
use std::{error::Error, process::ExitCode};

// Erases what libraries leave of keys in freed memory, while this process is the daemon.
#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    // A session starts this program with a flag of its own.
    match Start::from_arguments(std::env::args_os().skip(1)) {
        Some(start @ (Start::Spawned | Start::Detached)) => axon_daemon::main(start),
        _ => application().map_or_else(
            |error| {
                eprintln!("{error}");
                ExitCode::FAILURE
            },
            |()| ExitCode::SUCCESS,
        ),
    }
}

fn application() -> Result<(), Box<dyn Error>> {
    let itself = DaemonCommand::current_executable([""; 0])?;
    let options = SessionOptions::new("example").daemon_command(itself);
    let session = Session::open(&Config::from_env()?, options)?;
    println!("the daemon is {:?}", session.daemon());
    Ok(())
}
