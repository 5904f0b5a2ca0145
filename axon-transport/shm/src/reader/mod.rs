//! The reading end of a ring.

mod awaited;
mod batch;
mod next_sample;
pub(crate) mod sample;
pub(crate) mod slice;
mod unconfirmed;

use std::{
    sync::{Arc, Weak, atomic::AtomicU64},
    time::Instant,
};

use self::{
    awaited::AwaitedSegment,
    next_sample::{Bytes, Descriptors},
    unconfirmed::UnconfirmedSamples,
};
use crate::{
    alloc::pin_limit::PinLimit,
    error::{ShmError, TakeError},
    ids::Gid,
    memory::segment::Map,
    qos::Qos,
    reader::sample::Sample,
    ring::{
        layout::{self, Location},
        protocol::{self, MAX_POSITION, PositionState, Record},
        times::{Times, read},
        types::{Grant, Meta, Taken},
        window::{depth, holds},
    },
    session::{
        activity::WatchKey,
        attachment::{Attachment, Pinning},
        lane::Lane,
        peer::{RingPeer, SegmentLookup},
    },
    sync::Ordering,
    wake::{Purpose, settle},
};

/// How often a take follows a publisher that keeps overtaking it before it lets go.
const ATTEMPTS: u32 = 16;
/// Segments of samples that a reader finds without a lock.
const KNOWN: usize = 4;

/// What a reader must know of the ring that it is granted.
pub struct ReaderOptions {
    /// The subscription.
    pub reader: Gid,
    /// The publisher.
    pub writer: Gid,
    /// The publisher's session.
    pub peer: RingPeer,
    /// Where the ring is in that session's memory.
    pub ring: Location,
    /// The lane by which the reader attached.
    pub lane: Lane,
    /// The publisher's answer.
    pub grant: Grant,
    /// What the subscription requests.
    pub qos: Qos,
    /// The largest sample to expect, in bytes.
    pub max_message: u64,
}

/// One subscription's view of one publisher's ring.
///
/// Goes on after the publisher's death until it is drained. Dropping it tells the publisher; the
/// samples that were taken from it stay.
pub struct Reader {
    reads: ReaderConfig,
    attachment: Arc<Attachment>,
    /// `None` until the first look-up.
    descriptors: Option<Descriptors>,
    /// Maps of the segments that samples were in.
    maps: Vec<(u32, Weak<Map>)>,
    awaited: AwaitedSegment,
    cursor: u64,
    /// Samples that the caller releases explicitly. Boxed: few readers have any, and the fields that each take reads
    /// stay together.
    under_way: Option<Box<UnconfirmedSamples>>,
    /// The head at the last look.
    seen: u64,
    received: u64,
    lost: u64,
    skipped: u64,
    corrupt: Option<&'static str>,
    /// The publisher is gone, and its descriptors are in memory that never came.
    given_up: bool,
}

/// What is in the way of a reader.
enum ReadObstacle {
    Missing(u32),
    Corrupt(&'static str),
}

/// What does not change.
struct ReaderConfig {
    writer: Gid,
    peer: RingPeer,
    grant: Grant,
    depth: u64,
    max_message: u64,
    /// The longest sample that may be pinned, in bytes.
    in_place: u64,
    /// Whether a publisher may wait for it.
    tells: bool,
    /// Has its session find it when there is something to take.
    watch: Option<WatchKey>,
}

impl Reader {
    /// Checks a ring and opens the lane.
    ///
    /// # Errors
    /// There is no ring of this publisher's in that place, or the segment that it is in has not
    /// come.
    pub fn map(options: ReaderOptions) -> Result<Self, ShmError> {
        let ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message } = options;
        if lane.is_forked() {
            return Err(ShmError::Forked);
        }
        let refuse = |what| Err(ShmError::Refused { what });
        if !lane.is_meant_by(grant) {
            return refuse("its grant is not for this reader");
        }
        let SegmentLookup::Map(map) = peer.find(ring.segment) else {
            return refuse("the segment that its ring is in did not come");
        };
        let Some(words) = ring.words(layout::RING, map.words().len()) else {
            return refuse("its ring is outside its memory");
        };
        layout::check_ring(&map.words()[words.clone()], writer)?;
        if grant.first > MAX_POSITION {
            return refuse("its ring is too far");
        }
        lane.open(grant, reader);
        let tells = holds(&qos) && peer.remote().is_some();
        let (depth, in_place) = (depth(&qos), PinLimit::of(grant.generation).longest());
        let attachment = Attachment::new(map, words, lane);
        if let Some(session) = peer.remote() {
            session.keep_told(&attachment);
        }
        Ok(Self {
            attachment,
            descriptors: None,
            maps: Vec::new(),
            awaited: AwaitedSegment::default(),
            cursor: grant.first,
            under_way: None,
            seen: 0,
            received: 0,
            lost: 0,
            skipped: 0,
            corrupt: None,
            given_up: false,
            reads: ReaderConfig {
                writer,
                peer,
                grant,
                depth,
                max_message,
                in_place,
                tells,
                watch: None,
            },
        })
    }

