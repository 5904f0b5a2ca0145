//! Pages for secrets: they are not swapped out, not part of a core file, and empty in a forked child.

// Mapped memory has no safe interface.
#![allow(unsafe_code)]

use std::{io, ptr, slice};

use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mlock, mmap_anonymous};

/// Pages that stay mapped until the process ends, and the results of the requests to protect them.
pub struct LockedPages {
    /// The bytes: zeros at first, and zeros again in a forked child.
    pub bytes: &'static mut [u8],
    /// The result of mlock. After an error the pages may be written to swap space.
    pub locked: rustix::io::Result<()>,
    /// The result of madvise. After an error the pages may be in core files or in forked processes.
    pub advised: rustix::io::Result<()>,
}

impl LockedPages {
    /// Maps `len` bytes, a multiple of the page size.
    ///
    /// The system has no memory for them.
    /// The system gives no memory.
    pub fn map(len: usize) -> io::Result<Self> {
        let (access, private) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::PRIVATE);
        // SAFETY: a new mapping at an address of the system's choice; it replaces no other.
        let pages = unsafe { mmap_anonymous(ptr::null_mut(), len, access, private) }?;
        // SAFETY: the mapping just made, of that length.
        let locked = unsafe { mlock(pages, len) };
        // SAFETY: as above. Leaving the pages out of core files does not change them.
        let kept_out = unsafe { madvise(pages, len, Advice::LinuxDontDump) };
        // SAFETY: as above. A forked child finds zeros, which are as valid as any other bytes.
        let wiped = unsafe { madvise(pages, len, Advice::LinuxWipeOnFork) };
        // SAFETY: the mapping just made, of that length. It is never unmapped, and nothing else refers to it.
        let bytes = unsafe { slice::from_raw_parts_mut(pages.cast(), len) };
        Ok(Self { bytes, locked, advised: kept_out.and(wiped) })
    }
}
