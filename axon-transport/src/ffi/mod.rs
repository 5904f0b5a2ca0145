//! The C interface, `axon_session_*`: what `include/axon.h` declares.
//!
//! The rules, for a function that says nothing else of itself:
//!
//! - It may be called from any thread at any time, also at the same time with the same handle.
//! - It does not block, but for locks that are held for microseconds.
//! - It returns [`AXON_RET_OK`], or why it did not do what it was asked; then it did nothing, wrote to
//!   none of the places that it was given, and [`axon_session_last_error`] says in words what is wrong.
//! - It keeps no pointer that it was given. Strings are UTF-8 and end with a 0 byte.
//! - What it calls back must neither throw nor `longjmp` out of the call.
//! - Where it replaces a callback, or destroys what has one, that has returned when it returns, unless it
//!   is called from within it, and is called no more: whatever other threads do meanwhile, one that
//!   would set another gets `AXON_RET_INVALID_HANDLE`. It blocks until then: hold nothing that
//!   the callback waits for.
//!
//! Handles are numbers, never pointers: one that is 0, stale, destroyed twice, of another kind or made
//! up gives [`AXON_RET_INVALID_HANDLE`], one that a forked child inherited [`AXON_RET_FORKED`]. An
//! object may be destroyed by one thread while others use it: calls that are under way end as they
//! would have. No panic crosses the border: what could panic is called in one place
//! (`guarded`), which catches it.
#![allow(unsafe_code, non_camel_case_types)]

mod callback;
mod client;
mod endpoint;
mod error;
mod event;
mod graph;
mod handle;
mod loan;
mod log;
mod memory;
mod node;
mod publisher;
mod qos;
mod server;
mod session;
mod subscription;
mod table;
#[cfg(test)]
mod tests;
mod wait;

use std::panic::{AssertUnwindSafe, catch_unwind};

pub use callback::*;
pub use client::*;
pub use endpoint::*;
pub use error::*;
pub use event::*;
pub use graph::*;
pub use handle::*;
pub use loan::*;
pub use log::*;
pub use node::*;
pub use publisher::*;
pub use qos::*;
pub use server::*;
pub use session::*;
pub use subscription::*;
pub use wait::*;

/// The version of this interface. It rises whenever a program that was compiled against the former
/// header would not work any more.
pub const AXON_SESSION_ABI: u32 = 2;

/// The version of the interface that the library has. `axon_session_options_init` compares it with
/// the header's, so that no session is opened where they differ.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_abi() -> u32 {
    AXON_SESSION_ABI
}

/// Runs one call of the interface: nothing that panics in it reaches the caller.
fn guarded(call: impl FnOnce() -> Result<(), Failure>) -> axon_ret_t {
    match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(())) => AXON_RET_OK,
        Ok(Err(failure)) => failure.note(),
        Err(_) => Failure::new(AXON_RET_PANIC, "a panic was caught: a defect of AXON").note(),
    }
}