    /// Whether there is something to take: a look at one line that the publisher writes with each
    /// sample, and one that it seldom writes.
    #[inline]
    pub fn has_data(&self) -> bool {
        // A publisher of the same session is not there in a forked child.
        if self.corrupt.is_some() || self.given_up || self.attachment.lane.is_forked() {
            return false;
        }
        if let Some(segment) = self.awaited.segment() {
            let more = |(tail, head): (u64, u64)| {
                tail > self.cursor || head.saturating_sub(self.cursor) > self.reads.depth
            };
            return !matches!(self.reads.peer.find(segment), SegmentLookup::Absent)
                // It may not be needed any more.
                || protocol::bounds(self.attachment.ring()).is_ok_and(more)
                // It is to be asked for again, or given up.
                || self.awaited.look_again().is_some_and(|due| Instant::now() >= due);
        }
        let word = protocol::array(self.attachment.ring());
        let found;
        let descriptors = match &self.descriptors {
            Some(known) if known.word == word => known,
            _ => match self.resolve(word) {
                Ok(resolved) => {
                    found = resolved;
                    &found
                }
                // The next take asks for it, or says what is wrong.
                Err(_) => return true,
            },
        };
        let view = descriptors.view(&self.attachment);
        match view.state(self.cursor) {
            PositionState::Ahead => self.cursor < self.seen,
            PositionState::Here => {
                view.expect(self.cursor);
                true
            }
            PositionState::Gone => true,
        }
    }

    /// How many samples are to be taken; at most the subscription's depth.
    #[inline]
    pub fn unread(&self) -> u64 {
        if self.given_up || self.attachment.lane.is_forked() {
            return 0;
        }
        match (self.corrupt, protocol::bounds(self.attachment.ring())) {
            (None, Ok((tail, head))) => {
                // The stamp of the last one may have come before the head.
                let unread = head.saturating_sub(self.cursor.max(tail));
                unread.max(u64::from(self.has_data())).min(self.reads.depth)
            }
            // The next take says what is wrong.
            (None, Err(_)) => 1,
            (Some(_), _) => 0,
        }
    }

    /// Those of them that are below a position.
    #[inline]
    pub fn unread_below(&self, position: u64) -> u64 {
        self.unread().min(position.saturating_sub(self.cursor))
    }

    /// What goes with the next sample, without taking it.
    ///
    /// # Errors
    /// The ring cannot be read.
    #[inline]
    pub fn peek(&mut self) -> Result<Option<Meta>, TakeError> {
        Ok(self.find()?.map(|record| meta(&record)))
    }

