//! SIGINT and SIGTERM as a condition at which a session waits, so that a command can say how it was
//! before it ends.

use std::{io, process, thread};

use axon_transport::{GuardCondition, Session};
use tokio::{
    runtime,
    signal::unix::{SignalKind, signal},
};

/// A condition that is triggered by the first signal. The second ends the process.
///
/// # Errors
/// When the system does not let signals be followed.
pub(crate) fn of(session: &Session) -> io::Result<GuardCondition> {
    let guard = session.create_guard_condition();
    let condition = guard.clone();
    let runtime = runtime::Builder::new_current_thread().enable_io().build()?;
    let (mut interrupt, mut terminate) = {
        let _context = runtime.enter();
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?)
    };
    thread::Builder::new().name("signals".into()).spawn(move || {
        let mut signal = || {
            runtime.block_on(async {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
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
