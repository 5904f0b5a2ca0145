//! Publishing: numbers a sample, writes its descriptor into the ring and rings the doorbells of its
//! readers.

use std::{
    sync::{Arc, atomic::AtomicU64},
    time::{Duration, Instant},
};

use super::{LOOKS, Numbering, RingPayload, WriterState};
use crate::{
    alloc::area::Area,
    error::PublishError,
    os::clock::monotonic,
    qos::Durability,
    ring::{
        layout::{COPIED, INLINE, Location},
        protocol::{self, PayloadLocation, Record},
        types::{Meta, Published},
    },
    session::peer::PeerSession,
    wake::{Purpose, settle},
    writer::{
        Writer,
        header::Dropped,
        history::SampleStorage,
        loan::{Lender, Loan, LoanLocation},
        reclaim::PublishObstacle,
    },
};

/// The time at which sleeping readers are woken for a sample.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum WakeTiming {
    /// When it is published.
    Now,
    /// When the publisher [announces](Writer::announce) it.
    Later,
}

/// The total time that a publish may wait, counted from its first wait.
pub(crate) struct PublishDeadline {
    whole: Duration,
    end: Option<Instant>,
}

impl PublishDeadline {
    pub(crate) fn new(whole: Duration) -> Self {
        Self { whole, end: None }
    }

    fn left(&mut self) -> Duration {
        let now = Instant::now();
        self.end.get_or_insert(now + self.whole).saturating_duration_since(now)
    }
}

impl Writer {
    #[inline]
    pub(super) fn publish_within(
        &self,
        numbering: Numbering,
        payload: &[u8],
        deadline: Duration,
        bells: WakeTiming,
    ) -> Result<(u64, Published), PublishError> {
        let bytes = self.check(payload.len())?;
        let mut deadline = PublishDeadline::new(deadline);
        if payload.len() as u64 <= COPIED {
            return self.commit(numbering, RingPayload::Bytes(payload), deadline, bells);
        }
        let lent: Result<LoanLocation, Meta> = self.retry_until(&mut deadline, |state| {
            state.numbers.judge(numbering)?;
            if self.is_unread(state) {
                return Ok(Err(self.pass(state, numbering)));
            }
            self.lend(state, bytes).map(Ok)
        })?;
        let place = match lent {
            Ok(place) => place,
            Err(passed) => return Ok((passed.sequence, Published { position: None })),
        };
        // Copied outside the lock: no other thread knows the place yet.
        let mut loan = Loan::placed(Lender::Borrowed(self), 0, payload.len(), place);
        loan.copy_from_slice(payload);
        loan.commit(payload.len(), numbering, deadline)
    }

    /// Publishes a payload that has been copied in, or copies it in here. If no sample takes the lent memory, its
    /// borrower gives it back.
    pub(crate) fn commit(
        &self,
        numbering: Numbering,
        payload: RingPayload<'_>,
        mut deadline: PublishDeadline,
        bells: WakeTiming,
    ) -> Result<(u64, Published), PublishError> {
        // A loan may have been made before the fork.
        if self.is_forked() {
            return Err(PublishError::Forked);
        }
        let (meta, position, waiting) = self.retry_until(&mut deadline, |state| {
            state.numbers.judge(numbering)?;
            if self.is_unread(state) {
                return Ok((self.pass(state, numbering), None, None));
            }
            self.make_place(state)?;
            let (extent, place) = match payload {
                RingPayload::Bytes(bytes) if bytes.len() <= INLINE => {
                    (SampleStorage::Inline, PayloadLocation::Inline)
                }
                RingPayload::Bytes(bytes) => {
                    let block = self.copy_in(state, bytes)?;
                    (SampleStorage::Block(block), PayloadLocation::Block(block.at))
                }
                RingPayload::Written { at, lead, len: sample, lent } => {
                    let len = Area::rounded(lent as u64);
                    let first = Location { offset: at.offset + lead as u64, ..at };
                    (
                        SampleStorage::Slot { at, len, sample: sample as u64 },
                        PayloadLocation::Slot(first),
                    )
                }
            };
            let meta = state.numbers.number(numbering);
            let position = self.show(state, meta, extent, place, payload);
            if state.reader_set.has_followers() {
                self.session.journal().note(self.number);
            }
            if bells == WakeTiming::Later {
                return Ok((meta, Some(position), None));
            }
            settle::<AtomicU64>();
            Ok((meta, Some(position), state.reader_set.waiting()))
        })?;
        // A system call for each sleeping session, outside the lock.
        for peer in waiting.iter().flat_map(|peers| &**peers) {
            peer.ring_if(Purpose::Samples);
        }
        Ok((meta.sequence, Published { position }))
    }

