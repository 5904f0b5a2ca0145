//! Prefetches cache lines before they are used.

#![allow(unsafe_code)]

/// Prefetches the cache line of `word` while the caller goes on. It is only a hint: to the program nothing is read. It
/// does nothing on processors without such an instruction here.
#[inline]
pub(crate) fn prefetch<W>(word: &W) {
    let at = std::ptr::from_ref(word);
    #[cfg(all(target_arch = "x86_64", not(miri)))]
    // SAFETY: the instruction neither faults nor changes anything, whatever the address; this address comes from a
    // reference.
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
