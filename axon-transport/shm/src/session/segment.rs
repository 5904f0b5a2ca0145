//! A session's own memory: its segments, its lanes, and the words that show which of its threads sleep. Other sessions
//! access it through its descriptors.

use std::{
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
    time::Duration,
};

use rustix::process::{PidfdFlags, getpid, pidfd_open};

use crate::{
    alloc::{
        heap::{Block, Heap, HeapObject, Need},
        segments::{OwnSegment, SegmentEvent, SegmentInfo, Segments},
    },
    error::ShmError,
    ids::{Gid, SessionId},
    memory::segment::Map,
    ring::{
        journal::Journal,
        layout::{self, SegmentKind},
    },
    session::{
        activity::Activity,
        lane::Lane,
        leader::ExternalLeader,
        orphans::{Orphan, Orphans},
        peer::PeerDescriptors,
    },
    wake::{Doorbell, ForwardedWakeups, Purpose, WakeCheck, WakeListener, due, waits},
};

/// The memory, doorbell and identity by which other sessions know this one.
///
/// One per session; a process may have several. All methods may be called from any thread.
pub struct SessionSegment {
    id: SessionId,
    /// The first of the segments.
    first: Arc<OwnSegment>,
    segments: Segments,
    heap: Heap,
    orphans: Orphans,
    doorbell: Doorbell,
    lanes: Mutex<Lanes>,
    /// The last ticket of each of its own armed words that this process rang for.
    rung: [AtomicU64; 2],
    /// Number of rings created so far, from which they are numbered.
    rings: AtomicU32,
    activity: Arc<Activity>,
}

#[derive(Default)]
struct Lanes {
    /// Unused lanes. Their memory never becomes anything else: a publisher that checks a lane which has passed on must
    /// see that it has.
    free: Vec<HeapObject>,
    /// Number of lanes created.
    made: u32,
    /// Number of times that a lane has been given out.
    given: u64,
}

impl SessionSegment {
    /// Creates the memory of a new session.
    ///
    /// # Errors
    /// The system has no memory or descriptors left, or lacks sealed memfds.
    pub fn create(id: SessionId) -> Result<Arc<Self>, ShmError> {
        let segments = Segments::new(id);
        let first = segments.open(SegmentKind::Session, layout::SESSION_BYTES)?;
        Ok(Arc::new(Self {
            id,
            heap: Heap::new(Arc::clone(&first)),
            first,
            segments,
            orphans: Orphans::default(),
            doorbell: Doorbell::new().map_err(ShmError::system("creating a doorbell"))?,
            lanes: Mutex::default(),
            rung: Default::default(),
            rings: AtomicU32::new(0),
            activity: Arc::default(),
        }))
    }

    /// Returns the session's id.
    #[inline]
    pub fn id(&self) -> SessionId {
        self.id
    }

    /// Duplicates the descriptors that other sessions need.
    ///
    /// # Errors
    /// The process has no descriptors left, is a fork of the session's, or the system lacks pidfds
    /// (Linux 5.3).
    pub fn descriptors(&self) -> Result<PeerDescriptors, ShmError> {
        // Other sessions would watch the wrong process.
        if self.is_forked() {
            return Err(ShmError::Forked);
        }
        let doorbell = self.doorbell.bell().as_fd().try_clone_to_owned();
        let doorbell = doorbell
            .map_err(|source| ShmError::System { what: "duplicating a descriptor", source })?;
        let pidfd = pidfd_open(getpid(), PidfdFlags::empty())
            .map_err(ShmError::system("opening a pidfd of this process"))?;
        Ok(PeerDescriptors {
            segment: self.first.descriptor()?.into(),
            doorbell: doorbell.into(),
            pidfd: pidfd.into(),
        })
    }

