//! The publishing end of a ring.

use std::{
    os::fd::OwnedFd,
    sync::{Arc, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::{Duration, Instant},
};

use super::{
    Loan, Peer, PeerSession, PublishError, SessionSegment, ShmError,
    area::Area,
    audience::Audience,
    headroom,
    history::{Full, History},
    layout::{self, RingLayout},
    memory::Segment,
    ring::{self, Place, Record},
};
use crate::{
    ids::Gid,
    qos::{History as Keep, Qos},
    wait::{Purpose, settle},
};

/// How long a publish waits for a KEEP_ALL reader.
const PATIENCE: Duration = Duration::from_millis(100);
/// Slots of a ring at least; a subscription's depth counts up to this.
const SLOTS: u64 = 1024;
/// Slots of a ring that keeps all that fits in its budget.
const SLOTS_KEEP_ALL: u64 = 8192;

/// What a ring is made for.
#[derive(Clone, Copy, Debug)]
pub struct RingOptions {
    /// The publisher.
    pub gid: Gid,
    /// What it offers.
    pub qos: Qos,
    /// Bytes of samples to keep before the oldest go; one sample is always kept.
    pub budget: u64,
    /// The largest sample in bytes.
    pub max_message: u64,
}

/// A reader that wants to attach.
#[derive(Clone)]
pub struct ReaderInfo {
    /// The subscription.
    pub gid: Gid,
    /// Its lane in its session's segment.
    pub lane: u32,
    /// What it requests.
    pub qos: Qos,
    /// Its session.
    pub peer: Peer,
    /// The remote subscriptions that it stands for when it is a relay.
    pub stands_for: Vec<Gid>,
}

/// What a reader is given when it attaches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grant {
    /// Names this attachment; never 0.
    pub generation: u64,
    /// The first position that the reader takes.
    pub first: u64,
}

/// What goes with a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Meta {
    /// The publisher's sequence number.
    pub sequence: u64,
    /// When it was published, in nanoseconds since the Unix epoch.
    pub source_timestamp: i64,
}

/// A sample that was published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Published {
    /// Its position in the ring, counted from 0 without gaps.
    pub position: u64,
}

/// A publisher's ring. All methods may be called from any thread.
///
/// Readers keep the ring mapped after it is dropped and drain what it holds.
///
/// ```
/// use axon_transport::{
///     ids::{Gid, SessionId},
///     qos::Qos,
///     shm::{Meta, Peer, Reader, ReaderInfo, ReaderOptions, RingOptions, SessionSegment, Writer},
/// };
///
/// let id = SessionId::random();
/// let session = SessionSegment::create(id)?;
/// let (writer_gid, reader_gid) = (Gid::new(id, 1), Gid::new(id, 2));
/// let options = RingOptions {
///     gid: writer_gid,
///     qos: Qos::default(),
///     budget: 1 << 20,
///     max_message: 1 << 20,
/// };
/// let writer = Writer::create(session.clone(), options)?;
///
/// let lane = session.allocate_lane()?;
/// let peer = Peer::Local(session.clone());
/// let grant = writer.attach(ReaderInfo {
///     gid: reader_gid,
///     lane: lane.index(),
///     qos: Qos::default(),
///     peer: peer.clone(),
///     stands_for: Vec::new(),
/// })?;
/// let mut reader = Reader::map(
///     writer.descriptor()?,
///     ReaderOptions {
///         reader: reader_gid,
///         writer: writer_gid,
///         peer,
///         lane,
///         grant,
///         qos: Qos::default(),
///         max_message: 1 << 20,
///     },
/// )?;
///
/// writer.publish(Meta { sequence: 1, source_timestamp: 0 }, b"hello")?;
/// let mut payload = Vec::new();
/// let taken = reader.take(&mut payload)?.expect("a sample");
/// assert_eq!((taken.meta.sequence, &payload[..]), (1, &b"hello"[..]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Writer {
    options: RingOptions,
    layout: RingLayout,
    session: Arc<SessionSegment>,
    segment: Segment,
    state: Mutex<State>,
}

pub(super) struct State {
    pub(super) history: History,
    audience: Audience,
    /// The tail as readers see it.
    shown_tail: u64,
    /// Ends of the slots and of the payload area that are backed by memory.
    committed: [u64; 2],
}

/// Why an attempt to publish did not succeed.
pub(super) enum Refusal {
    /// A KEEP_ALL reader holds the oldest sample.
    Held,
    Error(PublishError),
}

impl From<PublishError> for Refusal {
    fn from(error: PublishError) -> Self {
        Self::Error(error)
    }
}

impl From<Full> for Refusal {
    fn from(full: Full) -> Self {
        match full {
            Full::Held => Self::Held,
            Full::Loaned(loans) => Self::Error(PublishError::Loaned { loans }),
        }
    }
}

