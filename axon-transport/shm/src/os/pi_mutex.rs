//! A mutex between the threads of one process with priority inheritance. While a thread of high priority waits for
//! the mutex, its holder runs at that priority, so that a thread of a priority in between cannot keep both from the
//! processor. Publishing takes the mutex, and `SCHED_FIFO` threads publish.
//!
//! Without contention the mutex costs two atomic operations. With contention the kernel passes it on
//! (`FUTEX_LOCK_PI`, futex(2)). If the kernel refuses, waiters poll, and sleep in between so that any holder can run;
//! then there is no priority inheritance. A panic while the mutex is held does not poison it. No part of it is shared
//! between processes.
//!
//! The kernel identifies a holder by its thread id. A forked child's only thread has another id than in the parent,
//! and the parent's other threads, which may hold a lock, do not exist in the child. A child must therefore not touch
//! a mutex of its parent; [`ForkToken`] tells whether it is in a child. Mutexes that the child creates work.

#![allow(unsafe_code)]

use std::{
    cell::{Cell, UnsafeCell},
    fmt,
    marker::PhantomData,
    ops::{Deref, DerefMut},
    sync::atomic::{AtomicU32, Ordering},
    thread,
    time::Duration,
};

use rustix::{
    io::Errno,
    thread::{futex, gettid},
};

use crate::{
    error::ShmError,
    os::fork::ForkToken,
    sync::{LockWord, Site},
};

/// Number of times that a thread yields before it naps, if the kernel does not wait for it.
const YIELDS: u32 = 10;
const NAP: Duration = Duration::from_micros(50);

/// A value that one thread of this process may use at a time.
pub(crate) struct PiMutex<T> {
    /// 0 if free, otherwise the holder's thread id; the kernel adds a bit when other threads wait.
    word: AtomicU32,
    process: ForkToken,
    value: UnsafeCell<T>,
}

// SAFETY: the value moves along with the mutex, and is reached from other threads only under it.
unsafe impl<T: Send> Send for PiMutex<T> {}
// SAFETY: a shared mutex gives out the value to one thread at a time, as if it were sent to it.
unsafe impl<T: Send> Sync for PiMutex<T> {}

impl<T> PiMutex<T> {
    /// Creates a free mutex of the calling process.
    ///
    /// # Errors
    /// The process cannot tell whether it is a fork.
    pub(crate) fn new(value: T) -> Result<Self, ShmError> {
        let process = ForkToken::current()?;
        Ok(Self { word: AtomicU32::new(0), process, value: UnsafeCell::new(value) })
    }

    /// Waits until the mutex is free and takes it. Must not be called in a child of the process that created it.
    ///
    /// # Panics
    /// The calling thread holds it already.
    #[inline]
    pub(crate) fn lock(&self) -> PiGuard<'_, T> {
        debug_assert!(!self.process.is_forked(), "a mutex of the parent process");
        let thread = thread_id(self.process);
        if !take(&self.word, thread) {
            self.wait(thread);
        }
        PiGuard { mutex: self, thread, _stays: PhantomData }
    }

    #[cold]
    fn wait(&self, thread: u32) {
        for look in 0u32.. {
            match futex::lock_pi(&self.word, futex::Flags::PRIVATE, None) {
                // The kernel has stored this thread's id. The lock changes hands under the kernel's own locks; the load
                // expresses that in the language, and pairs with `unlock`.
                Ok(()) => {
                    self.word.load(Ordering::Acquire);
                    return;
                }
                Err(Errno::DEADLK) => panic!("a thread takes a mutex that it holds"),
                // A guard stays with its thread and is dropped there.
                Err(Errno::SRCH) => panic!("a thread ended and kept a mutex"),
                // The holder is about to end, memory for the wait is short, or the kernel lacks these futexes. Yielding
                // would not let a thread of lower priority run.
                Err(_) if look < YIELDS => thread::yield_now(),
                Err(_) => thread::sleep(NAP),
            }
            if take(&self.word, thread) {
                return;
            }
        }
    }

    #[inline]
    fn unlock(&self, thread: u32) {
        if !let_go(&self.word, thread) {
            self.hand_on();
        }
    }

    #[cold]
    fn hand_on(&self) {
        // It fails only if the thread does not hold the lock.
        let handed = futex::unlock_pi(&self.word, futex::Flags::PRIVATE);
        debug_assert!(handed.is_ok(), "a mutex was not held: {handed:?}");
    }
}

/// Takes a free lock. Returns false if it is not free. Pairs with [`let_go`].
#[inline(always)]
pub(crate) fn take(word: &impl LockWord, thread: u32) -> bool {
    word.swap_if(0, thread, Site::TakeSwap.order())
}

/// Releases a lock that no thread waits for. Returns false if a thread waits. Pairs with [`take`].
#[inline(always)]
pub(crate) fn let_go(word: &impl LockWord, thread: u32) -> bool {
    word.swap_if(thread, 0, Site::LetGoSwap.order())
}

impl<T> fmt::Debug for PiMutex<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PiMutex").finish_non_exhaustive()
    }
}

/// A [`PiMutex`] that is held, until this is dropped.
pub(crate) struct PiGuard<'a, T> {
    mutex: &'a PiMutex<T>,
    /// The holder's thread id.
    thread: u32,
    /// Only the holder may release the lock, so a guard stays with its thread.
    _stays: PhantomData<*const ()>,
}

