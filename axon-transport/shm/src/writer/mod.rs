//! The publishing end of a ring.

mod attached;
mod commit;
mod delivery;
pub(crate) mod departed_readers;
mod header;
pub(crate) mod history;
pub(crate) mod loan;
mod numbers;
pub(crate) mod reader_set;
pub(crate) mod reclaim;
pub(crate) mod samples;
mod state;

use std::{sync::Arc, time::Duration};

pub(super) use self::{
    commit::{PublishDeadline, WakeTiming},
    numbers::Numbering,
    state::WriterState,
};
pub use self::{departed_readers::CarrierState, numbers::MAX_GAP};

use crate::{
    alloc::{
        area::Area,
        budget::{Holding, MemoryBudget},
        heap::{HeapObject, Need},
        pin_limit::PinPool,
    },
    error::{PublishError, ShmError},
    ids::Gid,
    os::pi_mutex::{PiGuard, PiMutex},
    qos::History as Keep,
    ring::{
        layout::{self, ALIGNED, Array, COPIED, COPIED_ALWAYS, Location},
        protocol,
        times::{Times, offer},
        types::{Grant, Meta, Published, RingOptions},
        window::keeps_all,
    },
    session::{
        orphans::Orphan,
        reader_info::{ReaderInfo, Terms},
        segment::SessionSegment,
    },
    writer::{
        header::RingHeader,
        history::SampleHistory,
        loan::{Lender, Loan},
        reader_set::ReaderSet,
    },
};

/// Maximum time that a publish waits for a KEEP_ALL reader.
pub(super) const KEEP_ALL_PUBLISH_TIMEOUT: Duration = Duration::from_millis(100);
/// Maximum number of times that a publish looks for the reader that blocks it before it gives up.
pub(super) const LOOKS: u32 = 1000;
/// Maximum number of descriptors to which a ring grows for its readers' depths.
const DESCRIPTORS: u64 = 1 << 14;
/// Maximum number of descriptors to which a ring grows for its own depth, whatever that is: they do not count in its
/// budget.
const DESCRIPTORS_KEEP_LAST: u64 = 1 << 18;
/// Maximum number of descriptors of a ring that keeps all samples only until its readers have them: beyond that, it
/// holds its publisher back.
const DESCRIPTORS_KEEP_ALL: u64 = 1 << 13;

/// A publisher's ring. All methods may be called from any thread.
///
/// Readers keep the ring mapped after it is dropped and drain its samples.
///
/// ```
/// use axon_shm::{
///     Meta,
///     ids::{Gid, SessionId},
///     internal::{RingPeer, Reader, ReaderInfo, ReaderOptions, RingOptions, SessionSegment, Writer},
///     qos::Qos,
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
///     expected: 0,
/// };
/// let writer = Writer::create(session.clone(), options)?;
///
/// let lane = session.allocate_lane()?;
/// let peer = RingPeer::Local(session.clone());
/// let grant = writer.attach(ReaderInfo {
///     gid: reader_gid,
///     lane: lane.location(),
///     qos: Qos::default(),
///     peer: peer.clone(),
///     stands_for: None,
/// })?;
/// let mut reader = Reader::map(ReaderOptions {
///     reader: reader_gid,
///     writer: writer_gid,
///     peer,
///     ring: writer.location(),
///     lane,
///     grant,
///     qos: Qos::default(),
///     max_message: 1 << 20,
/// })?;
///
/// writer.publish(Meta::at_nanos(1, 0), b"hello")?;
/// let mut payload = Vec::new();
/// let taken = reader.take(&mut payload)?.expect("a sample");
/// assert_eq!((taken.meta.sequence, &payload[..]), (1, &b"hello"[..]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Writer {
    options: RingOptions,
    pub(super) session: Arc<SessionSegment>,
    pub(super) header: RingHeader,
    /// The ring's number in the session's journal.
    pub(super) number: u32,
    /// Maximum number of descriptors.
    pub(super) limit: u64,
    state: PiMutex<WriterState>,
}

/// Returns the number of descriptors that a ring needs if it keeps everything that fits in `budget`: a sample takes at
/// least one.
fn most_descriptors(budget: u64) -> u64 {
    (budget / layout::DESCRIPTOR).max(layout::FIRST_DESCRIPTORS).next_power_of_two()
}

/// A sample's bytes on their way into a ring.
#[derive(Clone, Copy)]
pub(super) enum RingPayload<'a> {
    /// At most [`COPIED`] bytes, copied in under the lock.
    Bytes(&'a [u8]),
    /// Written to lent memory: its location, the offset of the sample, the sample's length, and the lent length.
    Written { at: Location, lead: usize, len: usize, lent: usize },
}

