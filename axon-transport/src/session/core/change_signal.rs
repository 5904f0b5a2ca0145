//! An eventfd that becomes readable when a session changes. The session's control thread sets it, and the
//! relay's thread polls it.

use std::{
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use rustix::event::{EventfdFlags, eventfd};

use super::changes::SessionEvent;

/// An eventfd that becomes readable when something happened.
#[derive(Debug)]
pub struct ChangeSignal {
    wake: OwnedFd,
    lost: AtomicBool,
}

impl ChangeSignal {
    /// Creates a signal that is not readable.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn new() -> std::io::Result<Arc<Self>> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        Ok(Arc::new(Self { wake, lost: AtomicBool::new(false) }))
    }

    /// Returns the listener through which a session signals its changes.
    pub fn listener(self: &Arc<Self>) -> impl Fn(&SessionEvent) + Send + Sync + 'static {
        let signal = Arc::clone(self);
        move |event| {
            if *event == SessionEvent::DaemonLost {
                // Pairs with the load in `is_lost`.
                signal.lost.store(true, Ordering::Release);
            }
            signal.wake();
        }
    }

    /// Returns whether the session has no daemon any more.
    pub fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Acquire)
    }

    pub(crate) fn wake(&self) {
        // An eventfd whose counter is full is readable, too, so the error does not matter.
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
    }

    /// Clears the signal; returns whether it was set.
    pub fn take(&self) -> bool {
        rustix::io::read(&self.wake, &mut [0; 8]).is_ok()
    }
}

impl AsFd for ChangeSignal {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }
}
