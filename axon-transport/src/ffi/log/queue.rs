//! Log lines that wait for the callback, and the thread that passes them to it.
//!
//! The thread that logs a line may hold a lock that the program waits for. At the same time the program may hold a
//! lock that its callback needs, such as the lock of a logger that publishes its lines. Therefore the logging thread
//! never calls the callback.

use std::{
    cell::Cell,
    collections::VecDeque,
    mem, ptr,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    thread,
};

use axon_shm::internal::BlockedSignals;

use super::{AXON_LOG_WARN, LogLine};

/// The most lines that may be queued.
const ROOM: usize = 256;

/// A queue of log lines for the thread that calls the callback.
#[derive(Default)]
pub(super) struct WaitingLines {
    state: Mutex<QueueState>,
    more: Condvar,
}

#[derive(Default)]
struct QueueState {
    lines: VecDeque<LogLine>,
    /// The number of lines that were dropped because the queue was full.
    lost: u64,
    /// Whether the thread runs.
    runs: bool,
}

thread_local! {
    /// The queue that this thread serves.
    static TELLS: Cell<*const WaitingLines> = const { Cell::new(ptr::null()) };
}

impl WaitingLines {
    /// Returns whether this thread is the one that calls the callback. In a child that a callback forked it
    /// is not: the child has a queue of its own.
    pub(super) fn is_teller(&self) -> bool {
        ptr::eq(TELLS.get(), self)
    }

    /// Queues a line. The thread of the queue calls `tell` with it soon.
    pub(super) fn say(&'static self, line: LogLine, tell: impl Fn(LogLine) + Send + 'static) {
        let mut state = self.lock();
        if !state.runs {
            let blocked = BlockedSignals::all();
            let run = move || self.tell_all(tell);
            let started = thread::Builder::new().name("axon-log".into()).spawn(run);
            drop(blocked);
            // If the thread cannot be started, the next line tries again.
            state.runs = started.is_ok();
        }
        if state.lines.len() < ROOM {
            state.lines.push_back(line);
        } else {
            state.lost += 1;
        }
        drop(state);
        self.more.notify_one();
    }

    fn tell_all(&self, tell: impl Fn(LogLine) + Send + 'static) {
        TELLS.set(self);
        let mut state = self.lock();
        loop {
            let line = match (state.lines.pop_front(), state.lost) {
                (Some(line), _) => line,
                (None, 0) => {
                    state = self.more.wait(state).unwrap_or_else(PoisonError::into_inner);
                    continue;
                }
                (None, _) => {
                    let lost = mem::take(&mut state.lost);
                    let text = format!("{lost} more lines than could wait were said");
                    LogLine { severity: AXON_LOG_WARN, part: module_path!(), text }
                }
            };
            drop(state);
            tell(line);
            state = self.lock();
        }
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
