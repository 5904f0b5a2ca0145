//! Returns freed memory of the allocator to the system.

#![allow(unsafe_code)]

/// Gives what the allocator keeps of freed memory back to the system, where the allocator can. Takes
/// milliseconds, and other threads may wait meanwhile for memory.
pub(crate) fn give_back() {
    #[cfg(target_env = "gnu")]
    // SAFETY: it takes no pointer, and may be called from any thread at any time.
    let _ = unsafe { libc::malloc_trim(0) };
}
