//! An allocator that erases freed memory, and a function that returns free memory to the system.

// An allocator has no safe interface.
#![allow(unsafe_code)]

use std::{
    alloc::{GlobalAlloc, Layout, System},
    slice,
    sync::atomic::{AtomicBool, Ordering},
};

/// Maximum size of erased blocks. Blocks with keys are shorter; longer blocks hold payloads, and erasing them would
/// cost as much as copying them.
const LONGEST_ERASED: usize = 64 << 10;

/// True if this process has called [`erase_from_now_on`].
static ERASES: AtomicBool = AtomicBool::new(false);

/// The system's allocator, with erasure: it erases each block of at most 64 KiB before it is freed, and when it grows
/// into another one. It erases nothing before [`erase_from_now_on`] is called; until then it costs one load.
#[derive(Debug, Clone, Copy)]
pub struct ErasingHeap;

/// Erases blocks that are freed from now on, if [`ErasingHeap`] is this program's allocator.
pub fn erase_from_now_on() {
    // Relaxed: a thread that does not see it yet has no keys yet. Threads with keys are started, or receive their keys,
    // after this.
    ERASES.store(true, Ordering::Relaxed);
}

/// Returns the allocator's free memory to the system, if the allocator can do that. Takes milliseconds, and other
/// threads may wait meanwhile for memory.
pub fn return_free_memory() {
    #[cfg(target_env = "gnu")]
    // SAFETY: it takes no pointer, and may be called from any thread at any time.
    let _ = unsafe { libc::malloc_trim(0) };
}

/// Returns whether a block of this layout is erased.
fn is_erased(layout: Layout) -> bool {
    // Relaxed: see `erase_from_now_on`.
    layout.size() <= LONGEST_ERASED && ERASES.load(Ordering::Relaxed)
}

/// Overwrites a block.
///
/// # Safety
/// It has `size` bytes, which nobody else uses.
unsafe fn erase(block: *mut u8, size: usize) {
    // SAFETY: the caller says so.
    unsafe { block.write_bytes(0, size) };
    // SAFETY: as above, and all of it was just written.
    let erased = unsafe { slice::from_raw_parts(block, size) };
    // Without this, the compiler omits the erasure, because the block is freed.
    zeroize::optimization_barrier(erased);
}

// SAFETY: every block is one of `System` with the layout asked for, and goes back to it once with
// that layout. What is written to a block is written before it goes back.
unsafe impl GlobalAlloc for ErasingHeap {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promises are those `System` asks for.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        if is_erased(layout) {
            // SAFETY: the block has that many bytes, and the caller gives it up.
            unsafe { erase(block, layout.size()) };
        }
        // SAFETY: the caller's promises are those `System` asks for.
        unsafe { System.dealloc(block, layout) }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        if !is_erased(layout) {
            // SAFETY: the caller's promises are those `System` asks for.
            return unsafe { System.realloc(block, layout, size) };
        }
        // `System` would free the old block, or the end of it, as it is.
        // SAFETY: the caller promises that `size`, rounded up to the alignment, is a valid size.
        let wanted = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
        // SAFETY: the caller promises a size other than zero.
        let grown = unsafe { System.alloc(wanted) };
        if !grown.is_null() {
            // SAFETY: both blocks have at least as many bytes, and the new one is nobody else's.
            unsafe { grown.copy_from_nonoverlapping(block, layout.size().min(size)) };
            // SAFETY: the caller gives the old block up, now that there is a new one.
            unsafe { self.dealloc(block, layout) };
        }
        grown
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A block of this allocator, with a pattern in it.
    fn block(layout: Layout) -> *mut u8 {
        // SAFETY: the layouts below have sizes other than zero.
        let block = unsafe { ErasingHeap.alloc(layout) };
        assert!(!block.is_null());
        // SAFETY: it has that many bytes.
        unsafe { block.write_bytes(0x5a, layout.size()) };
        block
    }

    #[test]
    fn a_block_that_is_given_back_is_overwritten_to_its_end() {
        for size in [1, 32, 4097, LONGEST_ERASED] {
            let layout = Layout::from_size_align(size, 1).unwrap();
            let block = block(layout);
            // SAFETY: the block of this layout, which nobody else knows.
            unsafe { erase(block, layout.size()) };
            // SAFETY: it is still allocated, and was written.
            assert!(unsafe { slice::from_raw_parts(block, size) }.iter().all(|byte| *byte == 0));
            // SAFETY: the block with its layout.
            unsafe { ErasingHeap.dealloc(block, layout) };
        }
    }

    #[test]
    fn growing_and_shrinking_keeps_the_content() {
        erase_from_now_on();
        let sizes = [1, 31, 4096, LONGEST_ERASED, LONGEST_ERASED + 1, 300_000, 70_000, 100, 3];
        let mut layout = Layout::from_size_align(1, 1).unwrap();
        let mut at = block(layout);
        for size in sizes {
            // SAFETY: `at` is a block of this allocator with this layout.
            at = unsafe { ErasingHeap.realloc(at, layout, size) };
            assert!(!at.is_null());
            let kept = layout.size().min(size);
            // SAFETY: so many bytes were copied from the block before.
            assert!(unsafe { slice::from_raw_parts(at, kept) }.iter().all(|byte| *byte == 0x5a));
            layout = Layout::from_size_align(size, 1).unwrap();
            // SAFETY: it has that many bytes.
            unsafe { at.write_bytes(0x5a, size) };
        }
        // SAFETY: the last block with its layout.
        unsafe { ErasingHeap.dealloc(at, layout) };
    }

    #[test]
    fn blocks_aligned_to_pages_grow_aligned() {
        erase_from_now_on();
        let layout = Layout::from_size_align(4096, 4096).unwrap();
        let old = block(layout);
        // SAFETY: a block of this allocator with this layout.
        let new = unsafe { ErasingHeap.realloc(old, layout, 8192) };
        assert_eq!(new.addr() % 4096, 0);
        // SAFETY: the new block with its layout.
        unsafe { ErasingHeap.dealloc(new, Layout::from_size_align(8192, 4096).unwrap()) };
    }
}
