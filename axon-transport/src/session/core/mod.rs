//! The parts of a session that know none of its endpoints: its memory, its link to the daemon, and what threads and
//! tasks of the program wait for. Endpoints, handles and the control thread build on them.

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

/// What all endpoints and threads of a session share.
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
    /// The core of a new session.
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

    /// Whether this is a forked child of the session's process. Of its locks some may be held for
    /// ever then, by threads that were not forked with it.
    pub(in crate::session) fn is_forked(&self) -> bool {
        self.segment.is_forked()
    }

    /// Has the control thread look around.
    pub(in crate::session) fn wake(&self) {
        self.waker.wake();
    }

    /// Queues something for the daemon.
    pub(in crate::session) fn tell(&self, outgoing: Outgoing) {
        self.link.queue(outgoing);
        self.wake();
    }

    /// Has the control thread listen for samples on behalf of one subscription more.
    pub(in crate::session) fn listen(&self) -> Result<(), ShmError> {
        if self.listening.begin_callback(&self.segment)? {
            self.wake();
        }
        Ok(())
    }

    /// One subscription has nobody any more who would hear.
    pub(in crate::session) fn listen_no_more(&self) {
        if self.listening.end_callback() {
            self.wake();
        }
    }

    /// Has those who wait look again then.
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

    /// Whether the control thread has to end.
    pub(in crate::session) fn stops(&self) -> bool {
        // Pairs with the release store of `stop`.
        self.stopping.load(Ordering::Acquire)
    }

    /// Tells the threads that wait, and the listener.
    pub(in crate::session) fn notify(&self, event: Option<&SessionEvent>) {
        self.changes.notify();
        let Some(event) = event else { return };
        // Who waits for the control thread's end may hold what a listener waits for.
        if self.stops() {
            return;
        }
        if matches!(event, SessionEvent::Matched(_)) {
            // A writer that died between its last sample and the doorbell leaves that sample to be
            // found by who sleeps for samples.
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