    /// Returns an epoll instance that is readable when the session was rung.
    pub fn doorbell(&self) -> BorrowedFd<'_> {
        self.doorbell.as_fd()
    }

    /// Sets the listener for all further segments of the session: other sessions must learn of them, and get their
    /// descriptors. Returns false if there is a listener already.
    ///
    /// It is called while locks are held: it must neither block nor call into the session.
    pub fn on_segment(&self, listener: impl Fn(SegmentEvent<'_>) + Send + Sync + 'static) -> bool {
        self.segments.listen(Box::new(listener))
    }

    /// Returns the segments besides the first, by number.
    pub fn segments(&self) -> Vec<SegmentInfo> {
        self.further().iter().map(|segment| segment.info).collect()
    }

    /// Returns the description of segment `number` and a duplicate of its descriptor; `None` if it is gone.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn segment(&self, number: u32) -> Result<Option<(SegmentInfo, OwnedFd)>, ShmError> {
        self.segments
            .get(number)
            .map(|segment| Ok((segment.info, segment.descriptor()?)))
            .transpose()
    }

    /// Frees the memory of publishers that are gone and that no reader reads any more. Returns whether some is left
    /// that is still read.
    pub fn tidy(&self) -> bool {
        !self.is_forked() && self.orphans.sweep(&self.heap, &self.segments)
    }

    /// Returns whether readers of other sessions have yet to take samples of publishers that are gone.
    pub fn has_unread(&self) -> bool {
        !self.is_forked() && self.orphans.are_unread()
    }

    /// Returns the number of checks of publishers that are gone since the start.
    #[cfg(test)]
    pub(crate) fn looks_at_orphans(&self) -> usize {
        self.orphans.looks()
    }

    /// Like [`tidy`](Self::tidy), but if many publishers are gone, not every call frees memory: call `tidy` later if
    /// this returns true.
    pub fn tidy_some(&self) -> bool {
        !self.is_forked() && self.orphans.sweep_some(&self.heap, &self.segments)
    }

    /// Returns a lane for a reader that is about to attach.
    ///
    /// # Errors
    /// All lanes are taken, or memory is short.
    pub fn allocate_lane(self: &Arc<Self>) -> Result<Lane, ShmError> {
        if self.is_forked() {
            return Err(ShmError::Forked);
        }
        let mut lanes = self.lanes.lock().unwrap_or_else(PoisonError::into_inner);
        let object = match lanes.free.pop() {
            Some(object) => object,
            None if lanes.made == layout::LANES => {
                return Err(ShmError::NoLane { session: self.id, lanes: layout::LANES });
            }
            None => {
                let object = self.heap.allocate_lane()?;
                object.words().iter().for_each(|word| word.store(0, Ordering::Relaxed));
                lanes.made += 1;
                object
            }
        };
        lanes.given += 1;
        Ok(Lane::new(Arc::clone(self), object, lanes.given))
    }

    /// From now on, [`take_active`](Self::take_active) finds readers that [are
    /// followed](crate::reader::Reader::follow); the caller has to call it when the doorbell rang.
    pub fn follow(&self) {
        self.activity.follow();
    }

    /// Adds to `found` the followed readers that may have samples to take, each with its writer: the readers whose
    /// rings got samples since the last call, and a few others. Call it after the doorbell was armed: later samples
    /// ring.
    pub fn take_active(&self, found: &mut Vec<(Gid, Gid)>) {
        if !self.is_forked() {
            self.activity.take(self.journal(), found);
        }
    }

    /// Makes the next [`take_active`](Self::take_active) find all readers.
    pub fn mark_all_active(&self) {
        if !self.is_forked() {
            self.activity.mark_all();
        }
    }

    /// Returns the number of a new ring.
    pub(crate) fn number_ring(&self) -> u32 {
        // Relaxed: the number alone counts. Two rings of one number are checked together.
        self.rings.fetch_add(1, Ordering::Relaxed)
    }

    #[inline]
    pub(crate) fn journal(&self) -> Journal<'_, AtomicU64> {
        let words = self.first.memory.words();
        Journal { noted: &words[layout::session::NOTED], entries: &words[layout::session::JOURNAL] }
    }

    pub(crate) fn activity(&self) -> &Arc<Activity> {
        &self.activity
    }

    /// Blocks until `ready` returns true, or until `timeout` has passed. `ready` is called again whenever a publisher
    /// or [`Self::notify`] rang. Returns the last result of `ready`.
    ///
    /// Any number of threads may wait; no lock of the session is held while `ready` runs.
    #[inline]
    pub fn wait(&self, mut ready: impl FnMut() -> bool, timeout: Option<Duration>) -> bool {
        if self.is_forked() {
            return ready();
        }
        self.doorbell.wait(self.armed_words(), Purpose::Samples, ready, None, &[], timeout)
    }

    /// Like [`wait`](Self::wait), for a condition that other threads can check, too, with the object that `look` makes:
    /// this thread is woken only when the condition holds.
    #[inline]
    pub fn wait_for(
        &self,
        ready: impl FnMut() -> bool,
        look: &dyn Fn() -> Arc<dyn WakeCheck>,
        timeout: Option<Duration>,
    ) -> bool {
        if self.is_forked() {
            return false;
        }
        let words = self.armed_words();
        self.doorbell.wait(words, Purpose::Samples, ready, Some(look), &[], timeout)
    }

    /// Makes `elsewhere`, another session of this process where a thread waits, look again when `look` may be ready,
    /// until the returned value is dropped. A thread must listen for this session meanwhile.
    pub fn forward_wakeups(
        &self,
        look: Arc<dyn WakeCheck>,
        elsewhere: &Arc<SessionSegment>,
    ) -> ForwardedWakeups<'_> {
        self.doorbell.forward_wakeups(self.armed_words(), look, elsewhere.clone())
    }

    /// Declares that another thread calls [`notify`](Self::notify) when a process ends that might have rung.
    pub fn is_watched(&self) {
        self.doorbell.is_watched();
    }

    /// Makes every waiter of the session look again.
    #[inline]
    pub fn notify(&self) {
        if !self.is_forked() {
            self.doorbell.notify();
        }
    }

    /// Makes the listening thread, and through it the threads that follow it, look again. Async-signal-safe.
    #[inline]
    pub fn wake_listener(&self) {
        if !self.is_forked() {
            self.doorbell.ring_own();
        }
    }

    /// Lets an event loop lead the session's waits.
    ///
    /// # Errors
    /// The session has an external leader already, or this process is a fork of the session's.
    pub fn external_leader(self: &Arc<Self>) -> Result<ExternalLeader, ShmError> {
        if self.is_forked() {
            return Err(ShmError::Forked);
        }
        ExternalLeader::new(Arc::clone(self)).ok_or(ShmError::AlreadyLed(self.id))
    }

    /// Waits for space to publish; also checks again when one of `others` becomes readable.
    pub(crate) fn wait_for_room(
        &self,
        ready: impl FnMut() -> bool,
        others: &[BorrowedFd<'_>],
        timeout: Duration,
    ) -> bool {
        let words = self.armed_words();
        self.doorbell.wait(words, Purpose::Room, ready, None, others, Some(timeout))
    }

    #[inline]
    pub(crate) fn doorbell_hub(&self) -> &Doorbell {
        &self.doorbell
    }

    /// Returns the word in which a waiter for `purpose` stores its ticket.
    #[inline]
    pub fn armed_word(&self, purpose: Purpose) -> &AtomicU64 {
        &self.first.memory.words()[match purpose {
            Purpose::Samples => layout::session::ARMED,
            Purpose::Room => layout::session::BLOCKED,
        }]
    }

    #[inline]
    pub(crate) fn armed_words(&self) -> [&AtomicU64; 2] {
        [self.armed_word(Purpose::Samples), self.armed_word(Purpose::Room)]
    }

    #[inline]
    pub(crate) fn waits(&self, purpose: Purpose) -> bool {
        waits(self.armed_word(purpose), &self.rung[purpose as usize])
    }

    #[inline]
    pub(crate) fn ring_if(&self, purpose: Purpose) {
        if due(self.armed_word(purpose), &self.rung[purpose as usize]) {
            self.doorbell.ring_own();
        }
    }

    /// Returns whether the calling process is a fork of the session's.
    #[inline]
    pub fn is_forked(&self) -> bool {
        self.first.memory.is_forked()
    }

    pub(crate) fn free_lane(&self, lane: HeapObject) {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner).free.push(lane);
    }

    /// [Allocates](Heap::allocate) an object of the session.
    pub(crate) fn allocate(
        &self,
        len: u64,
        need: Need,
        mapped: impl Fn(u32) -> bool,
    ) -> Result<Option<HeapObject>, ShmError> {
        self.heap.allocate(&self.segments, len, need, mapped)
    }

    /// Prepares [space](Heap::foresee) for an object of the session.
    pub(crate) fn foresee(&self, len: u64) {
        self.heap.foresee(&self.segments, len);
    }

    pub(crate) fn release(&self, block: Block) {
        self.heap.release(block);
    }

    /// Returns the segments besides the first.
    pub(crate) fn further(&self) -> Vec<Arc<OwnSegment>> {
        self.segments.further()
    }

    /// Opens a segment for the large samples of a publisher.
    pub(crate) fn open_samples(&self, gid: Gid, bytes: u64) -> Result<Arc<OwnSegment>, ShmError> {
        self.segments.open(SegmentKind::Samples(gid), bytes)
    }

    /// Returns a segment of the session.
    pub(crate) fn own(&self, number: u32) -> Option<Arc<OwnSegment>> {
        self.segments.get(number)
    }

    /// Closes a segment of large samples that no reader reads any more.
    pub(crate) fn close_samples(&self, number: u32) {
        self.segments.close(number);
    }

    /// Reports an event to the session's owner.
    pub(crate) fn tell(&self, event: SegmentEvent<'_>) {
        self.segments.tell(event);
    }

    /// Keeps the memory of a dropped publisher for as long as it is read.
    pub(crate) fn adopt(&self, orphan: Orphan) {
        self.orphans.adopt(orphan);
        self.tidy_some();
    }

    pub(crate) fn map(&self, number: u32) -> Option<Arc<Map>> {
        if number == 0 {
            return Some(Arc::clone(self.first.map()));
        }
        self.segments.get(number).map(|segment| Arc::clone(segment.map()))
    }
}

impl WakeListener for SessionSegment {
    #[inline]
    fn wake_listener(&self) {
        self.wake_listener();
    }
}