impl Writer {
    /// Creates a ring. It takes memory as samples need it.
    ///
    /// # Errors
    /// The options exceed the limits of a ring, or memory or descriptors are short.
    pub fn create(session: Arc<SessionSegment>, options: RingOptions) -> Result<Self, ShmError> {
        if session.is_forked() {
            return Err(ShmError::Forked);
        }
        let RingOptions { qos, budget, max_message, expected, .. } = options;
        if max_message > layout::MAX_MESSAGE || budget > layout::MAX_BUDGET {
            return Err(ShmError::TooLarge { max_message, budget });
        }
        session.tidy_some();
        let limit = match qos.history {
            Keep::KeepLast => (u64::from(qos.depth) + 1)
                .next_power_of_two()
                .clamp(DESCRIPTORS, DESCRIPTORS_KEEP_LAST),
            Keep::KeepAll if keeps_all(&qos) => most_descriptors(budget),
            Keep::KeepAll => DESCRIPTORS_KEEP_ALL,
        }
        .min(layout::MAX_DESCRIPTORS);
        // Readers learn of the segments together with the ring.
        let allocate = |len| {
            let object = session.allocate(len, Need::Now, |_| true)?;
            Ok::<HeapObject, ShmError>(object.expect("there is always one that will do"))
        };
        let ring = allocate(layout::RING)?;
        let descriptors = layout::FIRST_DESCRIPTORS;
        let array = match allocate(descriptors * layout::DESCRIPTOR) {
            Ok(array) => array,
            Err(error) => {
                session.release(ring.block);
                return Err(error);
            }
        };
        protocol::copy_descriptors(array.words(), array.words(), 0, 0);
        let at = Array { at: array.block.at, descriptors };
        let number = session.number_ring();
        layout::write_ring(ring.words(), options.gid, number, &at);
        offer(ring.words(), &options.qos);
        let mut history = SampleHistory::new(descriptors, budget);
        if keeps_all(&qos) {
            history.count_descriptors();
        }
        let reader_set = ReaderSet::new(qos, limit - 1, PinPool::new(budget, max_message));
        let state = WriterState::new(reader_set, history, array);
        let (header, state) = (RingHeader::new(ring), PiMutex::new(state)?);
        let writer = Self { options, session, header, number, limit, state };
        writer.header.add_bytes(layout::RING + descriptors * layout::DESCRIPTOR);
        writer.header.show_window(writer.lock().reader_set.window());
        if expected > COPIED_ALWAYS {
            writer.open_samples(&mut writer.lock())?;
        }
        Ok(writer)
    }

    /// Like [`create`](Self::create), for requests or responses: the ring gives up no sample that is within the depth
    /// of a KEEP_LAST reader in another session.
    pub fn create_for_calls(
        session: Arc<SessionSegment>,
        options: RingOptions,
    ) -> Result<Self, ShmError> {
        let writer = Self::create(session, options)?;
        writer.lock().reader_set.enforce_depths();
        Ok(writer)
    }

    /// Makes the ring share a memory bound with others: from then on it takes the memory for its samples from `budget`,
    /// beside its first descriptors. If the budget is used up, the ring manages with the memory that it has, like a
    /// ring on a host without free memory; but then its newest sample replaces even the last kept one.
    pub fn share(&self, budget: &Arc<MemoryBudget>) {
        if !self.is_forked() {
            self.lock().holding = Holding::of(Arc::clone(budget));
        }
    }

    /// Returns the publisher's GID.
    #[inline]
    pub fn gid(&self) -> Gid {
        self.options.gid
    }

    /// Returns the ring's location in its session's memory, for readers.
    #[inline]
    pub fn location(&self) -> Location {
        self.header.block().at
    }

    /// Adds a reader. If it is attached by the same lane already, returns its current grant.
    ///
    /// # Errors
    /// The reader's session has no such lane, or its process has as many readers of this publisher as it may.
    pub fn attach(&self, reader: ReaderInfo) -> Result<Grant, ShmError> {
        Ok(self.attach_on(reader, Terms::default())?.0)
    }

    /// Like [`attach`](Self::attach), on a reader's terms: a reader that was attached before continues with the kept
    /// samples behind the ones that it has. Also returns the number of the sample in front of the first that it is
    /// granted.
    ///
    /// # Errors
    /// As for [`attach`](Self::attach).
    pub fn attach_on(&self, reader: ReaderInfo, terms: Terms) -> Result<(Grant, u64), ShmError> {
        if self.is_forked() {
            return Err(ShmError::Forked);
        }
        let lane = reader.peer.lane(reader.lane)?;
        let mut state = self.lock();
        let resumed = terms.after.map(|after| state.position_after(after));
        let WriterState { reader_set, history, .. } = &mut *state;
        let (tail, head) = (history.tail(), history.head());
        let granted = reader_set.attach(reader, lane, tail, head, resumed, terms.carries);
        self.header.show_window(state.reader_set.window());
        granted.map(|grant| (grant, state.number_before(grant.first)))
    }

