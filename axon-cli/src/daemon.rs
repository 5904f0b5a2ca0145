//! `axon daemon`: runs the daemon in the foreground, or as a session of this tool starts it.

use std::{io::Read, process::ExitCode, thread};

use axon_daemon::Start;
use rustix::process::{Signal, getpid, kill_process};

use crate::{cli, failure::CliError, logging};

/// Runs `axon daemon`.
pub(crate) fn run(args: &cli::Daemon) -> Result<ExitCode, CliError> {
    logging::check()?;
    let start = match (args.spawned, args.detached) {
        (true, _) => Start::Spawned,
        (_, true) => Start::Detached,
        _ => Start::Foreground,
    };
    if args.while_stdin {
        thread::spawn(end_with_stdin);
    }
    Ok(axon_daemon::main(start))
}

/// Ends this process as SIGTERM does when standard input ends.
fn end_with_stdin() {
    let mut ignored = [0; 64];
    while std::io::stdin().read(&mut ignored).is_ok_and(|count| count > 0) {}
    // A signal to this process itself does not fail.
    let _ = kill_process(getpid(), Signal::TERM);
}
