//! Per-process singletons; a forked child creates its own. Also the privileges of the process.

#![allow(unsafe_code)]

use std::{
    ptr,
    sync::atomic::{AtomicPtr, Ordering},
};

use crate::{error::ShmError, os::fork::ForkToken};

/// Returns whether this process has more rights than its caller, as the kernel says (AT_SECURE): its program is
/// set-uid or set-gid, or has file capabilities.
pub fn is_elevated() -> bool {
    // SAFETY: looks a number up in what the kernel gave the process at its start.
    unsafe { libc::getauxval(libc::AT_SECURE) != 0 }
}

/// A place for one `T` per process, which exists until the process ends. Finding it takes no lock, so a lock that a
/// thread of the parent held at the fork does not block a child.
pub struct PerProcess<T: 'static>(AtomicPtr<Made<T>>);

/// The `T` of a process, and those of the processes that it is a fork of: their locks may be held for ever.
pub struct Made<T: 'static> {
    token: ForkToken,
    before: Option<&'static Made<T>>,
    value: T,
}

impl<T: Send + Sync> PerProcess<T> {
    /// Creates an empty place.
    #[expect(clippy::new_without_default, reason = "it is for statics, which cannot be made so")]
    pub const fn new() -> Self {
        Self(AtomicPtr::new(ptr::null_mut()))
    }

    /// Returns this process's `T`. If there is none yet, `make` creates it, and `adopt` is called once with it and the
    /// `T` of the process that this one is a fork of, if that had one.
    ///
    /// # Errors
    /// There is no memory for the token that distinguishes this process from its forks.
    pub fn get(
        &self,
        make: impl Fn(ForkToken) -> T,
        adopt: impl FnOnce(&'static T, &'static T),
    ) -> Result<&'static Made<T>, ShmError> {
        loop {
            let before = self.latest();
            if let Some(made) = before.filter(|made| !made.is_forked()) {
                return Ok(made);
            }
            let token = ForkToken::current()?;
            let fresh = Box::into_raw(Box::new(Made { token, before, value: make(token) }));
            let seen = before.map_or(ptr::null_mut(), |made| ptr::from_ref(made).cast_mut());
            // Release pairs with the acquire of `latest`: a thread that sees it sees it whole.
            let (made, other) = (Ordering::AcqRel, Ordering::Acquire);
            if self.0.compare_exchange(seen, fresh, made, other).is_err() {
                // SAFETY: made by `into_raw` above, and nobody else has seen it.
                drop(unsafe { Box::from_raw(fresh) });
                continue;
            }
            // SAFETY: made by `into_raw` above and never freed from now on; it is only shared.
            let fresh: &'static Made<T> = unsafe { &*fresh };
            if let Some(before) = before {
                adopt(&fresh.value, &before.value);
            }
            return Ok(fresh);
        }
    }

    /// Returns the last one that was created, in this process or in one that it is a fork of.
    #[inline]
    pub fn latest(&self) -> Option<&'static Made<T>> {
        // SAFETY: null, or made by `Box::into_raw` and never freed once it is here.
        unsafe { self.0.load(Ordering::Acquire).as_ref() }
    }
}

impl<T> Made<T> {
    /// Returns whether it belongs to a process that the calling one is a fork of.
    #[inline]
    pub fn is_forked(&self) -> bool {
        self.token.is_forked()
    }

    /// Returns the `T`.
    #[inline]
    pub fn value(&self) -> &T {
        &self.value
    }

    /// Returns the `T`s of the processes that its own is a fork of, the nearest first.
    pub fn ancestors(&self) -> impl Iterator<Item = &'static T> {
        std::iter::successors(self.before, |made| made.before).map(|made| &made.value)
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{Barrier, Mutex},
        thread,
    };

    use rustix::process::{WaitOptions, waitpid};

    use super::*;

    static NUMBERS: PerProcess<Mutex<u32>> = PerProcess::new();

    fn own() -> &'static Mutex<u32> {
        let adopt = |own: &'static Mutex<u32>, parents: &'static Mutex<u32>| {
            *own.lock().unwrap() = parents.try_lock().map_or(1000, |number| *number + 1);
        };
        NUMBERS.get(|_| Mutex::new(7), adopt).unwrap().value()
    }

    #[test]
    fn singleton_is_shared_by_threads_and_made_anew_after_a_fork() {
        let barrier = Barrier::new(4);
        let found: Vec<_> = thread::scope(|scope| {
            let find = || {
                barrier.wait();
                ptr::from_ref(own()).addr()
            };
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(find)).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert!(found.iter().all(|address| *address == found[0]));
        assert_eq!(*own().lock().unwrap(), 7);
        assert_eq!(NUMBERS.latest().unwrap().ancestors().count(), 0);

        let held = own().lock().unwrap();
        // SAFETY: the child uses nothing that another thread may have locked but what is tested, and
        // ends without what belongs to the parent being dropped.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let inherited = NUMBERS.latest().is_some_and(Made::is_forked);
            let alone = own().try_lock().is_ok_and(|number| *number == 1000);
            let known = NUMBERS.latest().is_some_and(|made| made.ancestors().count() == 1);
            // SAFETY: it ends the process at once.
            unsafe { libc::_exit(i32::from(!(inherited && alone && known))) };
        }
        let pid = rustix::process::Pid::from_raw(child).unwrap();
        let (_, status) = waitpid(Some(pid), WaitOptions::empty()).unwrap().unwrap();
        assert_eq!(status.exit_status(), Some(0));
        drop(held);
    }
}
