//! Counts the allocations of this thread, in Rust and in C.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Allocations of a piece of work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Allocations {
    /// Through Rust's global allocator.
    pub(crate) rust: usize,
    /// Through `malloc` and its kin, which is also where Rust's end up. Zero where these calls are
    /// not seen: elsewhere than on Linux with glibc.
    pub(crate) c: usize,
}

pub(crate) const NONE: Allocations = Allocations { rust: 0, c: 0 };

thread_local! {
    // Constant and without a destructor, so that reading them allocates nothing by itself.
    static RUST: Cell<usize> = const { Cell::new(0) };
    static C: Cell<usize> = const { Cell::new(0) };
}

/// Runs `work`, and returns its result and its allocations.
pub(crate) fn allocations<T>(work: impl FnOnce() -> T) -> (T, Allocations) {
    let before = (RUST.get(), C.get());
    let result = work();
    (result, Allocations { rust: RUST.get() - before.0, c: C.get() - before.1 })
}

struct Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

// SAFETY: every call goes to `System` as it came.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        RUST.set(RUST.get() + 1);
        // SAFETY: the caller fulfils the contract of `GlobalAlloc`, which is that of `System`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        RUST.set(RUST.get() + 1);
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        RUST.set(RUST.get() + 1);
        // SAFETY: as above.
        unsafe { System.realloc(block, layout, size) }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(block, layout) }
    }
}

/// aws-lc is C and never asks Rust's allocator, so `malloc` itself is counted: the program's own
/// definition comes before glibc's, and hands on to it.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod c {
    use std::ffi::c_void;

    use super::C;

    unsafe extern "C" {
        fn __libc_malloc(size: usize) -> *mut c_void;
        fn __libc_calloc(count: usize, size: usize) -> *mut c_void;
        fn __libc_realloc(block: *mut c_void, size: usize) -> *mut c_void;
    }

    // SAFETY: glibc allows a program to replace its allocator's functions. The pointers that these return come from
    // glibc's own allocator, so its `free` accepts them.
    #[unsafe(no_mangle)]
    extern "C" fn malloc(size: usize) -> *mut c_void {
        C.set(C.get() + 1);
        // SAFETY: any size may be asked for.
        unsafe { __libc_malloc(size) }
    }

    // SAFETY: as `malloc`.
    #[unsafe(no_mangle)]
    extern "C" fn calloc(count: usize, size: usize) -> *mut c_void {
        C.set(C.get() + 1);
        // SAFETY: any size may be asked for.
        unsafe { __libc_calloc(count, size) }
    }

    // SAFETY: as `malloc`.
    #[unsafe(no_mangle)]
    unsafe extern "C" fn realloc(block: *mut c_void, size: usize) -> *mut c_void {
        C.set(C.get() + 1);
        // SAFETY: the caller's block is null or one of glibc's.
        unsafe { __libc_realloc(block, size) }
    }
}
