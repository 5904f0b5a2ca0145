//! Copies of memory that other processes may write to during the copy.
//!
//! No byte references to such memory exist, only references to atomic words. If another process writes during the
//! copy, the copy may mix old and new words. The reader checks copied samples afterwards. Pinned samples do not
//! change unless their publisher breaks the protocol.

#![allow(unsafe_code)]

use std::{
    collections::TryReserveError,
    mem::MaybeUninit,
    sync::atomic::{AtomicU64, Ordering},
};

/// From this length on, copies by words are slow: the compiler emits a load for each word.
#[cfg(all(target_arch = "x86_64", not(miri)))]
const BULK: usize = 1024;

/// Up to this length, about a core's own cache, the processor's own copy instruction is the fastest. For longer data in
/// another core's cache it prefetches little, and at times takes twice as long as a loop.
#[cfg(all(target_arch = "x86_64", not(miri)))]
const CACHED: usize = 512 << 10;

/// Fills `out` with the bytes from offset `at` on.
///
/// # Panics
/// The words have fewer bytes.
pub(crate) fn read_at(words: &[AtomicU64], at: usize, out: &mut [u8]) {
    // SAFETY: both slices are the same bytes, and `copy` writes only initialized bytes to them.
    let out = unsafe { &mut *(std::ptr::from_mut(out) as *mut [MaybeUninit<u8>]) };
    copy(words, at, out);
}

/// Replaces `out` by the `len` bytes of `words` from `at` on.
///
/// # Errors
/// There is no memory for the bytes.
///
/// # Panics
/// The words have fewer bytes.
pub(crate) fn copy_out(
    words: &[AtomicU64],
    at: usize,
    len: usize,
    out: &mut Vec<u8>,
) -> Result<(), TryReserveError> {
    out.clear();
    append(words, at, len, out)
}

/// Adds the `len` bytes of `words` from `at` on to `out`.
///
/// # Errors
/// There is no memory for the bytes.
///
/// # Panics
/// The words have fewer bytes.
pub(crate) fn append(
    words: &[AtomicU64],
    at: usize,
    len: usize,
    out: &mut Vec<u8>,
) -> Result<(), TryReserveError> {
    out.try_reserve(len)?;
    copy(words, at, &mut out.spare_capacity_mut()[..len]);
    // SAFETY: within the reserved capacity, and `copy` wrote each of the `len` bytes after the existing ones.
    unsafe { out.set_len(out.len() + len) };
    Ok(())
}

/// Fills `out` with the bytes from offset `at` on.
///
/// # Panics
/// The words have fewer bytes.
#[inline]
pub(crate) fn copy(words: &[AtomicU64], at: usize, out: &mut [MaybeUninit<u8>]) {
    assert!(at.checked_add(out.len()).is_some_and(|end| end <= words.len() * 8));
    #[cfg(all(target_arch = "x86_64", not(miri)))]
    if out.len() >= BULK {
        let from = words.as_ptr().cast::<u8>().wrapping_add(at);
        let (lines, rest) = out.split_at_mut(if out.len() > CACHED { out.len() & !63 } else { 0 });
        // SAFETY: the words hold `out.len()` bytes from `at` on, as was just checked.
        unsafe { copy_lines(from, lines) };
        // SAFETY: as above; the rest begins where the lines end.
        return unsafe { copy_bulk(from.wrapping_add(lines.len()), rest) };
    }
    copy_words(words, at, out);
}

fn copy_words(words: &[AtomicU64], at: usize, out: &mut [MaybeUninit<u8>]) {
    let load = |index: usize| words[index].load(Ordering::Relaxed).to_ne_bytes();
    let mut next = at / 8;
    let skip = at % 8;
    let (first, rest) = out.split_at_mut(if skip > 0 { out.len().min(8 - skip) } else { 0 });
    if !first.is_empty() {
        put(first, &load(next)[skip..]);
        next += 1;
    }
    let (whole, rest) = rest.as_chunks_mut::<8>();
    let count = whole.len();
    for (chunk, word) in whole.iter_mut().zip(&words[next..][..count]) {
        put(chunk, &word.load(Ordering::Relaxed).to_ne_bytes());
    }
    if !rest.is_empty() {
        put(rest, &load(next + count));
    }
}

/// Fills `to` with the first of `bytes`. There must be at least as many.
#[inline(always)]
fn put(to: &mut [MaybeUninit<u8>], bytes: &[u8]) {
    debug_assert!(bytes.len() >= to.len());
    for (to, byte) in to.iter_mut().zip(bytes) {
        to.write(*byte);
    }
}

