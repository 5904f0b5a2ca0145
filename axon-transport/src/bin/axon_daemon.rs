//! The AXON daemon as a program of its own.
//!
//! Started by the first session of a user and domain, or by hand, and then it stays in the
//! foreground. It takes its settings from the environment and ends when no session has needed it
//! for its grace time.

use std::{io::IsTerminal, process::ExitCode};

use axon_transport::{
    config::Config,
    daemon::{
        Start,
        spawn::{DETACHED, SPAWNED},
    },
};
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    let start = match arguments.as_slice() {
        [] => Start::Foreground,
        [flag] if flag == SPAWNED => Start::Spawned,
        [flag] if flag == DETACHED => Start::Detached,
        _ => return usage(),
    };
    axon_transport::daemon::main(start, log)
}

#[allow(clippy::print_stderr)]
fn usage() -> ExitCode {
    eprintln!("axon_daemon takes no arguments: its settings are environment variables");
    ExitCode::from(2)
}

fn log(config: &Config) {
    // A filter that is not one was refused with the rest of the configuration.
    let filter = EnvFilter::try_new(&config.log).unwrap_or_else(|_| EnvFilter::new("warn"));
    let colours = std::io::stderr().is_terminal();
    let set = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(colours)
        .try_init();
    if set.is_err() {
        tracing::debug!("logging was set up before");
    }
}