    /// Wakes sleeping readers, for samples that were [published quietly](Self::try_publish_quietly).
    pub fn announce(&self) {
        if self.is_forked() {
            return;
        }
        // A reader that goes to sleep after this checks the ring once more, and sees the samples.
        settle::<AtomicU64>();
        let waiting = self.lock().reader_set.waiting();
        for peer in waiting.iter().flat_map(|peers| &**peers) {
            peer.ring_if(Purpose::Samples);
        }
    }

    /// Returns whether no reader will ever read a sample that is published now.
    #[inline]
    pub(super) fn is_unread(&self, state: &WriterState) -> bool {
        state.reader_set.is_empty() && self.options.qos.durability == Durability::Volatile
    }

    /// Numbers and counts a sample that no reader reads.
    pub(super) fn pass(&self, state: &mut WriterState, numbering: Numbering) -> Meta {
        let meta = state.numbers.number(numbering);
        self.header.show_published(state.numbers.count());
        // Frees the memory of given-up samples here: a sample that no reader reads needs no memory, so no search for
        // memory frees theirs.
        self.reclaim(state);
        meta
    }

    fn show(
        &self,
        state: &mut WriterState,
        meta: Meta,
        extent: SampleStorage,
        place: PayloadLocation,
        payload: RingPayload<'_>,
    ) -> u64 {
        let (len, inline) = match payload {
            RingPayload::Bytes(bytes) => (bytes.len(), bytes),
            RingPayload::Written { len, .. } => (len, &[][..]),
        };
        self.header.show_published(state.numbers.count());
        let position = state.history.push(extent);
        let record = Record {
            sequence: meta.sequence,
            timestamp: meta.source_nanos,
            published: self.published_at(meta),
            len: u32::try_from(len).expect("no longer than the largest message"),
            place,
        };
        protocol::about_to_write::<AtomicU64>();
        protocol::publish(self.header.words(), state.array.words(), position, &record, inline);
        position
    }

    /// Returns the time from which the sample's lifespan counts; 0 if the lifespan is infinite.
    #[inline]
    fn published_at(&self, meta: Meta) -> u64 {
        match (self.options.qos.lifespan, meta.published_nanos) {
            (None, _) => 0,
            (Some(_), 0) => monotonic(),
            (Some(_), earlier) => earlier,
        }
    }

    /// Retries `attempt` until it succeeds or `deadline` is over. The lock is not held in between.
    pub(super) fn retry_until<T>(
        &self,
        deadline: &mut PublishDeadline,
        attempt: impl FnMut(&mut WriterState) -> Result<T, PublishObstacle>,
    ) -> Result<T, PublishError> {
        let tried = self.try_for(deadline, attempt);
        if let Err(error) = &tried {
            self.count_failure(error, deadline.whole);
        }
        tried
    }

    #[cold]
    fn count_failure(&self, error: &PublishError, deadline: Duration) {
        if let Some(dropped) = Dropped::by(error, deadline) {
            let _lock = self.lock();
            self.header.count(dropped);
        }
    }

    fn try_for<T>(
        &self,
        deadline: &mut PublishDeadline,
        mut attempt: impl FnMut(&mut WriterState) -> Result<T, PublishObstacle>,
    ) -> Result<T, PublishError> {
        for look in 0u32.. {
            let (short, laggards) = {
                let mut state = self.lock();
                let short = match attempt(&mut state) {
                    Ok(done) => return Ok(done),
                    Err(PublishObstacle::Error(error)) => return Err(error),
                    Err(PublishObstacle::Pinned(kept)) => {
                        drop(state);
                        return Err(kept.into_error());
                    }
                    Err(PublishObstacle::OldestInUse { short }) => short,
                };
                let WriterState { history, reader_set, .. } = &mut *state;
                let laggards = reader_set.laggards(history.tail(), history.head());
                if look == 0 && laggards.is_some() {
                    self.header.count_refused();
                }
                (short, laggards)
            };
            let left = deadline.left();
            match laggards {
                Some((reader, _)) if left.is_zero() => {
                    let blocked = PublishError::Blocked { reader };
                    // A caller that does not wait tries again: the reader frees space, whether there is memory or not.
                    let short = short.filter(|_| !deadline.whole.is_zero());
                    return Err(short.unwrap_or(blocked));
                }
                Some((_, peers)) => self.await_room(&peers, left),
                // The reader made progress between the two reads. A reader that keeps doing this is misbehaving.
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
            let WriterState { history, reader_set, .. } = &mut *state;
            reader_set.floors(history.head()).held > history.tail()
                || laggards.iter().any(|peer| peer.is_dead())
        };
        let pidfds: Vec<_> = laggards.iter().map(|peer| peer.pidfd()).collect();
        self.session.wait_for_room(ready, &pidfds, left);
        let mut state = self.lock();
        let WriterState { history, reader_set, .. } = &mut *state;
        reader_set.mark_dead(history.head());
    }
}