/// Copies with `rep movsb`.
///
/// # Safety
/// The `out.len()` bytes from `from` on must be words of a map. Other processes may write to them.
#[cfg(all(target_arch = "x86_64", not(miri)))]
#[inline]
unsafe fn copy_bulk(from: *const u8, out: &mut [MaybeUninit<u8>]) {
    // SAFETY: the instruction reads bytes that the caller promises, which are mapped, and writes only to `out`, which
    // is ours. Other processes may write to the bytes meanwhile. That is no data race of the language: to the compiler
    // this block is opaque and may do to this memory what loads of words do, relaxed and each once; and it does just
    // that. It does not rely on the values that it reads. The direction flag is clear on entry, as the ABI requires,
    // and no flag is changed. The processor keeps its loads in order, so bytes that are loaded after a following
    // acquire fence are loaded later, as with words; string instructions are an exception only for their stores.
    unsafe {
        std::arch::asm!(
            "rep movsb",
            inout("rsi") from => _,
            inout("rdi") out.as_mut_ptr() => _,
            inout("rcx") out.len() => _,
            options(nostack, preserves_flags),
        );
    }
}

/// Copies 64 bytes at a time, in a loop that the processor fetches ahead of.
///
/// # Safety
/// The `out.len()` bytes from `from` on, a multiple of 64, must be words of a map. Other processes may write to them.
#[cfg(all(target_arch = "x86_64", not(miri)))]
#[inline]
unsafe fn copy_lines(from: *const u8, out: &mut [MaybeUninit<u8>]) {
    let end = from.wrapping_add(out.len());
    // SAFETY: the loop reads from `from` up to `end`, which the caller promises, and writes as many bytes to `out`,
    // which is ours. It does neither if there is nothing to copy. Registers of 16 bytes are part of x86_64. The
    // argument of `copy_bulk` about other writers and about order holds for these loads as well.
    unsafe {
        std::arch::asm!(
            "cmp {from}, {end}",
            "je 3f",
            "2:",
            "movdqu {a}, [{from}]",
            "movdqu {b}, [{from} + 16]",
            "movdqu {c}, [{from} + 32]",
            "movdqu {d}, [{from} + 48]",
            "movdqu [{to}], {a}",
            "movdqu [{to} + 16], {b}",
            "movdqu [{to} + 32], {c}",
            "movdqu [{to} + 48], {d}",
            "add {to}, 64",
            "add {from}, 64",
            "cmp {from}, {end}",
            "jne 2b",
            "3:",
            from = inout(reg) from => _,
            end = in(reg) end,
            to = inout(reg) out.as_mut_ptr() => _,
            a = out(xmm_reg) _,
            b = out(xmm_reg) _,
            c = out(xmm_reg) _,
            d = out(xmm_reg) _,
            options(nostack),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns words in which each byte differs from its neighbours.
    fn words(bytes: usize) -> (Vec<AtomicU64>, Vec<u8>) {
        let bytes: Vec<u8> =
            (0..bytes.next_multiple_of(8)).map(|at| (at * 7 % 251) as u8).collect();
        let words =
            bytes.as_chunks().0.iter().map(|chunk| AtomicU64::new(u64::from_ne_bytes(*chunk)));
        (words.collect(), bytes)
    }

    #[test]
    fn read_at_copies_exactly_the_range() {
        let (words, bytes) = words(5000);
        let lens = (0..40).chain(1000..1050).chain([4095, 4096]);
        for (at, len) in lens.flat_map(|len| (0..17).chain([900]).map(move |at| (at, len))) {
            let mut out = vec![0xff; len + 1];
            read_at(&words, at, &mut out[..len]);
            assert!(out[..len] == bytes[at..at + len] && out[len] == 0xff, "{len} from {at} on");
        }
    }

    #[test]
    fn copy_out_replaces_the_buffers_content() {
        let longest = 512 << 10;
        let (words, bytes) = words(longest + 73);
        let mut out = vec![1; 3];
        let around = [longest - 1, longest, longest + 1, longest + 63, longest + 64, longest + 65];
        for len in [0, 1, 8, 9, 1023, 1024, 1025, 5000].into_iter().chain(around).chain([7]) {
            for at in [0, 4] {
                copy_out(&words, at, len, &mut out).unwrap();
                assert!(out == bytes[at..at + len], "{len} from {at} on");
            }
        }
    }

    #[test]
    fn append_keeps_the_buffers_content() {
        let (words, bytes) = words(5000);
        let mut out = Vec::new();
        for (at, len) in [(0, 9), (3, 0), (5, 1030), (8, 64)] {
            let before = out.clone();
            append(&words, at, len, &mut out).unwrap();
            assert!(out == [&before[..], &bytes[at..at + len]].concat(), "{len} from {at} on");
        }
        assert!(append(&words, 0, 1 << 60, &mut out).is_err());
    }

    #[test]
    fn nothing_beyond_the_words_is_read() {
        let (words, _) = words(2048);
        for (at, len) in [(2048, 1), (1, 2048), (2047, 2), (usize::MAX, 2), (usize::MAX - 7, 2048)]
        {
            let read = || read_at(&words, at, &mut vec![0; len]);
            assert!(std::panic::catch_unwind(read).is_err(), "{len} from {at} on");
        }
        assert!(copy_out(&words, 0, 1 << 60, &mut Vec::new()).is_err());
        read_at(&words, 2048, &mut []);
    }
}
