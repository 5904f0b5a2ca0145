//! Changes of shared memory that the control thread reports to the daemon.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use axon_shm::internal::{SegmentEvent, SessionSegment};

use super::waker::ControlWaker;
use crate::ids::{Gid, SessionId};

/// The changes of the session's own memory, and the requests for missing memory of other sessions. It may be used under
/// any lock.
pub(in crate::session) struct MemoryChanges {
    waker: Arc<ControlWaker>,
    changes: Mutex<Vec<SegmentChange>>,
    /// Counts the handovers: events after which readers have to be sent more before they find samples.
    handovers: AtomicU64,
    /// Counts how often the daemon received, or sent, everything from the beginning.
    connections: AtomicU64,
}

/// A change of the session's own memory, or a request for another session's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::session) enum SegmentChange {
    Opened(u32),
    Gone(u32),
    /// This publisher has no memory ready for its next large sample.
    Low(Gid),
    /// Readers miss memory of this other session.
    Wanted(SessionId),
}

impl MemoryChanges {
    /// Follows the changes of a session's memory from now on. `waker` wakes the control thread.
    pub(in crate::session) fn follow(
        segment: &SessionSegment,
        waker: Arc<ControlWaker>,
    ) -> Arc<Self> {
        let changes = Arc::new(Self {
            waker,
            changes: Mutex::default(),
            handovers: AtomicU64::new(0),
            connections: AtomicU64::new(0),
        });
        let listener = changes.clone();
        segment.on_segment(move |event| listener.note(event));
        changes
    }

    fn note(&self, event: SegmentEvent<'_>) {
        match event {
            SegmentEvent::Opened(info, _) => {
                self.push(SegmentChange::Opened(info.number));
                self.hands_over();
            }
            SegmentEvent::Gone(info) => self.push(SegmentChange::Gone(info.number)),
            SegmentEvent::Low(publisher) => self.push(SegmentChange::Low(publisher)),
        }
    }

    /// Counts a handover: readers have to be sent memory that was opened, a grant, or everything by another daemon.
    pub(in crate::session) fn hands_over(&self) {
        // Relaxed: this is counted before the writer's lock is taken, and the publishing thread reads it
        // under that lock or after.
        self.handovers.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a new connection: the daemon is another one, or sends everything anew, and may not answer earlier fences.
    pub(in crate::session) fn begins_anew(&self) {
        // Relaxed: a question that is asked once more is answered once more.
        self.connections.fetch_add(1, Ordering::Relaxed);
        self.hands_over();
    }

    /// Returns the number of connections.
    pub(in crate::session) fn connections(&self) -> u64 {
        self.connections.load(Ordering::Relaxed)
    }

    /// Returns the number of handovers. If it is read after a sample was published, it covers everything that the
    /// sample's readers need.
    pub(in crate::session) fn handovers(&self) -> u64 {
        self.handovers.load(Ordering::Relaxed)
    }

    /// Records that readers miss memory of another session.
    pub(in crate::session) fn want(&self, session: SessionId) {
        self.push(SegmentChange::Wanted(session));
    }

    fn push(&self, change: SegmentChange) {
        self.changes.lock().unwrap_or_else(PoisonError::into_inner).push(change);
        self.waker.wake();
    }

    pub(in crate::session) fn take(&self) -> Vec<SegmentChange> {
        std::mem::take(&mut *self.changes.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_change_is_taken_once_and_wakes_the_control_thread() {
        let waker = Arc::new(ControlWaker::new().unwrap());
        let own = SessionSegment::create(SessionId::random()).unwrap();
        let changes = MemoryChanges::follow(&own, waker.clone());
        let woken = || waker.take();
        changes.take();
        woken();
        assert!(!woken());
        let other = SessionId::random();
        changes.want(other);
        assert!(woken());
        assert_eq!(changes.take(), [SegmentChange::Wanted(other)]);
        assert!(changes.take().is_empty());
    }

    #[test]
    fn a_new_daemon_is_a_connection_and_a_handover() {
        let waker = Arc::new(ControlWaker::new().unwrap());
        let own = SessionSegment::create(SessionId::random()).unwrap();
        let changes = MemoryChanges::follow(&own, waker);
        let (connections, handovers) = (changes.connections(), changes.handovers());
        changes.hands_over();
        assert_eq!((changes.connections(), changes.handovers()), (connections, handovers + 1));
        changes.begins_anew();
        assert_eq!((changes.connections(), changes.handovers()), (connections + 1, handovers + 2));
    }
}
