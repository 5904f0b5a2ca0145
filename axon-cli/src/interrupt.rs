//! SIGINT, SIGTERM and SIGHUP as a condition at which a session waits, so that a command can say how it was
//! before it ends.

use std::{io, process, thread};

use axon_transport::{GuardCondition, Session};
use tokio::{
    runtime,
    signal::unix::{SignalKind, signal},
};

/// Whether whoever started this process had it outlive its terminal, as `nohup` does.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    // Signal 1 is the lowest bit.
    mask.is_some_and(|mask| mask & 1 == 1)
}

/// A condition that is triggered by the first signal. The second ends the process.
///
/// # Errors
/// When the system does not let signals be followed.
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
        // The command may hang in a write that nobody reads.
        signal();
        process::exit(130);
    })?;
    Ok(condition)
}