impl Writer {
    /// Makes a ring. Its memory is taken as samples need it.
    ///
    /// # Errors
    /// The options exceed what a ring may take, or memory or descriptors are short.
    pub fn create(session: Arc<SessionSegment>, options: RingOptions) -> Result<Self, ShmError> {
        if session.is_forked() {
            return Err(ShmError::Forked);
        }
        let RingOptions { qos, budget, max_message, .. } = options;
        if max_message > layout::MAX_MESSAGE || budget > layout::MAX_BUDGET {
            return Err(ShmError::TooLarge { max_message, budget });
        }
        // Twice the budget, so that pieces between samples seldom shorten the history; room for
        // four of the largest, so that one of them always fits beside one that stands.
        let area = (4 * Area::rounded(max_message)).max(2 * budget);
        let slots = match qos.history {
            Keep::KeepLast => (u64::from(qos.depth) + 1).max(SLOTS),
            Keep::KeepAll => SLOTS_KEEP_ALL,
        };
        let layout = RingLayout::new(slots, area);
        let segment = Segment::create("axon-ring", layout.bytes())?;
        segment.commit(0, layout::ALIGN)?;
        layout.write(segment.words(), options.gid);
        let history = History::new(layout.slots(), layout.payload_bytes(), budget);
        let state = State {
            audience: Audience::new(qos, history.capacity()),
            history,
            shown_tail: 0,
            committed: [layout::ALIGN, layout.payload_at()],
        };
        Ok(Self { options, layout, session, segment, state: Mutex::new(state) })
    }

    /// The publisher's GID.
    pub fn gid(&self) -> Gid {
        self.options.gid
    }

