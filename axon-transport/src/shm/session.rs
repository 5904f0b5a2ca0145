//! This process's own session segment: the lanes of its readers and the words that say who sleeps.

use std::{
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{Arc, Mutex, PoisonError, atomic::AtomicU64},
    time::Duration,
};

use rustix::process::{PidfdFlags, getpid, pidfd_open};

use super::{Lane, PeerDescriptors, ShmError, layout, memory::Segment};
use crate::{
    ids::SessionId,
    passed::PassedFd,
    wait::{Doorbell, ExternalLeader, Look, Purpose, due},
};

/// The memory, doorbell and identity by which other sessions know this one.
///
/// One per session; a process may have several. All methods may be called from any thread.
pub struct SessionSegment {
    id: SessionId,
    segment: Segment,
    doorbell: Doorbell,
    pidfd: OwnedFd,
    lanes: Mutex<Lanes>,
    /// The last ticket of each of our own armed words that we rang for.
    rung: [AtomicU64; 2],
}

struct Lanes {
    free: Vec<u32>,
    /// Lanes from here on have never been used.
    fresh: u32,
    /// How many have been given out.
    given: u64,
    /// Bytes of the segment that are backed by memory.
    committed: u64,
}

impl SessionSegment {
    /// Makes the segment of a new session.
    ///
    /// # Errors
    /// The system has no memory or descriptors left, or lacks sealed memfds or pidfds (Linux 5.3).
    pub fn create(id: SessionId) -> Result<Arc<Self>, ShmError> {
        let segment = Segment::create("axon-session", layout::session_bytes())?;
        segment.commit(0, layout::ALIGN)?;
        layout::write_session(segment.words(), id);
        let pidfd = pidfd_open(getpid(), PidfdFlags::empty())
            .map_err(ShmError::system("opening a pidfd of this process"))?;
        Ok(Arc::new(Self {
            id,
            segment,
            doorbell: Doorbell::new().map_err(ShmError::system("creating a doorbell"))?,
            pidfd,
            lanes: Mutex::new(Lanes {
                free: Vec::new(),
                fresh: 0,
                given: 0,
                committed: layout::ALIGN,
            }),
            rung: Default::default(),
        }))
    }

    /// Its id.
    pub fn id(&self) -> SessionId {
        self.id
    }

    /// Duplicates of the descriptors that other sessions need.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn descriptors(&self) -> Result<PeerDescriptors, ShmError> {
        let clone = |fd: BorrowedFd<'_>| {
            fd.try_clone_to_owned()
                .map(PassedFd::from)
                .map_err(|source| ShmError::System { what: "duplicating a descriptor", source })
        };
        Ok(PeerDescriptors {
            segment: clone(self.segment.fd())?,
            doorbell: clone(self.doorbell.bell().as_fd())?,
            pidfd: clone(self.pidfd.as_fd())?,
        })
    }

    /// An epoll instance that is readable when this session was rung.
    pub fn doorbell(&self) -> BorrowedFd<'_> {
        self.doorbell.as_fd()
    }

    /// A lane for a reader that is about to attach.
    ///
    /// # Errors
    /// All lanes are taken, or memory is short.
    pub fn allocate_lane(self: &Arc<Self>) -> Result<Lane, ShmError> {
        if self.segment.is_forked() {
            return Err(ShmError::Forked);
        }
        let mut lanes = self.lanes.lock().unwrap_or_else(PoisonError::into_inner);
        lanes.given += 1;
        let number = lanes.given;
        if let Some(index) = lanes.free.pop() {
            return Ok(Lane::new(Arc::clone(self), index, number));
        }
        let index = lanes.fresh;
        if index == layout::LANES {
            return Err(ShmError::NoLane { session: self.id, lanes: layout::LANES });
        }
        let end = layout::lane_end(index);
        if end > lanes.committed {
            let upto = end.next_multiple_of(layout::ALIGN);
            self.segment.commit(lanes.committed, upto)?;
            lanes.committed = upto;
        }
        lanes.fresh += 1;
        Ok(Lane::new(Arc::clone(self), index, number))
    }

    /// Blocks until `ready`, which is asked again whenever a publisher or [`Self::notify`] rang,
    /// or until `timeout` has passed. Returns what `ready` said last.
    ///
    /// Any number of threads may wait; none of our locks is held while `ready` runs.
    pub fn wait(&self, mut ready: impl FnMut() -> bool, timeout: Option<Duration>) -> bool {
        if self.segment.is_forked() {
            return ready();
        }
        self.doorbell.wait(self.armed_words(), Purpose::Samples, ready, None, &[], timeout)
    }

    /// As [`wait`](Self::wait), for something that other threads can look for too: this one is
    /// woken only when it is there.
    pub(crate) fn wait_for(&self, look: Arc<dyn Look>, timeout: Option<Duration>) -> bool {
        if self.segment.is_forked() {
            return look.ready();
        }
        let (words, ready) = (self.armed_words(), || look.ready());
        self.doorbell.wait(words, Purpose::Samples, ready, Some(look.clone()), &[], timeout)
    }

    /// Makes every waiter of this session look again.
    pub fn notify(&self) {
        if !self.segment.is_forked() {
            self.doorbell.notify();
        }
    }

    /// Lets an event loop lead this session's waits.
    ///
    /// # Errors
    /// There is one already, or this process is a fork of the session's.
    pub fn external_leader(self: &Arc<Self>) -> Result<ExternalLeader, ShmError> {
        if self.segment.is_forked() {
            return Err(ShmError::Forked);
        }
        ExternalLeader::new(Arc::clone(self)).ok_or(ShmError::AlreadyLed(self.id))
    }

    /// Waits for room to publish; also looks again when one of `others` becomes readable.
    pub(super) fn wait_for_room(
        &self,
        ready: impl FnMut() -> bool,
        others: &[BorrowedFd<'_>],
        timeout: Duration,
    ) -> bool {
        let words = self.armed_words();
        self.doorbell.wait(words, Purpose::Room, ready, None, others, Some(timeout))
    }

    pub(crate) fn doorbell_hub(&self) -> &Doorbell {
        &self.doorbell
    }

    pub(crate) fn armed_word(&self, purpose: Purpose) -> &AtomicU64 {
        &self.segment.words()[match purpose {
            Purpose::Samples => layout::session::ARMED,
            Purpose::Room => layout::session::BLOCKED,
        }]
    }

    pub(crate) fn armed_words(&self) -> [&AtomicU64; 2] {
        [self.armed_word(Purpose::Samples), self.armed_word(Purpose::Room)]
    }

    pub(super) fn ring_if(&self, purpose: Purpose) {
        if due(self.armed_word(purpose), &self.rung[purpose as usize]) {
            self.doorbell.ring_own();
        }
    }

    pub(super) fn lane_words(&self, index: u32) -> &[AtomicU64; layout::LANE_WORDS] {
        layout::lane_words(self.segment.words(), index)
    }

    /// Whether the calling process is a fork of the session's.
    pub(crate) fn is_forked(&self) -> bool {
        self.segment.is_forked()
    }

    pub(super) fn free_lane(&self, index: u32) {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).free.push(index);
    }
}
