//! Prefetches cache lines before they are used.

#![allow(unsafe_code)]

/// Has the cache line of `word` fetched, if it is not here, while the caller goes on. Only a hint:
/// nothing is read as far as the program can tell, and where there is no such instruction it does
/// nothing.
#[inline]
pub(crate) fn prefetch<W>(word: &W) {
    let at = std::ptr::from_ref(word);
    #[cfg(all(target_arch = "x86_64", not(miri)))]
    // SAFETY: the instruction neither faults nor changes anything, whatever the address; this one is
    // of a reference.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T0>(at.cast());
    }
    #[cfg(all(target_arch = "aarch64", not(miri)))]
    // SAFETY: as above.
    unsafe {
        std::arch::asm!("prfm pldl1keep, [{}]", in(reg) at, options(nostack, preserves_flags, readonly));
    }
    #[cfg(any(miri, not(any(target_arch = "x86_64", target_arch = "aarch64"))))]
    let _ = at;
}