    /// Forgets a reader. Returns false if it was not attached. The reader may keep the samples that it holds.
    pub fn detach(&self, reader: Gid) -> bool {
        !self.is_forked() && self.change(|reader_set, head| reader_set.detach(reader, head))
    }

    /// Forgets the readers whose process has ended, and returns them.
    pub fn drop_dead(&self) -> Vec<Gid> {
        if self.is_forked() { Vec::new() } else { self.change(ReaderSet::drop_dead) }
    }

    /// Like [`drop_dead`](Self::drop_dead), for readers that have left without a message as well.
    pub fn drop_gone(&self) -> Vec<Gid> {
        if self.is_forked() { Vec::new() } else { self.change(ReaderSet::drop_gone) }
    }

    fn change<T>(&self, by: impl FnOnce(&mut ReaderSet, u64) -> T) -> T {
        let mut state = self.lock();
        // If this drops the last reference to a session, the session is unmapped after the lock, not under it.
        let peers = state.reader_set.peers();
        let WriterState { reader_set, history, .. } = &mut *state;
        let changed = by(reader_set, history.head());
        self.header.show_window(state.reader_set.window());
        drop(state);
        drop(peers);
        changed
    }

    /// Returns the attached subscriptions; a relay counts as the subscriptions that it stands for.
    pub fn readers(&self) -> Vec<Gid> {
        if self.is_forked() { Vec::new() } else { self.lock().reader_set.readers() }
    }

    /// Counts the attached subscriptions as [`readers`](Self::readers) lists them. Allocates nothing.
    pub fn reader_count(&self) -> usize {
        if self.is_forked() { 0 } else { self.lock().reader_set.reader_count() }
    }

    /// Returns whether any reader is attached.
    #[inline]
    pub fn has_readers(&self) -> bool {
        !self.is_forked() && !self.lock().reader_set.is_empty()
    }

    /// Returns whether it keeps samples for a reader whose process ended and that may come back through another
    /// process.
    pub fn has_absent_readers(&self) -> bool {
        !self.is_forked() && self.lock().reader_set.has_absent()
    }

    /// Returns why samples are kept for this reader, which carries them to another process; `None` for any other
    /// reader.
    pub fn carried(&self, reader: &Gid) -> Option<CarrierState> {
        if self.is_forked() {
            return None;
        }
        self.change(|reader_set, head| reader_set.carried(reader, head))
    }

    /// If no reader would read a sample, now or later, uses up the next sequence number as if a sample had been
    /// published, and returns it; otherwise returns `None`. A caller that has to serialize first can save the work.
    ///
    /// # Errors
    /// The process forked.
    pub fn skip_unread(&self) -> Result<Option<u64>, PublishError> {
        if self.is_forked() {
            return Err(PublishError::Forked);
        }
        let mut state = self.lock();
        Ok(self.is_unread(&state).then(|| self.pass(&mut state, Numbering::Next(0)).sequence))
    }

