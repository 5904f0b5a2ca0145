//! Blocks signals in AXON's own threads: signals belong to the application's threads.

#![allow(unsafe_code)]

use std::mem::MaybeUninit;

/// Blocks every signal in the calling thread until it is dropped. A thread that is started meanwhile starts, and stays,
/// with every signal blocked.
#[derive(Debug)]
pub struct BlockedSignals {
    before: libc::sigset_t,
    // The mask belongs to the thread that changed it.
    _thread: std::marker::PhantomData<*const ()>,
}

impl BlockedSignals {
    /// Blocks all signals from now on.
    pub fn all() -> Self {
        let mut all = MaybeUninit::<libc::sigset_t>::uninit();
        let mut before = MaybeUninit::<libc::sigset_t>::uninit();
        // SAFETY: sigfillset initialises the set it is given, and cannot fail for a valid pointer.
        unsafe { libc::sigfillset(all.as_mut_ptr()) };
        // SAFETY: both point to sets of the right size; `all` was initialised above, and with
        // SIG_SETMASK the call cannot fail, so that it initialises `before`.
        unsafe { libc::pthread_sigmask(libc::SIG_SETMASK, all.as_ptr(), before.as_mut_ptr()) };
        // SAFETY: initialised by the call above.
        let before = unsafe { before.assume_init() };
        Self { before, _thread: std::marker::PhantomData }
    }
}

impl Drop for BlockedSignals {
    fn drop(&mut self) {
        // SAFETY: `before` is a mask that the system gave; a null pointer asks for no copy.
        unsafe {
            libc::pthread_sigmask(libc::SIG_SETMASK, &self.before, std::ptr::null_mut());
        }
    }
}
