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

use super::LogLine;

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
    dropped: DroppedLines,
    /// Whether the thread runs.
    runs: bool,
}

/// The lines that were dropped because the queue was full.
#[derive(Default)]
struct DroppedLines {
    count: u64,
    /// The highest severity among them.
    severity: u32,
}

impl DroppedLines {
    fn add(&mut self, severity: u32) {
        self.count += 1;
        self.severity = self.severity.max(severity);
    }

    /// Returns a line that says how many lines were dropped, if any were. It has the severity of the most severe one, so
    /// that a program which shows warnings alone is not told of dropped debug lines.
    fn take(&mut self) -> Option<LogLine> {
        let Self { count, severity } = mem::take(self);
        let text = format!("{count} log lines were dropped: more than {ROOM} waited");
        (count > 0).then_some(LogLine { severity, part: module_path!(), text })
    }
}

impl QueueState {
    /// Adds a line. A full queue drops a line of the lowest severity, and of these the oldest.
    fn add(&mut self, line: LogLine) {
        if self.lines.len() < ROOM {
            return self.lines.push_back(line);
        }
        let least = (0..self.lines.len()).min_by_key(|at| self.lines[*at].severity);
        match least.filter(|at| self.lines[*at].severity < line.severity) {
            Some(at) => {
                let less = self.lines.remove(at);
                self.lines.push_back(line);
                less.iter().for_each(|less| self.dropped.add(less.severity));
            }
            None => self.dropped.add(line.severity),
        }
    }
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
        state.add(line);
        drop(state);
        self.more.notify_one();
    }

    fn tell_all(&self, tell: impl Fn(LogLine) + Send + 'static) {
        TELLS.set(self);
        let mut state = self.lock();
        loop {
            let next = state.lines.pop_front().or_else(|| state.dropped.take());
            let Some(line) = next else {
                state = self.more.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ffi::log::{AXON_LOG_DEBUG, AXON_LOG_ERROR, AXON_LOG_WARN};

    fn line(severity: u32, number: usize) -> LogLine {
        LogLine { severity, part: "", text: number.to_string() }
    }

    #[test]
    fn dropped_debug_lines_are_reported_as_debug() {
        let mut state = QueueState::default();
        (0..ROOM + 44).for_each(|number| state.add(line(AXON_LOG_DEBUG, number)));
        let dropped = state.dropped.take().unwrap();
        assert_eq!(dropped.severity, AXON_LOG_DEBUG);
        assert!(dropped.text.starts_with("44 log lines"), "{}", dropped.text);
        assert!(state.dropped.take().is_none(), "once");
    }

    #[test]
    fn full_queue_drops_debug_lines_for_warnings() {
        let mut state = QueueState::default();
        (0..ROOM).for_each(|number| state.add(line(AXON_LOG_DEBUG, number)));
        (0..3).for_each(|number| state.add(line(AXON_LOG_WARN, number)));
        let warnings = state.lines.iter().filter(|line| line.severity == AXON_LOG_WARN);
        assert_eq!((state.lines.len(), warnings.count()), (ROOM, 3));
        assert_eq!(state.lines.front().unwrap().text, "3", "the oldest were dropped");
        assert_eq!(state.dropped.take().unwrap().severity, AXON_LOG_DEBUG);
        // A queue of warnings drops the next warning, and takes an error.
        (0..ROOM).for_each(|number| state.add(line(AXON_LOG_WARN, number)));
        state.add(line(AXON_LOG_ERROR, 0));
        assert_eq!(state.lines.back().unwrap().severity, AXON_LOG_ERROR);
        assert_eq!(state.dropped.take().unwrap().severity, AXON_LOG_WARN);
    }
}
