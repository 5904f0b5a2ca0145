//! The parts of a session that do not know its endpoints: its memory, its link to the daemon, and the objects that
//! threads and tasks of the program wait for. Endpoints, handles and the control thread build on them.

mod change_signal;
mod changes;
mod guard;
mod link;
mod listener;
mod listening;
mod memory_changes;
mod waker;

use std::{
    fmt, io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use axon_shm::{ShmError, internal::SessionSegment};

pub use self::{change_signal::ChangeSignal, changes::SessionEvent, guard::GuardCondition};
pub(in crate::session) use self::{
    changes::ChangeWaiters,
    guard::Guard,
    link::{DaemonLink, Outgoing},
    listener::Listener,
    listening::Listening,
    memory_changes::{MemoryChanges, SegmentChange},
    waker::ControlWaker,
};
use super::options::SessionOptions;
use crate::{config::Config, ids::SessionId};

/// The state that all endpoints and threads of a session share.
pub(in crate::session) struct SessionCore {
    pub(in crate::session) config: Config,
    pub(in crate::session) options: SessionOptions,
    pub(in crate::session) id: SessionId,
    pub(in crate::session) segment: Arc<SessionSegment>,
    /// Wakes the control thread.
    pub(in crate::session) waker: Arc<ControlWaker>,
    pub(in crate::session) memory: Arc<MemoryChanges>,
    pub(in crate::session) link: DaemonLink,
    /// The callbacks and tasks for which the control thread listens for samples.
    pub(in crate::session) listening: Listening,
    pub(in crate::session) changes: ChangeWaiters,
    stopping: AtomicBool,
}

impl SessionCore {
    /// Creates the core of a new session.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub(in crate::session) fn new(
        config: Config,
        options: SessionOptions,
        segment: Arc<SessionSegment>,
    ) -> io::Result<Self> {
        let waker = Arc::new(ControlWaker::new()?);
        let memory = MemoryChanges::follow(&segment, waker.clone());
        Ok(Self {
            config,
            options,
            id: segment.id(),
            segment,
            waker,
            memory,
            link: DaemonLink::default(),
            listening: Listening::default(),
            changes: ChangeWaiters::default(),
            stopping: AtomicBool::new(false),
        })
    }

    /// Returns whether this process is a forked child of the session's process. In a forked child, threads that do not
    /// exist there may hold some of the locks for ever.
    pub(in crate::session) fn is_forked(&self) -> bool {
        self.segment.is_forked()
    }

    /// Wakes the control thread.
    pub(in crate::session) fn wake(&self) {
        self.waker.wake();
    }

    /// Queues a message for the daemon, and wakes the control thread.
    pub(in crate::session) fn tell(&self, outgoing: Outgoing) {
        self.link.queue(outgoing);
        self.wake();
    }

    /// Makes the control thread listen for samples for one subscription more.
    pub(in crate::session) fn listen(&self) -> Result<(), ShmError> {
        if self.listening.begin_callback(&self.segment)? {
            self.wake();
        }
        Ok(())
    }

    /// Makes the control thread listen for one subscription less.
    pub(in crate::session) fn listen_no_more(&self) {
        if self.listening.end_callback() {
            self.wake();
        }
    }

    /// Makes waiting threads and tasks look again at `at`.
    pub(in crate::session) fn look_again(&self, at: Instant) {
        // The control thread itself asks for the same time again and again, and must not wake itself each time.
        if self.listening.look_again(at) {
            self.wake();
        }
    }

    /// Ends the control thread.
    pub(in crate::session) fn stop(&self) {
        // Pairs with the acquire load of `stops`.
        self.stopping.store(true, Ordering::Release);
        self.wake();
    }

    /// Returns whether the control thread has to end.
    pub(in crate::session) fn stops(&self) -> bool {
        // Pairs with the release store of `stop`.
        self.stopping.load(Ordering::Acquire)
    }

    /// Wakes the waiting threads, and calls the listener with the event.
    pub(in crate::session) fn notify(&self, event: Option<&SessionEvent>) {
        self.changes.notify();
        let Some(event) = event else { return };
        // A thread that waits for the end of the control thread may hold a lock that the listener waits for.
        if self.stops() {
            return;
        }
        if matches!(event, SessionEvent::Matched(_)) {
            // A writer may have died between its last sample and the doorbell. Waking the threads that sleep for
            // samples lets them find that sample.
            self.segment.notify();
        }
        self.changes.tell_listener(event);
    }
}

impl fmt::Debug for SessionCore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SessionCore").field("id", &self.id).finish_non_exhaustive()
    }
}