    /// Publishes a sample. If this publisher and a reader of another session are both RELIABLE and KEEP_ALL, waits up
    /// to 100 ms for the reader to free space; never waits otherwise.
    ///
    /// # Errors
    /// The sample was not published; the error says what to do.
    #[inline]
    pub fn publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        self.publish_within(
            Numbering::Given(meta),
            payload,
            KEEP_ALL_PUBLISH_TIMEOUT,
            WakeTiming::Now,
        )
        .map(|(_, published)| published)
    }

    /// Like [`publish`](Self::publish), but does not wait: [`PublishError::Blocked`] at once.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn try_publish(&self, meta: Meta, payload: &[u8]) -> Result<Published, PublishError> {
        let numbering = Numbering::Given(meta);
        self.publish_within(numbering, payload, Duration::ZERO, WakeTiming::Now)
            .map(|(_, published)| published)
    }

    /// Like [`try_publish`](Self::try_publish), but a sleeping reader may sleep on until the publisher
    /// [announces](Self::announce) its samples: for several samples that are published together.
    ///
    /// # Errors
    /// As for [`try_publish`](Self::try_publish).
    #[inline]
    pub fn try_publish_quietly(
        &self,
        meta: Meta,
        payload: &[u8],
    ) -> Result<Published, PublishError> {
        let numbering = Numbering::Given(meta);
        self.publish_within(numbering, payload, Duration::ZERO, WakeTiming::Later)
            .map(|(_, published)| published)
    }

    /// Like [`publish`](Self::publish), with the sequence number after the last. Returns it.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn publish_next(&self, source_timestamp: i64, payload: &[u8]) -> Result<u64, PublishError> {
        let numbering = Numbering::Next(source_timestamp);
        self.publish_within(numbering, payload, KEEP_ALL_PUBLISH_TIMEOUT, WakeTiming::Now)
            .map(|(sequence, _)| sequence)
    }

    /// Like [`publish_next`](Self::publish_next), but does not wait.
    ///
    /// # Errors
    /// As for [`try_publish`](Self::try_publish).
    #[inline]
    pub fn try_publish_next(
        &self,
        source_timestamp: i64,
        payload: &[u8],
    ) -> Result<u64, PublishError> {
        let numbering = Numbering::Next(source_timestamp);
        self.publish_within(numbering, payload, Duration::ZERO, WakeTiming::Now)
            .map(|(sequence, _)| sequence)
    }

    /// Records that a sample was published at `now`.
    #[inline]
    pub fn note_sample(&self, now: u64) {
        if !self.is_forked() {
            self.header.note_sample(now);
        }
    }

    /// Asserts the publisher's liveliness at `now`.
    #[inline]
    pub fn assert(&self, now: u64) {
        if !self.is_forked() {
            self.header.assert(now);
        }
    }

    /// Returns the times that its readers see.
    pub fn times(&self) -> Times {
        if self.is_forked() { Times::default() } else { self.header.times() }
    }

    /// Lends `len` bytes to be written and then published: shared memory if it is more than 4 KiB, or more than 512
    /// bytes if so many are [expected](RingOptions::expected). May wait as [`publish`](Self::publish) does.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn loan(&self, len: usize) -> Result<Loan<'_>, PublishError> {
        self.loan_behind(0, len)
    }

    /// Like [`loan`](Self::loan); the bytes after the header are 16-byte aligned.
    ///
    /// # Errors
    /// As for [`publish`](Self::publish).
    #[inline]
    pub fn loan_behind(&self, header: usize, len: usize) -> Result<Loan<'_>, PublishError> {
        self.lend_to(Lender::Borrowed(self), header, len)
    }

    /// Like [`loan_behind`](Self::loan_behind), for a caller that keeps the writer with the loan.
    #[inline]
    pub fn loan_owned(
        self: &Arc<Self>,
        header: usize,
        len: usize,
    ) -> Result<Loan<'static>, PublishError> {
        self.lend_to(Lender::Shared(Arc::clone(self)), header, len)
    }

    /// Returns the longest loan in bytes that is copied after all.
    #[inline]
    pub(super) fn longest_copied(&self) -> u64 {
        if self.options.expected > COPIED_ALWAYS { COPIED_ALWAYS } else { COPIED }
    }

    fn lend_to<'a>(
        &self,
        lender: Lender<'a>,
        header: usize,
        len: usize,
    ) -> Result<Loan<'a>, PublishError> {
        self.check(len)?;
        let lead = header.wrapping_neg() % ALIGNED;
        if len as u64 <= self.longest_copied() {
            return Ok(Loan::copied(lender, lead, len));
        }
        let bytes = Area::rounded((lead + len) as u64);
        let place = self
            .retry_until(&mut PublishDeadline::new(KEEP_ALL_PUBLISH_TIMEOUT), |state| {
                self.lend(state, bytes)
            })?;
        Ok(Loan::placed(lender, lead, len, place))
    }

    pub(super) fn give_back(&self, at: Location, len: usize) {
        self.lock().history.give_back(at, Area::rounded(len as u64));
    }

    #[inline]
    pub(super) fn is_forked(&self) -> bool {
        self.session.is_forked()
    }

    #[inline]
    pub(super) fn options(&self) -> &RingOptions {
        &self.options
    }

    fn check(&self, len: usize) -> Result<u64, PublishError> {
        if self.is_forked() {
            return Err(PublishError::Forked);
        }
        let (len, max) = (len as u64, self.options.max_message);
        if len > max { Err(PublishError::TooLarge { len, max }) } else { Ok(Area::rounded(len)) }
    }

    #[inline]
    pub(super) fn lock(&self) -> PiGuard<'_, WriterState> {
        self.state.lock()
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        // A forked child must not free the parent's memory.
        if self.is_forked() {
            return;
        }
        let WriterState { mut history, array, reader_set, holding, .. } = {
            let mut state = self.lock();
            let nobody = ReaderSet::new(self.options.qos, 0, PinPool::default());
            let empty = WriterState::new(nobody, SampleHistory::new(1, 0), self.header.object());
            std::mem::replace(&mut *state, empty)
        };
        // Readers drain the kept samples. After that no process reads the memory.
        let mut blocks = vec![*self.header.block(), array.block];
        blocks.extend(history.all_blocks());
        let samples = history.pinned().segments().collect();
        let (pin_lanes, head) = (reader_set.into_pin_lanes(), history.head());
        self.session.adopt(Orphan { pin_lanes, head, blocks, samples, _holding: holding });
    }
}