    /// Takes the next sample, with its payload in place of what `out` held.
    ///
    /// Samples that are older than the subscription's depth are skipped; samples within it that
    /// the publisher has overwritten are lost. Both are counted. `None` when there is nothing, or
    /// when the publisher was faster time and again ([`has_data`](Self::has_data) then holds).
    ///
    /// # Errors
    /// The ring cannot be read, or the sample is longer than the subscription expects: that one is
    /// passed over and lost. Or memory for it is short: it can be taken later. `out` holds nothing
    /// useful.
    #[inline]
    pub fn take(&mut self, out: &mut Vec<u8>) -> Result<Option<Taken>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some((record, bytes)) = self.find_whole()? else { break };
            out.clear();
            if self.copy_to(&record, &bytes, out)? {
                return Ok(Some(self.taken(&record)));
            }
        }
        out.clear();
        Ok(None)
    }

    /// As [`take`](Self::take), but a large sample stays where it is.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    #[inline]
    pub fn take_sample(&mut self) -> Result<Option<Sample>, TakeError> {
        for _ in 0..ATTEMPTS {
            let Some((record, bytes)) = self.find_whole()? else { break };
            let bytes = match bytes {
                Bytes::Slot(there) if self.may_pin(&record) => {
                    match self.attachment.pin(self.cursor) {
                        Pinning::Pinned(pin) => {
                            let (taken, len) = (self.taken(&record), record.len as usize);
                            return Ok(Some(Sample::pinned(taken, len, there, pin)));
                        }
                        Pinning::Overtaken => continue,
                        Pinning::NoRecord => Bytes::Slot(there),
                    }
                }
                copied => copied,
            };
            let mut out = Vec::new();
            if self.copy_to(&record, &bytes, &mut out)? {
                return Ok(Some(Sample::copied(self.taken(&record), out)));
            }
        }
        Ok(None)
    }

    /// As [`take_sample`](Self::take_sample), but always a copy.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    pub fn take_copy(&mut self) -> Result<Option<Sample>, TakeError> {
        let mut out = Vec::new();
        Ok(self.take(&mut out)?.map(|taken| Sample::copied(taken, out)))
    }

    /// Drops the oldest sample that is to be taken, as one skipped rather than lost: for a
    /// subscription whose depth is shared by several publishers. False when there is none.
    pub fn skip(&mut self) -> bool {
        match self.find() {
            Ok(Some(_)) => {
                self.awaited.clear();
                self.skipped += 1;
                self.advance(self.cursor + 1);
                true
            }
            _ => false,
        }
    }

    /// Samples taken.
    #[inline]
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Samples overwritten before they could be taken, within the subscription's depth.
    #[inline]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Samples passed over because more recent ones fill the subscription's depth.
    #[inline]
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// The publisher.
    #[inline]
    pub fn writer(&self) -> Gid {
        self.reads.writer
    }

    /// The publisher's session.
    pub(super) fn peer(&self) -> &RingPeer {
        &self.reads.peer
    }

    /// The grant by which it reads.
    #[inline]
    pub fn grant(&self) -> Grant {
        self.reads.grant
    }

    /// The position that it takes next.
    #[inline]
    pub fn position(&self) -> u64 {
        self.cursor
    }

    /// Where its lane is.
    #[inline]
    pub fn lane(&self) -> Location {
        self.attachment.lane.location()
    }

    /// Whether it reads the ring that another does.
    #[inline]
    pub fn is_of_ring(&self, other: &Self) -> bool {
        std::ptr::eq(self.attachment.ring(), other.attachment.ring())
    }

    /// When to look again for memory that is needed to go on and has not come.
    #[inline]
    pub fn look_again(&self) -> Option<Instant> {
        self.awaited.look_again()
    }

    /// The number of the segment of the publisher's session that is needed to go on and has not
    /// come.
    pub fn missing(&self) -> Option<u32> {
        self.awaited.segment()
    }

    /// Gives up the remaining samples if memory that the reader needs to go on has not come; returns
    /// whether it gave up. These samples count as skipped: for a reader whose publisher is gone and
    /// whose samples another reader has, too.
    pub fn skip_missing(&mut self) -> bool {
        // It may have come since it was looked for.
        let lacks = |segment| matches!(self.reads.peer.find(segment), SegmentLookup::Absent);
        if self.given_up || !self.awaited.segment().is_some_and(lacks) {
            return false;
        }
        let head = protocol::bounds(self.attachment.ring()).map_or(self.cursor, |(_, head)| head);
        self.given_up = true;
        self.awaited.clear();
        self.skipped += head.saturating_sub(self.cursor);
        self.advance(head.max(self.cursor));
        true
    }

    /// Whether there is nothing to take now, nor will be when the segments come that are on their
    /// way. For one whose publisher is gone.
    pub fn is_drained(&self) -> bool {
        self.awaited.segment().is_none() && !self.has_data()
    }

    /// Notes that the publisher is gone and that all of its memory was handed over, whether or not its
    /// process has ended: memory that does not come soon never will.
    pub fn end(&mut self) {
        self.awaited.end();
    }

    /// How many samples have come since the grant, whatever became of them.
    #[inline]
    pub fn arrived(&self) -> u64 {
        if self.corrupt.is_some() || self.attachment.lane.is_forked() {
            return 0;
        }
        let head = protocol::bounds(self.attachment.ring()).map_or(self.cursor, |(_, head)| head);
        // A sample may be taken by its stamp before the head says so.
        head.max(self.cursor).saturating_sub(self.reads.grant.first)
    }

    /// The ring's header, which is not there in a forked child of the publisher's.
    #[inline]
    pub(super) fn ring_words(&self) -> Option<&[AtomicU64]> {
        (!self.attachment.lane.is_forked()).then(|| self.attachment.ring())
    }

    /// Whether the publisher's process has ended: a system call. Drain before dropping.
    pub fn writer_dead(&self) -> bool {
        self.reads.peer.is_dead()
    }

    /// Takes samples of up to `max` bytes from now on.
    #[cfg(test)]
    pub(super) fn expect(&mut self, max: u64) {
        self.reads.max_message = max;
    }

    fn corrupt(&mut self, what: &'static str) -> TakeError {
        self.corrupt = Some(what);
        TakeError::Corrupt { writer: self.reads.writer, what }
    }

    /// The sample at the cursor is the caller's.
    #[inline]
    fn taken(&mut self, record: &Record) -> Taken {
        let taken = self.taken_untold(record);
        self.tell_cursor();
        taken
    }

    /// As [`taken`](Self::taken), but its publisher does not hear of it.
    #[inline]
    fn taken_untold(&mut self, record: &Record) -> Taken {
        let taken = Taken { meta: meta(record), position: self.cursor };
        self.received += 1;
        self.attachment.lane.taken(record.timestamp);
        if let Some(under_way) = &mut self.under_way {
            under_way.add(record.sequence, self.cursor);
        }
        self.cursor += 1;
        taken
    }

    #[inline]
    fn advance(&mut self, cursor: u64) {
        self.cursor = cursor;
        self.tell_cursor();
    }

    #[inline]
    fn tell_cursor(&self) {
        let first = self.under_way.as_ref().and_then(|under_way| under_way.first());
        let done = first.unwrap_or(self.cursor);
        self.attachment.lane.advance(done, self.received, self.lost, self.skipped);
        self.make_room_known();
    }

    /// Has its session find it by [`take_active`](crate::session::segment::SessionSegment::take_active) when there may
    /// be something to take, and now, where the session [follows](crate::session::segment::SessionSegment::follow).
    pub fn follow(&mut self, reader: Gid) {
        let Some(words) = self.ring_words() else { return };
        // Relaxed: written before anybody was told where the ring is. Another number hides no ring for ever: each look
        // passes over some in turn.
        let ring = words[layout::ring::NUMBER].load(Ordering::Relaxed) as u32;
        let session = self.attachment.lane.session();
        let (pair, peer) = ((reader, self.reads.writer), self.reads.peer.remote());
        self.reads.watch = session.activity().watch(pair, peer, session.journal(), ring);
    }

    /// Has its session find it at the next look, if it is followed.
    pub fn mark_active(&self) {
        // In a forked child, a thread of the parent may have held the lock.
        if let Some(watch) = &self.reads.watch
            && !self.attachment.lane.is_forked()
        {
            watch.mark();
        }
    }

    /// Has its publisher woken by whatever is taken, if it waits for that: of what stands for others.
    #[inline]
    pub fn tell_progress(&mut self) {
        self.reads.tells = true;
    }

    /// Has its publisher, in another session, woken when it may go on: one that waits for KEEP_LAST, too.
    #[inline]
    pub fn tell_room(&mut self) {
        self.reads.tells |= self.reads.peer.remote().is_some();
    }

    /// Wakes a publisher that waits for this reader.
    fn make_room_known(&self) {
        if self.reads.tells {
            settle::<AtomicU64>();
            self.reads.peer.ring_if(Purpose::Room);
        }
    }

    /// What the publisher says of its times.
    pub fn times(&self) -> Times {
        self.ring_words().map_or_else(Times::default, read)
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        // The lane closes with the last sample; until then it only stops to hold the publisher.
        if self.attachment.lane.is_forked() {
            // A thread of the parent may have held its lock.
            std::mem::forget(self.reads.watch.take());
            return;
        }
        self.attachment.lane.leave();
        self.make_room_known();
    }
}

fn meta(record: &Record) -> Meta {
    let Record { sequence, timestamp: source_nanos, published: published_nanos, .. } = *record;
    Meta { sequence, source_nanos, published_nanos }
}
