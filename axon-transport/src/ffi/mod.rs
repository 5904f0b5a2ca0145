//! The C interface, `axon_session_*`: the functions that `include/axon.h` declares.
//!
//! Rules for every function whose documentation does not say otherwise:
//!
//! - It may be called from any thread at any time, also concurrently with the same handle.
//! - It does not block, except on locks that are held for microseconds.
//! - It returns [`AXON_RET_OK`] or an error code. After an error it has done nothing and has written to no pointer
//!   that the caller passed. [`axon_session_last_error`] returns the error as text.
//! - It keeps no pointer that the caller passed. Strings are UTF-8 and end with a 0 byte.
//! - A callback must neither throw nor `longjmp` out of the call.
//! - A call that replaces or destroys a callback waits until a running call of the old callback returns. The
//!   old callback is not called again. A call from inside the callback does not wait. While an object is being
//!   destroyed, a thread that sets another callback for it gets `AXON_RET_INVALID_HANDLE`. The caller must not
//!   hold anything that the callback waits for.
//!
//! Handles are numbers, never pointers. A handle that is 0, stale, destroyed twice, of another kind or made up
//! gives [`AXON_RET_INVALID_HANDLE`]. A handle that a forked child inherited gives [`AXON_RET_FORKED`]. One thread
//! may destroy an object while other threads use it: their running calls end as usual. No panic crosses the
//! interface: every call runs in `guarded`, which catches panics.
#![allow(unsafe_code, non_camel_case_types)]

mod callback;
mod endpoints;
mod error;
mod event;
mod graph;
mod handles;
mod log;
mod memory;
mod node;
mod qos;
mod session;
#[cfg(test)]
mod tests;
mod wait;

use std::panic::{AssertUnwindSafe, catch_unwind};

pub use callback::*;
pub use endpoints::*;
pub use error::*;
pub use event::*;
pub use graph::*;
pub use handles::*;
pub use log::*;
pub use node::*;
pub use qos::*;
pub use session::*;
pub use wait::*;

/// The version of this interface. A new version means that a program compiled against an older header no
/// longer works.
pub const AXON_SESSION_ABI: u32 = 3;

/// Returns the interface version of the library. `axon_session_options_init` compares it with the version of
/// the header and fails if the two differ, so that no session is opened.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_abi() -> u32 {
    AXON_SESSION_ABI
}

/// Runs one call of the interface and converts a panic in it to [`AXON_RET_PANIC`].
fn guarded(call: impl FnOnce() -> Result<(), CallFailure>) -> axon_ret_t {
    match catch_unwind(AssertUnwindSafe(call)) {
        Ok(Ok(())) => AXON_RET_OK,
        Ok(Err(failure)) => failure.note(),
        Err(_) => CallFailure::new(AXON_RET_PANIC, "a panic was caught: a defect of AXON").note(),
    }
}
