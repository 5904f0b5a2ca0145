//! Callbacks of the C program that are called with the number of new events.

use std::{ffi::c_void, sync::Arc};

use crate::session::NewDataCallback;

/// A function that receives the number of new events: those since its last call, at least one. The session's
/// thread may call the function. Two threads never call it at once. The function must not block. It may call
/// any function of this interface that does not block: it may replace itself, or destroy the object that it
/// was set for.
pub type axon_callback_t = Option<unsafe extern "C" fn(user: *const c_void, count: usize)>;

/// The `user` pointer that the program passes to its callback. The program allows any thread to use it.
#[derive(Clone, Copy)]
pub(super) struct User(pub(super) *const c_void);

// SAFETY: this library never dereferences the pointer. The caller that sets a callback allows any thread to
// call it with this pointer.
unsafe impl Send for User {}
// SAFETY: as above.
unsafe impl Sync for User {}

/// Converts a callback of the program to the closure that the session calls.
pub(super) fn told(callback: axon_callback_t, user: *const c_void) -> Option<NewDataCallback> {
    let function = callback?;
    let user = User(user);
    Some(Arc::new(move |count: u64| {
        let User(pointer) = { user };
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        // SAFETY: the caller allows this call until the callback is replaced or its object is destroyed. The
        // replacing or destroying call does not return before this call does, and no call begins afterwards
        // (`Callback::vacate`, `Callback::end`). That holds for all threads.
        unsafe { function(pointer, count) };
    }))
}
