//! Lines that wait to be told, and the thread that tells them.
//!
//! Who says something may hold locks that the program waits for in turn, with one of its own held that
//! its callback needs (the lock of a logger that publishes what it logs). So the callback is never called
//! from there.

use std::{
    cell::Cell,
    collections::VecDeque,
    mem,
    sync::{Condvar, Mutex, MutexGuard, PoisonError, TryLockError},
    thread,
};

use super::{AXON_LOG_WARN, Line};

/// So many lines wait at most.
const ROOM: usize = 256;

struct Waiting {
    lines: VecDeque<Line>,
    /// How many more there would have been.
    lost: u64,
    /// The process in which the thread runs, if it does: it is not in a forked child.
    runs_in: Option<u32>,
}

static WAITING: Mutex<Waiting> =
    Mutex::new(Waiting { lines: VecDeque::new(), lost: 0, runs_in: None });
static MORE: Condvar = Condvar::new();

thread_local! {
    static TELLS: Cell<bool> = const { Cell::new(false) };
}

/// Whether this is the thread that calls the program.
pub(super) fn is_teller() -> bool {
    TELLS.get()
}

/// Has the program told of it soon.
pub(super) fn say(line: Line) {
    let Some(mut waiting) = lock() else { return };
    let process = std::process::id();
    if waiting.runs_in != Some(process) {
        if waiting.runs_in.is_some() {
            // The parent tells what was said before the fork.
            waiting.lines.clear();
            waiting.lost = 0;
        }
        let started = thread::Builder::new().name("axon-log".into()).spawn(tell_all);
        // With the next line it is tried again.
        waiting.runs_in = started.is_ok().then_some(process);
    }
    if waiting.lines.len() < ROOM {
        waiting.lines.push_back(line);
    } else {
        waiting.lost += 1;
    }
    drop(waiting);
    MORE.notify_one();
}

/// `None` where it is held by nobody who could let it go: by a thread that was not forked.
fn lock() -> Option<MutexGuard<'static, Waiting>> {
    for _ in 0..1000 {
        match WAITING.try_lock() {
            Ok(waiting) => return Some(waiting),
            Err(TryLockError::Poisoned(poisoned)) => return Some(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => thread::yield_now(),
        }
    }
    None
}

fn tell_all() {
    TELLS.set(true);
    let mut waiting = WAITING.lock().unwrap_or_else(PoisonError::into_inner);
    loop {
        let line = match (waiting.lines.pop_front(), waiting.lost) {
            (Some(line), _) => line,
            (None, 0) => {
                waiting = MORE.wait(waiting).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            (None, _) => {
                let lost = mem::take(&mut waiting.lost);
                let text = format!("{lost} more lines than could wait were said");
                Line { severity: AXON_LOG_WARN, part: module_path!(), text }
            }
        };
        drop(waiting);
        line.tell();
        waiting = WAITING.lock().unwrap_or_else(PoisonError::into_inner);
    }
}
