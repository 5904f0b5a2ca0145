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

/// The class whose threads close a descriptor. No class waits for descriptors of another class.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FdClass {
    /// Memory: giving it back may take long, but cannot block.
    Memory,
    /// A descriptor that a session of this user, or of a trusted one, sent.
    Session,
    /// Connections of any process.
    Stranger,
}

/// Maximum number of threads of each class.
const THREADS: [usize; 3] = [1, 32, 8];
/// Number of waiting descriptors of each class from which on no more are accepted.
const MAX_WAITING: [usize; 3] = [usize::MAX, 1024, 256];

/// Number of open descriptors from other processes, including descriptors that wait to be closed.
pub(super) static OPEN: AtomicU64 = AtomicU64::new(0);

/// Counts one descriptor less.
pub(super) fn closed() {
    OPEN.fetch_sub(1, Ordering::Relaxed);
}

impl FdClass {
    pub(super) fn close(self, fd: OwnedFd) {
        match current() {
            Some(closer) => closer.crews[self as usize].close(fd),
            // Blocking here is better than keeping it open for ever.
            None => drop(fd),
        }
    }

    /// Returns whether so many descriptors wait that no more should be accepted.
    pub(super) fn is_full(self) -> bool {
        self.waiting() >= MAX_WAITING[self as usize]
    }

    /// Returns the number of descriptors that wait for a thread.
    pub(super) fn waiting(self) -> usize {
        current().map_or(0, |closer| closer.crews[self as usize].lock().waiting.len())
    }

    #[cfg(test)]
    pub(super) fn threads(self) -> usize {
        THREADS[self as usize]
    }
}

/// The closing threads of a process: a forked child has none of its parent's.
struct Closer {
    crews: [CloserPool; 3],
}

/// The threads of a class. A thread that finds nothing to do waits, and ends if another waits already.
struct CloserPool {
    most: usize,
    state: Mutex<CloserState>,
    work: Condvar,
}

#[derive(Default)]
struct CloserState {
    threads: usize,
    /// Number of the threads that wait.
    idle: usize,
    waiting: Vec<OwnedFd>,
}

static CLOSER: PerProcess<Closer> = PerProcess::new();

/// Returns the closer of this process; `None` if there is no memory for the token that distinguishes it from its
/// parent's.
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
    /// Takes over the descriptors that waited in the parent when this process was forked. By now they may be the last
    /// references to their objects.
    fn inherit(&'static self, before: &Closer) {
        for (crew, before) in self.crews.iter().zip(&before.crews) {
            // A list that was locked at the fork stays locked for ever; its descriptors stay open here.
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
            // The next descriptor to close starts a thread for both.
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

    /// Takes the lock, which is held only for a push or pop, and by threads of this process only.
    fn lock(&self) -> MutexGuard<'_, CloserState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Disables lingering of a network socket for data that its peer does not take. Reading and setting the option may
/// block as the close may.
fn disable_linger(fd: &OwnedFd) {
    let internet = [AddressFamily::INET, AddressFamily::INET6];
    if sockopt::socket_domain(fd.as_fd()).is_ok_and(|domain| internet.contains(&domain)) {
        let _ = sockopt::set_socket_linger(fd.as_fd(), None);
    }
}
