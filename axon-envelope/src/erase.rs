//! Overwrites the stack after work that had secrets on it.

use core::hint::black_box;

/// Calls `work`, and then overwrites the stack that it used.
///
/// A running cipher has the key of GHASH, the block that masks the tag, and parts of its key on the
/// stack, and leaves them there. The result must not hold a secret by value.
pub(crate) fn erasing_stack<T>(work: impl FnOnce() -> T) -> T {
    let result = on_the_stack(work);
    overwrite();
    result
}

#[inline(never)]
fn on_the_stack<T>(work: impl FnOnce() -> T) -> T {
    work()
}

#[inline(never)]
fn overwrite() {
    black_box([0_u8; DEPTH].as_mut_slice());
}

/// The number of bytes that are overwritten. It is more than an AEAD needs. Without optimization,
/// Rust code needs several times as much.
const DEPTH: usize = if cfg!(debug_assertions) { 32 * 1024 } else { 4 * 1024 };
