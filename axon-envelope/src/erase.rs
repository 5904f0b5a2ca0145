//! Overwriting the stack that secrets were on.

use core::hint::black_box;

/// Calls `work`, and then overwrites the stack that it used.
///
/// Ciphers have the key of GHASH, the block that masks the tag, and parts of their key on the stack
/// as they run, and leave them there. The result must not hold a secret by value.
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

/// More than an AEAD takes; without optimization, code in Rust takes several times as much.
const DEPTH: usize = if cfg!(debug_assertions) { 32 * 1024 } else { 4 * 1024 };
