//! Replaces writable maps by inaccessible pages in a forked child.
//!
//! Writable maps are absent in a child, so that the child cannot be a second writer. But a slice of a map may have
//! been borrowed before the fork, and the child's next map may be placed at the same address. A child of `fork`
//! therefore begins by putting inaccessible pages in place of the maps: an access to such a slice ends the child.
//!
//! A child of `_Fork`, or of `clone` without shared memory, runs no handler. A handler that was registered earlier
//! may have mapped something in that place, which then stays. In such a child the slice reads foreign memory. This
//! is a second line of defence; safe code checks `is_forked`.

#![allow(unsafe_code)]

use std::{
    ffi::c_void,
    ptr::{self, NonNull},
    sync::{
        OnceLock,
        atomic::{AtomicPtr, AtomicUsize, Ordering},
    },
};

use rustix::io::Errno;

use crate::error::ShmError;

/// A writable map, in a list that the child walks without a lock: entries are reused and never
/// freed.
struct WritableMap {
    /// 0 while the entry is unused, [`TAKEN`] while it is filled in.
    base: AtomicUsize,
    bytes: AtomicUsize,
    next: *const WritableMap,
}

// SAFETY: all of it is atomic but for `next`, which stays as it is once others can see the entry.
unsafe impl Sync for WritableMap {}

/// An address at which no map begins.
const TAKEN: usize = 1;

static ENTRIES: AtomicPtr<WritableMap> = AtomicPtr::new(ptr::null_mut());

/// Keeps a map's address inaccessible in children until it is dropped.
pub(crate) struct KeptAddress(&'static WritableMap);

impl KeptAddress {
    /// Keeps the address of the map at `base`, which children do not get.
    pub(crate) fn keep(base: NonNull<c_void>, bytes: usize) -> Result<Self, ShmError> {
        static HANDLER: OnceLock<i32> = OnceLock::new();
        let failed = *HANDLER.get_or_init(|| {
            // SAFETY: the handler is a function that lives as long as the program, or the library
            // that registers it here, with which glibc and musl forget it.
            unsafe { libc::pthread_atfork(None, None, Some(in_child)) }
        });
        if failed != 0 {
            let what = "registering what a forked child begins with";
            return Err(ShmError::system(what)(Errno::from_raw_os_error(failed)));
        }
        let entry = free_entry();
        entry.bytes.store(bytes, Ordering::Relaxed);
        // Pairs with the acquire load in `in_child`: a child that sees the address sees the length.
        entry.base.store(base.as_ptr().addr(), Ordering::Release);
        Ok(Self(entry))
    }
}

impl Drop for KeptAddress {
    fn drop(&mut self) {
        // Pairs with the acquire exchange in `free_entry`: the next user's stores come after it.
        self.0.base.store(0, Ordering::Release);
    }
}

fn free_entry() -> &'static WritableMap {
    // Pairs with the release exchange below: the entry and those after it are whole.
    let mut at: *const WritableMap = ENTRIES.load(Ordering::Acquire);
    // SAFETY: entries are never freed, and reached only once they are whole.
    while let Some(entry) = unsafe { at.as_ref() } {
        let taken = entry.base.compare_exchange(0, TAKEN, Ordering::Acquire, Ordering::Relaxed);
        if taken.is_ok() {
            return entry;
        }
        at = entry.next;
    }
    let mut next = ENTRIES.load(Ordering::Acquire);
    let entry = Box::leak(Box::new(WritableMap {
        base: AtomicUsize::new(TAKEN),
        bytes: AtomicUsize::new(0),
        next,
    }));
    // Release: pairs with the acquire loads of the functions that walk the list.
    while let Err(newer) =
        ENTRIES.compare_exchange(next, ptr::from_mut(entry), Ordering::Release, Ordering::Acquire)
    {
        next = newer;
        entry.next = next;
    }
    entry
}

/// Runs in the child before `fork` returns there, in its only thread: no lock, no allocation.
extern "C" fn in_child() {
    // Pairs with the release exchange in `free_entry`.
    let mut at: *const WritableMap = ENTRIES.load(Ordering::Acquire);
    // SAFETY: entries are never freed, and reached only once they are whole.
    while let Some(entry) = unsafe { at.as_ref() } {
        // Pairs with the release store in `KeptAddress::keep`.
        let base = entry.base.load(Ordering::Acquire);
        if base > TAKEN {
            let bytes = entry.bytes.load(Ordering::Relaxed);
            // SAFETY: it replaces nothing: where something is mapped already, it fails. The call is
            // a bare system call, which may be made here.
            unsafe {
                libc::mmap(
                    ptr::without_provenance_mut(base),
                    bytes,
                    libc::PROT_NONE,
                    libc::MAP_PRIVATE
                        | libc::MAP_ANONYMOUS
                        | libc::MAP_NORESERVE
                        | libc::MAP_FIXED_NOREPLACE,
                    -1,
                    0,
                )
            };
        }
        at = entry.next;
    }
}
