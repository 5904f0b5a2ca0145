//! Detects that the calling process is a fork of the process that created an object.
//!
//! Writable maps do not survive a fork, so a child must detect the fork before it accesses a map. Reading the
//! process id from the kernel would cost a system call for each publish. A page that the kernel wipes in a child
//! costs one load.

#![allow(unsafe_code)]

use std::{
    ptr::{self, NonNull},
    sync::atomic::{AtomicPtr, AtomicU64, Ordering},
};

use rustix::{
    io::Errno,
    mm::{Advice, MapFlags, ProtFlags, madvise, mmap_anonymous, munmap},
};

use crate::error::ShmError;

const PAGE: usize = 4096;

/// A token of the process that took it; a forked child no longer matches it.
#[derive(Clone, Copy)]
pub struct ForkToken {
    page: &'static AtomicU64,
    value: u64,
}

impl ForkToken {
    /// Returns the token of the calling process.
    pub fn current() -> Result<Self, ShmError> {
        // Inherited over a fork, so that a child never reuses a value of its ancestors.
        static LAST: AtomicU64 = AtomicU64::new(0);
        static WIPED: WipedPage = WipedPage::new();
        let page = WIPED
            .get(map_wiped_page)
            .map_err(ShmError::system("mapping a page that is wiped on fork"))?;
        if page.load(Ordering::Relaxed) == 0 {
            let fresh = LAST.fetch_add(1, Ordering::Relaxed) + 1;
            // Another thread may have been first; its value serves as well.
            let _ = page.compare_exchange(0, fresh, Ordering::Relaxed, Ordering::Relaxed);
        }
        Ok(Self { page, value: page.load(Ordering::Relaxed) })
    }

    /// Returns a value that is different in each process of a line of forks, and never 0.
    #[inline]
    pub fn value(&self) -> u64 {
        self.value
    }

    /// Returns whether the calling process is a fork of the one that took the token.
    #[inline]
    pub fn is_forked(&self) -> bool {
        self.page.load(Ordering::Relaxed) != self.value
    }
}

/// The page of this process, once there is one. Finding it takes no lock: a thread of the parent could hold a lock for
/// ever after a fork.
struct WipedPage(AtomicPtr<AtomicU64>);

impl WipedPage {
    const fn new() -> Self {
        Self(AtomicPtr::new(ptr::null_mut()))
    }

    /// Returns the page. If there is none, `map` creates one; if that fails, the next call tries again.
    fn get(
        &self,
        map: impl FnOnce() -> Result<NonNull<AtomicU64>, Errno>,
    ) -> Result<&'static AtomicU64, Errno> {
        // Acquire pairs with the release of the exchange below: the page is advised when it is seen.
        // SAFETY: null, or a page by `map_wiped_page` that is never unmapped once it is here.
        if let Some(page) = unsafe { self.0.load(Ordering::Acquire).as_ref() } {
            return Ok(page);
        }
        let fresh = map()?;
        // Release pairs with the acquire of the load above, and of a failed exchange, which sees the
        // page of the thread that was first.
        let (made, other) = (Ordering::Release, Ordering::Acquire);
        match self.0.compare_exchange(ptr::null_mut(), fresh.as_ptr(), made, other) {
            // SAFETY: mapped by `map`, and never unmapped from now on.
            Ok(_) => Ok(unsafe { fresh.as_ref() }),
            Err(first) => {
                // SAFETY: mapped by `map` above, and nobody else has seen it. A failure leaves a page
                // that nobody uses.
                let _ = unsafe { munmap(fresh.as_ptr().cast(), PAGE) };
                // SAFETY: not null, as it was not what was expected; and as above.
                Ok(unsafe { &*first })
            }
        }
    }
}

/// Maps a page of zeros, to be shared as an atomic once no code unmaps it.
fn map_wiped_page() -> Result<NonNull<AtomicU64>, Errno> {
    // SAFETY: a fresh private mapping at an address of the kernel's choice aliases nothing.
    let base = unsafe {
        mmap_anonymous(ptr::null_mut(), PAGE, ProtFlags::READ | ProtFlags::WRITE, MapFlags::PRIVATE)
    }?;
    // SAFETY: the page was just mapped, holds nothing, and wiping it in a child leaves zeros,
    // which are a valid value of the atomic that lives in it.
    if let Err(error) = unsafe { madvise(base, PAGE, Advice::LinuxWipeOnFork) } {
        // SAFETY: mapped above, and nobody else has seen it. A failure leaves a page that nobody uses.
        let _ = unsafe { munmap(base, PAGE) };
        return Err(error);
    }
    // Aligned to a page, mapped readable and writable, all zeros.
    NonNull::new(base.cast::<AtomicU64>()).ok_or(Errno::FAULT)
}

#[cfg(test)]
mod tests {
    use std::{sync::Barrier, thread};

    use rustix::process::{Pid, WaitOptions, waitpid};

    use super::*;

    #[test]
    fn a_failure_to_map_the_page_is_not_remembered() {
        let page = WipedPage::new();
        assert!(page.get(|| Err(Errno::NOMEM)).is_err());
        assert!(page.get(map_wiped_page).is_ok());
    }

    #[test]
    fn all_threads_find_the_page_that_was_there_first() {
        let (page, barrier) = (WipedPage::new(), Barrier::new(4));
        let find = || {
            let map = || {
                barrier.wait();
                map_wiped_page()
            };
            ptr::from_ref(page.get(map).unwrap()).addr()
        };
        let found: Vec<_> = thread::scope(|scope| {
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(find)).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert!(found.iter().all(|address| *address == found[0]));
        assert_eq!(ptr::from_ref(page.get(|| unreachable!()).unwrap()).addr(), found[0]);
    }

    #[test]
    fn a_fork_during_another_threads_first_use_does_not_keep_the_child_waiting() {
        let (page, started, forked) = (WipedPage::new(), Barrier::new(2), Barrier::new(2));
        let status = thread::scope(|scope| {
            scope.spawn(|| {
                page.get(|| {
                    started.wait();
                    forked.wait();
                    map_wiped_page()
                })
                .unwrap();
            });
            started.wait();
            // SAFETY: the child maps a page, and ends without running anything of its parent's.
            let child = unsafe { libc::fork() };
            if child == 0 {
                // SAFETY: a child that waits for ever is ended by it.
                unsafe { libc::alarm(10) };
                let is_mapped = page.get(map_wiped_page).is_ok();
                // SAFETY: it ends the process at once.
                unsafe { libc::_exit(i32::from(!is_mapped)) };
            }
            forked.wait();
            waitpid(Pid::from_raw(child), WaitOptions::empty()).unwrap().unwrap().1
        });
        assert_eq!(status.exit_status(), Some(0), "the child waited for ever");
    }
}
