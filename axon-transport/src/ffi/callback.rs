//! Callbacks of the C program that are called with the number of new events.

use std::{ffi::c_void, sync::Arc};

use crate::session::OnNew;

/// Told how often something happened since it was told last; at least once. It may be called on the
/// session's thread, but never by two threads at once, must not block, and may call any function of this
/// interface that does not block, also to replace itself or to destroy what it was set for.
pub type axon_callback_t = Option<unsafe extern "C" fn(user: *const c_void, count: usize)>;

/// What a function is to be called with. The program says that any thread may.
#[derive(Clone, Copy)]
pub(super) struct User(pub(super) *const c_void);

// SAFETY: it is never dereferenced here, and the caller that sets a callback says that it may be
// called with it from any thread.
unsafe impl Send for User {}
// SAFETY: as above.
unsafe impl Sync for User {}

/// A function of the program as the session calls it.
pub(super) fn told(callback: axon_callback_t, user: *const c_void) -> Option<OnNew> {
    let function = callback?;
    let user = User(user);
    Some(Arc::new(move |count: u64| {
        let User(pointer) = { user };
        let count = usize::try_from(count).unwrap_or(usize::MAX);
        // SAFETY: the caller that set it says that it may be called with this until it is replaced or
        // its object destroyed. Neither returns before this call does, and none begins after them
        // (`Callback::vacate`, `Callback::end`), whichever threads set and destroy.
        unsafe { function(pointer, count) };
    }))
}
