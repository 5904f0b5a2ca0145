//! The publishing end of a ring.

use std::{
    os::fd::OwnedFd,
    ptr::NonNull,
    sync::{Arc, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::{Duration, Instant},
};

use super::{
    Grant, Loan, Meta, Peer, PeerSession, PublishError, Published, ReaderInfo, RingOptions,
    SessionSegment, ShmError,
    area::Area,
    audience::Audience,
    history::History,
    layout::{self, COPIED, RingLayout},
    memory::Segment,
    ring::{self, Place, Record},
    room::{Committed, Refusal},
};
use crate::{
    ids::Gid,
    qos::History as Keep,
    wait::{Purpose, settle},
};

/// How long a publish waits for a KEEP_ALL reader.
pub(super) const PATIENCE: Duration = Duration::from_millis(100);
/// How often a publish looks for the reader that is in its way before it gives up on the answer.
pub(super) const LOOKS: u32 = 1000;
/// Slots of a ring at least; a subscription's depth counts up to this.
const SLOTS: u64 = 1024;
/// Slots of a ring that keeps all that fits in its budget.
const SLOTS_KEEP_ALL: u64 = 8192;

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
    pub(super) layout: RingLayout,
    session: Arc<SessionSegment>,
    pub(super) segment: Segment,
    state: Mutex<State>,
}

pub(super) struct State {
    pub(super) history: History,
    pub(super) audience: Audience,
    /// The tail as readers see it.
    pub(super) shown_tail: u64,
    /// Ends of the slots and of the two parts of the payload area that are backed by memory.
    pub(super) committed: Committed,
    /// Positions that were found pinned, kept for their memory.
    pub(super) found: Vec<u64>,
    /// The last sample's sequence number.
    last: u64,
}

/// How samples are numbered.
#[derive(Clone, Copy)]
pub(super) enum Numbering {
    /// As given.
    Given(Meta),
    /// One up from the last, with this source timestamp.
    Next(i64),
}

