//! Whether this process is still the one that made something.
//!
//! Writable maps do not survive a fork, so a child must be told before it touches one. Asking the
//! kernel for the process id would be a system call on each publish; a page that the kernel wipes
//! in a child costs one load.

use std::{
    ptr::{self, NonNull},
    sync::{
        OnceLock,
        atomic::{AtomicU64, Ordering},
    },
};

use rustix::{
    io::Errno,
    mm::{Advice, MapFlags, ProtFlags, madvise, mmap_anonymous},
};

use super::ShmError;

const PAGE: usize = 4096;

/// Names the process that took it; a forked child no longer matches it.
#[derive(Clone, Copy)]
pub(crate) struct ForkToken {
    page: &'static AtomicU64,
    value: u64,
}

impl ForkToken {
    /// The token of the calling process.
    pub(crate) fn current() -> Result<Self, ShmError> {
        // Inherited over a fork, so that a child never reuses a value of its ancestors.
        static LAST: AtomicU64 = AtomicU64::new(0);
        static WIPED: OnceLock<Result<&'static AtomicU64, Errno>> = OnceLock::new();
        let page = WIPED
            .get_or_init(map_wiped_page)
            .map_err(ShmError::system("mapping a page that is wiped on fork"))?;
        if page.load(Ordering::Relaxed) == 0 {
            let fresh = LAST.fetch_add(1, Ordering::Relaxed) + 1;
            // Another thread may have been first; its value serves as well.
            let _ = page.compare_exchange(0, fresh, Ordering::Relaxed, Ordering::Relaxed);
        }
        Ok(Self { page, value: page.load(Ordering::Relaxed) })
    }

    /// Another in each process of a line of forks, and never 0.
    #[inline]
    pub(crate) fn value(&self) -> u64 {
        self.value
    }

    /// Whether the calling process is a fork of the one that took the token.
    #[inline]
    pub(crate) fn is_forked(&self) -> bool {
        self.page.load(Ordering::Relaxed) != self.value
    }
}

fn map_wiped_page() -> Result<&'static AtomicU64, Errno> {
    // SAFETY: a fresh private mapping at an address of the kernel's choice aliases nothing.
    let base = unsafe {
        mmap_anonymous(ptr::null_mut(), PAGE, ProtFlags::READ | ProtFlags::WRITE, MapFlags::PRIVATE)
    }?;
    // SAFETY: the page was just mapped, holds nothing, and wiping it in a child leaves zeros,
    // which are a valid value of the atomic that lives in it.
    unsafe { madvise(base, PAGE, Advice::LinuxWipeOnFork) }?;
    let word = NonNull::new(base.cast::<AtomicU64>()).ok_or(Errno::FAULT)?;
    // SAFETY: aligned to a page, mapped readable and writable, never unmapped, all zeros.
    Ok(unsafe { word.as_ref() })
}
