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

/// So many lines wait at most.
const ROOM: usize = 256;

/// What a process has said and its thread has not told yet.
#[derive(Default)]
pub(super) struct WaitingLines {
    state: Mutex<QueueState>,
    more: Condvar,
}

#[derive(Default)]
struct QueueState {
    lines: VecDeque<LogLine>,
    /// How many more there would have been.
    lost: u64,
    /// Whether the thread runs.
    runs: bool,
}

thread_local! {
    /// Whose lines this thread tells.
    static TELLS: Cell<*const WaitingLines> = const { Cell::new(ptr::null()) };
}

impl WaitingLines {
    /// Whether this is the thread that calls the program. In a child that a callback forked it is not:
    /// the lines there are others.
    pub(super) fn is_teller(&self) -> bool {
        ptr::eq(TELLS.get(), self)
    }

    /// Has `tell` called with it soon.
    pub(super) fn say(&'static self, line: LogLine, tell: impl Fn(LogLine) + Send + 'static) {
        let mut state = self.lock();
        if !state.runs {
            let blocked = BlockedSignals::all();
            let run = move || self.tell_all(tell);
            let started = thread::Builder::new().name("axon-log".into()).spawn(run);
            drop(blocked);
            // With the next line it is tried again.
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
