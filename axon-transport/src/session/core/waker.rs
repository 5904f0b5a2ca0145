//! Wakes a session's control thread.

use std::{
    io,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
};

use rustix::event::{EventfdFlags, eventfd};

/// The eventfd on which a session's control thread sleeps.
#[derive(Debug)]
pub(in crate::session) struct ControlWaker(OwnedFd);

impl ControlWaker {
    /// Creates a waker that is not set.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub(in crate::session) fn new() -> io::Result<Self> {
        Ok(Self(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?))
    }

    /// Wakes the control thread.
    pub(in crate::session) fn wake(&self) {
        // An eventfd whose counter is full is readable, too, so the error does not matter.
        let _ = rustix::io::write(&self.0, &1u64.to_ne_bytes());
    }

    /// Takes the wake-ups so far; returns whether there were any.
    pub(in crate::session) fn take(&self) -> bool {
        rustix::io::read(&self.0, &mut [0; 8]).is_ok()
    }
}

impl AsFd for ControlWaker {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