    /// A duplicate of the ring's descriptor, for readers.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn descriptor(&self) -> Result<OwnedFd, ShmError> {
        self.segment
            .fd()
            .try_clone_to_owned()
            .map_err(|source| ShmError::System { what: "duplicating a descriptor", source })
    }

    /// Adds a reader, or answers with the grant that stands when it is attached by the same lane.
    ///
    /// # Errors
    /// Its session has no such lane.
    pub fn attach(&self, reader: ReaderInfo) -> Result<Grant, ShmError> {
        if reader.lane >= reader.peer.lanes() {
            return Err(ShmError::Refused { what: "it has no such lane" });
        }
        let mut state = self.lock();
        let State { audience, history, .. } = &mut *state;
        Ok(audience.attach(reader, history.tail(), history.head()))
    }

    /// Forgets a reader; false when it was not attached.
    pub fn detach(&self, reader: Gid) -> bool {
        self.lock().audience.detach(reader)
    }

    /// Forgets the readers whose process has ended, and names them.
    pub fn drop_dead(&self) -> Vec<Gid> {
        self.lock().audience.drop_dead()
    }

    /// The subscriptions that are attached; a relay shows as those that it stands for.
    pub fn readers(&self) -> Vec<Gid> {
        self.lock().audience.readers()
    }

    /// Whether any reader is attached.
    pub fn has_readers(&self) -> bool {
        !self.lock().audience.is_empty()
    }

    /// Publishes a sample. Where this publisher and a reader of another session are both RELIABLE
    /// and KEEP_ALL, waits up to 100 ms for the reader to make room; never otherwise.
    ///
    /// # Errors
    /// The sample was not published; what to do is in the error.
    pub fn publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        self.publish_within(meta, payload, PATIENCE)
    }

    /// As [`publish`](Self::publish), but does not wait: [`PublishError::Blocked`] at once.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn try_publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        self.publish_within(meta, payload, Duration::ZERO)
    }

    /// Lends `len` bytes of the ring to be written in place and then published. May wait as
    /// [`publish`](Self::publish) does.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        let bytes = self.check(len)?;
        if len <= layout::INLINE {
            return Ok(Loan::inline(self, len));
        }
        let at = self.patiently(PATIENCE, |state| self.reserve(state, bytes))?;
        Ok(Loan::placed(self, len, at))
    }

    fn publish_within(
        &self,
        meta: Meta,
        payload: &[u8],
        patience: Duration,
    ) -> Result<Published, PublishError> {
        let bytes = self.check(payload.len())?;
        let (position, peers) = self.patiently(patience, |state| {
            self.slot(state)?;
            if payload.len() <= layout::INLINE {
                return Ok(self.commit(state, meta, payload.len(), None, payload));
            }
            let at = self.reserve(state, bytes)?;
            ring::about_to_write::<AtomicU64>();
            ring::copy_in(self.payload(at, bytes), payload);
            Ok(self.commit(state, meta, payload.len(), Some(at), &[]))
        })?;
        announce(&peers);
        Ok(Published { position })
    }

    /// Publishes what a loan holds.
    pub(super) fn publish_loan(
        &self,
        meta: Meta,
        len: usize,
        at: Option<u64>,
        inline: &[u8],
    ) -> Result<Published, PublishError> {
        let (position, peers) = self.patiently(PATIENCE, |state| {
            self.slot(state)?;
            Ok(self.commit(state, meta, len, at, inline))
        })?;
        announce(&peers);
        Ok(Published { position })
    }

    pub(super) fn unreserve(&self, at: u64, len: usize) {
        self.lock().history.unreserve(at, Area::rounded(len as u64));
    }

    /// The words of `len` bytes at `at` of the payload area.
    pub(super) fn payload(&self, at: u64, len: u64) -> &[AtomicU64] {
        self.layout
            .geometry()
            .payload(self.segment.words(), at, len)
            .expect("what was allocated lies inside the area")
    }

    fn check(&self, len: usize) -> Result<u64, PublishError> {
        if self.segment.is_forked() {
            return Err(PublishError::Forked);
        }
        let (len, max) = (len as u64, self.options.max_message);
        if len > max { Err(PublishError::TooLarge { len, max }) } else { Ok(Area::rounded(len)) }
    }

    /// Makes sure that the next position has a slot.
    fn slot(&self, state: &mut State) -> Result<(), Refusal> {
        let State { history, audience, .. } = state;
        let floors = audience.floors(history.head());
        history.release_below(floors.retained);
        history.slot(|position| position < floors.held)?;
        let end = self.layout.slot_end(history.head());
        self.back(&mut state.committed[0], end, self.layout.payload_at())?;
        self.show_tail(state);
        Ok(())
    }

    /// Takes `bytes` of the payload area.
    fn reserve(&self, state: &mut State, bytes: u64) -> Result<u64, Refusal> {
        let State { history, audience, .. } = state;
        let floors = audience.floors(history.head());
        history.release_below(floors.retained);
        let at = history.reserve(bytes, |position| position < floors.held)?;
        let end = self.layout.payload_at() + at + bytes;
        if let Err(error) = self.back(&mut state.committed[1], end, self.layout.bytes()) {
            state.history.unreserve(at, bytes);
            return Err(error.into());
        }
        self.show_tail(state);
        Ok(at)
    }

    /// Backs the segment with memory up to `end`, a little further when it keeps growing.
    fn back(&self, committed: &mut u64, end: u64, limit: u64) -> Result<(), PublishError> {
        if end <= *committed {
            return Ok(());
        }
        let upto = end.max(*committed + *committed / 8).next_multiple_of(layout::ALIGN).min(limit);
        self.segment.commit(*committed, upto).map_err(|error| match error {
            ShmError::NoMemory { needed, available } => {
                PublishError::NoMemory { needed, available }
            }
            _ => PublishError::NoMemory {
                needed: upto - *committed,
                available: headroom::available().unwrap_or(0),
            },
        })?;
        *committed = upto;
        Ok(())
    }

    fn show_tail(&self, state: &mut State) {
        if state.shown_tail != state.history.tail() {
            state.shown_tail = state.history.tail();
            ring::retire(self.segment.words(), &self.layout.geometry(), state.shown_tail);
        }
    }

    fn commit(
        &self,
        state: &mut State,
        meta: Meta,
        len: usize,
        at: Option<u64>,
        inline: &[u8],
    ) -> (u64, Arc<[Peer]>) {
        let position = state.history.push(at.map(|at| (at, Area::rounded(len as u64))));
        let record = Record {
            sequence: meta.sequence,
            timestamp: meta.source_timestamp,
            len: u32::try_from(len).expect("no longer than the largest message"),
            place: at.map_or(Place::Inline, Place::At),
        };
        ring::about_to_write::<AtomicU64>();
        let geometry = self.layout.geometry();
        ring::publish(self.segment.words(), &geometry, position, &record, inline);
        (position, state.audience.peers())
    }

    /// Tries until it works or `patience` is at its end. The lock is not held in between.
    fn patiently<T>(
        &self,
        patience: Duration,
        mut attempt: impl FnMut(&mut State) -> Result<T, Refusal>,
    ) -> Result<T, PublishError> {
        let mut deadline = None;
        loop {
            let (reader, laggards) = {
                let mut state = self.lock();
                match attempt(&mut state) {
                    Ok(done) => return Ok(done),
                    Err(Refusal::Error(error)) => return Err(error),
                    Err(Refusal::Held) => {}
                }
                let State { history, audience, .. } = &mut *state;
                match audience.laggards(history.tail(), history.head()) {
                    // It moved on meanwhile.
                    None => continue,
                    Some(found) => found,
                }
            };
            let now = Instant::now();
            let left = deadline.get_or_insert(now + patience).saturating_duration_since(now);
            if left.is_zero() {
                return Err(PublishError::Blocked { reader });
            }
            self.await_room(&laggards, left);
        }
    }

    fn await_room(&self, laggards: &[Arc<PeerSession>], left: Duration) {
        let ready = || {
            let mut state = self.lock();
            let State { history, audience, .. } = &mut *state;
            audience.floors(history.head()).held > history.tail()
                || laggards.iter().any(|peer| peer.is_dead())
        };
        let pidfds: Vec<_> = laggards.iter().map(|peer| peer.pidfd()).collect();
        self.session.wait_for_room(ready, &pidfds, left);
        self.lock().audience.mark_dead();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Wakes those that sleep: a system call for each session that does, none for the others.
fn announce(peers: &[Peer]) {
    settle::<AtomicU64>();
    for peer in peers {
        peer.ring_if(Purpose::Samples);
    }
}
