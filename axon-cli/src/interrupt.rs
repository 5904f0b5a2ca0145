//! Makes SIGINT, SIGTERM and SIGHUP a condition that a session waits for, so that a command can report its results
//! before it ends.

use std::{io, process, thread};

use axon_transport::{GuardCondition, Session};
use tokio::{
    runtime,
    signal::unix::{SignalKind, signal},
};

/// Returns whether this process was started to outlive its terminal, as `nohup` does.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    // Signal 1 is the lowest bit.
    mask.is_some_and(|mask| mask & 1 == 1)
}

/// Returns a condition that the first signal triggers. The second signal ends the process.
///
/// # Errors
/// The system does not let this process handle signals.
pub(crate) fn of(session: &Session) -> io::Result<GuardCondition> {
    let guard = session.create_guard_condition();
    let condition = guard.clone();
    let runtime = runtime::Builder::new_current_thread().enable_io().build()?;
    let (mut interrupt, mut terminate, mut hangup) = {
        let _context = runtime.enter();
        let hangup = if ignores_hangup() { None } else { Some(signal(SignalKind::hangup())?) };
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?, hangup)
    };
    thread::Builder::new().name("signals".into()).spawn(move || {
        let mut signal = || {
            runtime.block_on(async {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                    Some(_) = async { hangup.as_mut()?.recv().await } => {}
                }
            });
        };
        signal();
        guard.trigger();
        // The command may be blocked in a write to a pipe that nobody reads.
        signal();
        process::exit(130);
    })?;
    Ok(condition)
}