/// A sample's bytes on their way into a ring.
#[derive(Clone, Copy)]
pub(super) enum Payload<'a> {
    /// At most [`layout::COPIED`] bytes, copied in under the lock.
    Bytes(&'a [u8]),
    /// Written to memory that was lent: its offset and the sample's length.
    Written { at: u64, len: usize },
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
        let slots = match qos.history {
            Keep::KeepLast => (u64::from(qos.depth) + 1).max(SLOTS),
            Keep::KeepAll => SLOTS_KEEP_ALL,
        };
        let layout = RingLayout::new(slots, budget, max_message);
        let segment = Segment::create("axon-ring", layout.bytes())?;
        segment.commit(0, layout::ALIGN)?;
        layout.write(segment.words(), options.gid);
        let history =
            History::new(layout.slots(), layout.copied_bytes(), layout.payload_bytes(), budget);
        let state = State {
            audience: Audience::new(qos, history.capacity()),
            history,
            shown_tail: 0,
            committed: Committed::new(&layout),
            found: Vec::new(),
            last: 0,
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
        if self.segment.is_forked() {
            return Err(ShmError::Forked);
        }
        if reader.lane >= reader.peer.lanes() {
            return Err(ShmError::Refused { what: "it has no such lane" });
        }
        let mut state = self.lock();
        let State { audience, history, .. } = &mut *state;
        Ok(audience.attach(reader, history.tail(), history.head()))
    }

    /// Forgets a reader; false when it was not attached. The samples that it keeps it may keep.
    pub fn detach(&self, reader: Gid) -> bool {
        !self.segment.is_forked() && self.lock().audience.detach(reader)
    }

    /// Forgets the readers whose process has ended, and names them.
    pub fn drop_dead(&self) -> Vec<Gid> {
        if self.segment.is_forked() { Vec::new() } else { self.lock().audience.drop_dead() }
    }

    /// As [`drop_dead`](Self::drop_dead), and those that have left without a word.
    pub fn drop_gone(&self) -> Vec<Gid> {
        if self.segment.is_forked() { Vec::new() } else { self.lock().audience.drop_gone() }
    }

    /// The subscriptions that are attached; a relay shows as those that it stands for.
    pub fn readers(&self) -> Vec<Gid> {
        if self.segment.is_forked() { Vec::new() } else { self.lock().audience.readers() }
    }

    /// Whether any reader is attached.
    pub fn has_readers(&self) -> bool {
        !self.segment.is_forked() && !self.lock().audience.is_empty()
    }

    /// Publishes a sample. Where this publisher and a reader of another session are both RELIABLE
    /// and KEEP_ALL, waits up to 100 ms for the reader to make room; never otherwise.
    ///
    /// # Errors
    /// The sample was not published; what to do is in the error.
    pub fn publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        self.publish_within(Numbering::Given(meta), payload, PATIENCE)
            .map(|(_, published)| published)
    }

    /// As [`publish`](Self::publish), but does not wait: [`PublishError::Blocked`] at once.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn try_publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        let numbering = Numbering::Given(meta);
        self.publish_within(numbering, payload, Duration::ZERO).map(|(_, published)| published)
    }

    /// As [`publish`](Self::publish), with the sequence number that follows the last, which is
    /// returned.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_next(&self, source_timestamp: i64, payload: &[u8]) -> Result<u64, PublishError> {
        let numbering = Numbering::Next(source_timestamp);
        self.publish_within(numbering, payload, PATIENCE).map(|(sequence, _)| sequence)
    }

    /// As [`publish_next`](Self::publish_next), but does not wait.
    ///
    /// # Errors
    /// As [`try_publish`](Self::try_publish).
    pub fn try_publish_next(
        &self,
        source_timestamp: i64,
        payload: &[u8],
    ) -> Result<u64, PublishError> {
        let numbering = Numbering::Next(source_timestamp);
        self.publish_within(numbering, payload, Duration::ZERO).map(|(sequence, _)| sequence)
    }

    /// Lends `len` bytes to be written and then published: of the ring's own memory where it is
    /// more than 4 KiB. May wait as [`publish`](Self::publish) does.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        let bytes = self.check(len)?;
        if len as u64 <= COPIED {
            return Ok(Loan::copied(self, len));
        }
        let at = self.patiently(PATIENCE, |state| self.lend(state, bytes))?;
        Ok(Loan::placed(self, len, at))
    }

    fn publish_within(
        &self,
        numbering: Numbering,
        payload: &[u8],
        patience: Duration,
    ) -> Result<(u64, Published), PublishError> {
        let bytes = self.check(payload.len())?;
        if payload.len() as u64 <= COPIED {
            return self.commit(numbering, Payload::Bytes(payload), patience);
        }
        let start = Instant::now();
        let at = self.patiently(patience, |state| self.lend(state, bytes))?;
        // Copied outside the lock: nobody else knows of the place yet.
        let mut loan = Loan::placed(self, payload.len(), at);
        loan.copy_from_slice(payload);
        loan.commit(numbering, patience.saturating_sub(start.elapsed()))
    }

    /// Publishes what has been, or is here, copied in.
    pub(super) fn commit(
        &self,
        numbering: Numbering,
        payload: Payload<'_>,
        patience: Duration,
    ) -> Result<(u64, Published), PublishError> {
        // A loan may have been made before the fork.
        if self.segment.is_forked() {
            return Err(PublishError::Forked);
        }
        let (meta, position, peers) = self.patiently(patience, |state| {
            self.slot(state)?;
            let (len, place) = match payload {
                Payload::Bytes(bytes) if bytes.len() <= layout::INLINE => {
                    (bytes.len(), Place::Inline)
                }
                Payload::Bytes(bytes) => (bytes.len(), Place::At(self.copy_in(state, bytes)?)),
                Payload::Written { at, len } => (len, Place::At(at)),
            };
            let meta = match numbering {
                Numbering::Given(meta) => meta,
                Numbering::Next(source_timestamp) => {
                    Meta { sequence: state.last + 1, source_timestamp }
                }
            };
            state.last = meta.sequence;
            let position = self.show(state, meta, len, place, payload);
            Ok((meta, position, state.audience.peers()))
        })?;
        announce(&peers);
        Ok((meta.sequence, Published { position }))
    }

    fn show(
        &self,
        state: &mut State,
        meta: Meta,
        len: usize,
        place: Place,
        payload: Payload<'_>,
    ) -> u64 {
        let extent = match place {
            Place::Inline => None,
            Place::At(at) => Some((at, Area::rounded(len as u64))),
        };
        let inline = match (place, payload) {
            (Place::Inline, Payload::Bytes(bytes)) => bytes,
            _ => &[],
        };
        let position = state.history.push(extent);
        let record = Record {
            sequence: meta.sequence,
            timestamp: meta.source_timestamp,
            len: u32::try_from(len).expect("no longer than the largest message"),
            place,
        };
        ring::about_to_write::<AtomicU64>();
        let geometry = self.layout.geometry();
        ring::publish(self.segment.words(), &geometry, position, &record, inline);
        position
    }

    pub(super) fn give_back(&self, at: u64, len: usize) {
        self.lock().history.give_back(at, Area::rounded(len as u64));
    }

    pub(super) fn is_forked(&self) -> bool {
        self.segment.is_forked()
    }

    /// The bytes of a loan.
    pub(super) fn lent(&self, at: u64, len: usize) -> NonNull<u8> {
        self.segment.bytes(self.layout.payload_at() + at, len)
    }

    fn check(&self, len: usize) -> Result<u64, PublishError> {
        if self.segment.is_forked() {
            return Err(PublishError::Forked);
        }
        let (len, max) = (len as u64, self.options.max_message);
        if len > max { Err(PublishError::TooLarge { len, max }) } else { Ok(Area::rounded(len)) }
    }

    /// Tries until it works or `patience` is at its end. The lock is not held in between.
    fn patiently<T>(
        &self,
        patience: Duration,
        mut attempt: impl FnMut(&mut State) -> Result<T, Refusal>,
    ) -> Result<T, PublishError> {
        let mut deadline = None;
        for look in 0u32.. {
            let laggards = {
                let mut state = self.lock();
                match attempt(&mut state) {
                    Ok(done) => return Ok(done),
                    Err(Refusal::Error(error)) => return Err(error),
                    Err(Refusal::Held) => {}
                }
                let State { history, audience, .. } = &mut *state;
                audience.laggards(history.tail(), history.head())
            };
            let now = Instant::now();
            let left = deadline.get_or_insert(now + patience).saturating_duration_since(now);
            match laggards {
                Some((reader, _)) if left.is_zero() => {
                    return Err(PublishError::Blocked { reader });
                }
                Some((_, peers)) => self.await_room(&peers, left),
                // It moved on between the two looks. One that does so for ever is out for trouble.
                None if left.is_zero() && look >= LOOKS => {
                    return Err(PublishError::Blocked { reader: self.options.gid });
                }
                None => {}
            }
        }
        unreachable!("the deadline comes first")
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

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
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
