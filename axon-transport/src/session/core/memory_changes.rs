//! Changes of shared memory that the control thread tells the daemon.

use std::sync::{
    Arc, Mutex, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use axon_shm::internal::{SegmentEvent, SessionSegment};

use super::waker::ControlWaker;
use crate::ids::{Gid, SessionId};

/// What changed in the session's own memory, and whether other sessions' is missing. Of use under any
/// lock.
pub(in crate::session) struct MemoryChanges {
    waker: Arc<ControlWaker>,
    changes: Mutex<Vec<SegmentChange>>,
    /// Counts what readers have to be sent before they find samples.
    handovers: AtomicU64,
    /// Counts the times that the daemon was told, or tells, everything from the beginning.
    connections: AtomicU64,
}

/// What became of the session's own memory, or is to be asked of another's.
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
    /// The changes of a session's memory from now on. `waker` wakes the control thread.
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

    /// Readers have to be sent something more: memory that was opened, a grant, or all of it by another
    /// daemon.
    pub(in crate::session) fn hands_over(&self) {
        // Relaxed: this is counted before the writer's lock is taken, and the publishing thread reads it
        // under that lock or after.
        self.handovers.fetch_add(1, Ordering::Relaxed);
    }

    /// The daemon is another one, or tells everything anew: it may not answer what it was asked before.
    pub(in crate::session) fn begins_anew(&self) {
        // Relaxed: a question that is asked once more is answered once more.
        self.connections.fetch_add(1, Ordering::Relaxed);
        self.hands_over();
    }

    /// How often that was so.
    pub(in crate::session) fn connections(&self) -> u64 {
        self.connections.load(Ordering::Relaxed)
    }

    /// How often readers had to be sent something more. Read after a sample was published, it covers all that its readers need.
    pub(in crate::session) fn handovers(&self) -> u64 {
        self.handovers.load(Ordering::Relaxed)
    }

    /// Readers miss memory of another session.
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
