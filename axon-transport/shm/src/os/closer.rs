//! Threads (`axon-close`) that close descriptors received from other processes, because closing a descriptor may
//! block.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::{
        Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
};

use rustix::net::{AddressFamily, sockopt};

use crate::os::{
    per_process::{Made, PerProcess},
    signals::BlockedSignals,
};

/// Whose threads close a descriptor. None waits for what another's wait for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FdClass {
    /// Memory: it may take long to give back, and cannot block.
    Memory,
    /// What a session of this user, or of a trusted one, sent.
    Session,
    /// Connections of anybody.
    Stranger,
}

/// Threads of each lane, at most.
const THREADS: [usize; 3] = [1, 32, 8];
/// Descriptors that wait for each lane, from which on no more are taken in.
const MAX_WAITING: [usize; 3] = [usize::MAX, 1024, 256];

/// Descriptors of others that are open, also those that wait to be closed.
pub(super) static OPEN: AtomicU64 = AtomicU64::new(0);

/// One is open no more.
pub(super) fn closed() {
    OPEN.fetch_sub(1, Ordering::Relaxed);
}

impl FdClass {
    pub(super) fn close(self, fd: OwnedFd) {
        match current() {
            Some(closer) => closer.crews[self as usize].close(fd),
            // That it may block here is better than to keep it for ever.
            None => drop(fd),
        }
    }

    /// Whether so many wait that no more should be taken in.
    pub(super) fn is_full(self) -> bool {
        self.waiting() >= MAX_WAITING[self as usize]
    }

    /// How many wait for a thread.
    pub(super) fn waiting(self) -> usize {
        current().map_or(0, |closer| closer.crews[self as usize].lock().waiting.len())
    }

    #[cfg(test)]
    pub(super) fn threads(self) -> usize {
        THREADS[self as usize]
    }
}

/// The threads of a process: a forked child has none of its parent's.
struct Closer {
    crews: [CloserPool; 3],
}

/// The threads of a lane. One that finds nothing to do waits, and ends when another waits already.
struct CloserPool {
    most: usize,
    state: Mutex<CloserState>,
    work: Condvar,
}

#[derive(Default)]
struct CloserState {
    threads: usize,
    /// Those of them that wait.
    idle: usize,
    waiting: Vec<OwnedFd>,
}

static CLOSER: PerProcess<Closer> = PerProcess::new();

/// That of this process; `None` where there is no memory to tell it from its parent's by.
fn current() -> Option<&'static Closer> {
    let new = |_| Closer {
        crews: THREADS.map(|most| CloserPool {
            most,
            state: Mutex::default(),
            work: Condvar::new(),
        }),
    };
    CLOSER.get(new, Closer::inherit).ok().map(Made::value)
}

impl Closer {
    /// Takes over what waited in the parent when this process was forked. By now its descriptors may
    /// be the last of what they stand for.
    fn inherit(&'static self, before: &Closer) {
        for (crew, before) in self.crews.iter().zip(&before.crews) {
            // One that was locked at the fork is for ever; what it holds stays open here.
            let left = before.state.try_lock().map(|mut state| std::mem::take(&mut state.waiting));
            left.unwrap_or_default().into_iter().for_each(|fd| crew.close(fd));
        }
    }
}

impl CloserPool {
    fn close(&'static self, fd: OwnedFd) {
        let mut state = self.lock();
        state.waiting.push(fd);
        if state.waiting.len() <= state.idle {
            self.work.notify_one();
            return;
        }
        if state.threads == self.most {
            return;
        }
        state.threads += 1;
        drop(state);
        let blocked = BlockedSignals::all();
        let started = thread::Builder::new().name("axon-close".into()).spawn(|| self.run());
        drop(blocked);
        if let Err(error) = started {
            // The next one that is closed starts a thread for both.
            tracing::error!(%error, "no thread to close another process's descriptor on");
            self.lock().threads -= 1;
        }
    }

    fn run(&self) {
        let mut state = self.lock();
        loop {
            if let Some(fd) = state.waiting.pop() {
                drop(state);
                disable_linger(&fd);
                drop(fd);
                closed();
                state = self.lock();
            } else if state.idle > 0 {
                state.threads -= 1;
                return;
            } else {
                state.idle += 1;
                state = self.work.wait(state).unwrap_or_else(PoisonError::into_inner);
                state.idle -= 1;
            }
        }
    }

    /// It is held for no longer than a push or pop takes, and by threads of this process only.
    fn lock(&self) -> MutexGuard<'_, CloserState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Has a socket of a network not linger over what its peer does not take. To ask and to set may block
/// as the close may.
fn disable_linger(fd: &OwnedFd) {
    let internet = [AddressFamily::INET, AddressFamily::INET6];
    if sockopt::socket_domain(fd.as_fd()).is_ok_and(|domain| internet.contains(&domain)) {
        let _ = sockopt::set_socket_linger(fd.as_fd(), None);
    }
}