impl<T> Deref for PiGuard<'_, T> {
    type Target = T;

    #[inline]
    fn deref(&self) -> &T {
        // SAFETY: the mutex is held as long as the guard lives, so no other guard exists, and this
        // one is borrowed shared.
        unsafe { &*self.mutex.value.get() }
    }
}

impl<T> DerefMut for PiGuard<'_, T> {
    #[inline]
    fn deref_mut(&mut self) -> &mut T {
        // SAFETY: as in `deref`, and this guard is borrowed mutably.
        unsafe { &mut *self.mutex.value.get() }
    }
}

impl<T> Drop for PiGuard<'_, T> {
    #[inline]
    fn drop(&mut self) {
        self.mutex.unlock(self.thread);
    }
}

/// Returns the calling thread's id, which each process requests once per thread from the kernel.
#[inline]
fn thread_id(process: ForkToken) -> u32 {
    thread_local! {
        static KNOWN: Cell<(u64, u32)> = const { Cell::new((0, 0)) };
    }
    let (known_in, id) = KNOWN.get();
    if known_in == process.value() {
        return id;
    }
    let id = gettid().as_raw_nonzero().get().cast_unsigned();
    KNOWN.set((process.value(), id));
    id
}

#[cfg(test)]
mod tests {
    use std::{fs, io::Write as _, sync::mpsc, time::Instant};

    use super::*;

    #[test]
    fn one_thread_at_a_time() {
        let mutex = PiMutex::new((0u64, 0u64)).unwrap();
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..20_000 {
                        let mut both = mutex.lock();
                        assert_eq!(both.0, both.1);
                        both.0 += 1;
                        std::hint::black_box(&mut both);
                        both.1 += 1;
                    }
                });
            }
        });
        assert_eq!(*mutex.lock(), (80_000, 80_000));
        assert_eq!(mutex.word.load(Ordering::Relaxed), 0);
    }

    #[test]
    fn a_waiter_gets_it_when_the_holder_lets_go() {
        let mutex = PiMutex::new(0).unwrap();
        let (said, heard) = mpsc::channel();
        thread::scope(|scope| {
            let mut held = mutex.lock();
            let mutex = &mutex;
            scope.spawn(move || {
                said.send(()).unwrap();
                assert_eq!(*mutex.lock(), 1);
            });
            heard.recv().unwrap();
            *held = 1;
        });
    }

    #[test]
    fn a_panic_lets_go() {
        let mutex = PiMutex::new(7).unwrap();
        let panicked = thread::scope(|scope| {
            let holder = scope.spawn(|| {
                let _held = mutex.lock();
                panic!("as intended");
            });
            holder.join()
        });
        assert!(panicked.is_err());
        assert_eq!(*mutex.lock(), 7);
    }

    #[test]
    #[should_panic(expected = "that it holds")]
    fn taking_it_twice_is_told() {
        let mutex = PiMutex::new(()).unwrap();
        let _held = mutex.lock();
        let _again = mutex.lock();
    }

    #[test]
    fn a_forked_child_is_known_by_its_own_id() {
        let theirs = PiMutex::new(()).unwrap();
        drop(theirs.lock());
        // SAFETY: the child takes no lock but its own, allocates nothing and leaves by _exit.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let known = PiMutex::new(()).is_ok_and(|mutex| {
                let _held = mutex.lock();
                let id = gettid().as_raw_nonzero().get().cast_unsigned();
                theirs.process.is_forked() && mutex.word.load(Ordering::Relaxed) == id
            });
            // SAFETY: ends the process without running anything else.
            unsafe { libc::_exit(i32::from(!known)) };
        }
        let mut status = -1;
        // SAFETY: waits for the child just made; `status` outlives the call.
        assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
        assert_eq!(status, 0, "the child took its parent's id for its own");
    }

    #[test]
    fn a_holder_runs_at_its_waiters_priority() {
        const PRIORITY: i32 = 5;
        let mutex = PiMutex::new(()).unwrap();
        let (said, heard) = mpsc::channel();
        thread::scope(|scope| {
            let before = priority();
            let held = mutex.lock();
            let mutex = &mutex;
            scope.spawn(move || {
                said.send(become_real_time(PRIORITY)).unwrap();
                drop(mutex.lock());
            });
            if let Err(error) = heard.recv().unwrap() {
                // Bypasses the harness, which would show it only beside a failure.
                let mut stderr = std::io::stderr();
                let _ = writeln!(stderr, "skipped: SCHED_FIFO is not permitted here: {error}");
                return;
            }
            // The kernel shows real-time priorities so (proc(5)).
            let inherited = -1 - PRIORITY;
            let start = Instant::now();
            while priority() != inherited {
                assert!(start.elapsed() < Duration::from_secs(60), "nothing was inherited");
                thread::yield_now();
            }
            drop(held);
            assert_eq!(priority(), before);
        });
    }

    /// Returns the calling thread's priority, including inherited ones.
    fn priority() -> i32 {
        let stat = fs::read_to_string("/proc/thread-self/stat").unwrap();
        let (_, fields) = stat.rsplit_once(") ").unwrap();
        fields.split(' ').nth(15).unwrap().parse().unwrap()
    }

    fn become_real_time(priority: i32) -> std::io::Result<()> {
        let wanted = libc::sched_param { sched_priority: priority };
        // SAFETY: the parameters are valid for the length of the call; 0 is the calling thread.
        match unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &wanted) } {
            0 => Ok(()),
            _ => Err(std::io::Error::last_os_error()),
        }
    }
}
