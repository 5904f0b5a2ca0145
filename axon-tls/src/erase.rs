//! Overwrites the stack after work that had secrets on it.

use std::hint::black_box;

/// Calls `work`, a step of a handshake, and then overwrites the stack that it used.
///
/// rustls and aws-lc-rs pass keys by value. Each move leaves a copy on the stack, which no
/// destructor erases. The result must not hold a secret by value.
pub(crate) fn erasing_stack<T>(work: impl FnOnce() -> T) -> T {
    erasing::<HANDSHAKE_DEPTH, T>(work)
}

/// As [`erasing_stack`], for the protection of one packet. A cipher has its key on the stack while
/// it runs.
#[cfg(feature = "quic")]
pub(crate) fn erasing_stack_of_packet<T>(work: impl FnOnce() -> T) -> T {
    erasing::<PACKET_DEPTH, T>(work)
}

/// As [`erasing_stack`], for a record of a byte stream. rustls also uses the stack around the
/// cipher.
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

/// The stack that is overwritten after a step of a handshake. It is larger than a step needs, even
/// in builds without optimization.
const HANDSHAKE_DEPTH: usize = 96 * 1024;

/// The stack that is overwritten after the protection of a packet. It is larger than an AEAD needs.
#[cfg(feature = "quic")]
const PACKET_DEPTH: usize = 4 * 1024;

/// The stack that is overwritten after a record. It is larger than rustls needs to protect or to
/// open a record.
#[cfg(feature = "tokio")]
const RECORD_DEPTH: usize = 16 * 1024;
