//! Overwriting the stack that secrets were on.

use std::hint::black_box;

/// Calls `work`, a step of a handshake, and then overwrites the stack that it used.
///
/// rustls and aws-lc-rs pass keys by value: a move leaves a copy on the stack, which no destructor
/// knows. The result must not hold a secret by value.
pub(crate) fn erasing_stack<T>(work: impl FnOnce() -> T) -> T {
    erasing::<HANDSHAKE_DEPTH, T>(work)
}

/// The same for the protection of one packet: ciphers have their key on the stack as they run.
#[cfg(feature = "quic")]
pub(crate) fn erasing_stack_of_packet<T>(work: impl FnOnce() -> T) -> T {
    erasing::<PACKET_DEPTH, T>(work)
}

/// The same for a record of a byte stream, with what rustls does around the cipher.
#[cfg(feature = "tokio")]
pub(crate) fn erasing_stack_of_record<T>(work: impl FnOnce() -> T) -> T {
    erasing::<RECORD_DEPTH, T>(work)
}

/// Calls `work`, and then overwrites `DEPTH` bytes of the stack that it used. The result must not
/// hold a secret by value.
pub fn erasing<const DEPTH: usize, T>(work: impl FnOnce() -> T) -> T {
    let result = on_the_stack(work);
    overwrite::<DEPTH>();
    result
}

#[inline(never)]
fn on_the_stack<T>(work: impl FnOnce() -> T) -> T {
    work()
}

#[inline(never)]
fn overwrite<const DEPTH: usize>() {
    black_box([0_u8; DEPTH].as_mut_slice());
}

/// More than a step of a handshake takes, in builds without optimization too.
const HANDSHAKE_DEPTH: usize = 96 * 1024;

/// More than an AEAD takes.
#[cfg(feature = "quic")]
const PACKET_DEPTH: usize = 4 * 1024;

/// More than rustls takes to protect a record, or to open one.
#[cfg(feature = "tokio")]
const RECORD_DEPTH: usize = 16 * 1024;
