//! The reading end of a ring.

mod awaited;
mod batch;
mod next_sample;
mod options;
pub(crate) mod sample;
mod segment_cache;
pub(crate) mod slice;
mod unconfirmed;

use std::{
    sync::{Arc, atomic::AtomicU64},
    time::Instant,
};

pub use self::options::ReaderOptions;
use self::{
    awaited::AwaitedSegment,
    next_sample::{Bytes, Descriptors},
    segment_cache::SegmentCache,
    unconfirmed::UnconfirmedSamples,
};
use crate::{
    alloc::pin_limit::PinLimit,
    error::{ShmError, TakeError},
    ids::Gid,
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
        peer::{RingPeer, SegmentLookup},
    },
    sync::Ordering,
    wake::{Purpose, settle},
};

/// Maximum number of attempts of a take if a publisher keeps overtaking it.
const ATTEMPTS: u32 = 16;

/// One subscription's view of one publisher's ring.
///
/// Continues after the publisher's death until it is drained. Dropping it notifies the publisher; samples that were
/// taken from it stay valid.
pub struct Reader {
    reads: ReaderConfig,
    attachment: Arc<Attachment>,
    /// `None` until the first look-up.
    descriptors: Option<Descriptors>,
    /// The segments of recent samples.
    segments: SegmentCache,
    awaited: AwaitedSegment,
    cursor: u64,
    /// Samples that the caller confirms explicitly. Boxed: few readers have any, and the fields that each take reads
    /// stay together.
    under_way: Option<Box<UnconfirmedSamples>>,
    /// The head when it was last read.
    seen: u64,
    received: u64,
    lost: u64,
    skipped: u64,
    corrupt: Option<&'static str>,
    /// True if the reader gave up the ring: the publisher is gone, and memory of it never came.
    given_up: bool,
}

/// The constant properties of a reader.
struct ReaderConfig {
    writer: Gid,
    peer: RingPeer,
    grant: Grant,
    depth: u64,
    max_message: u64,
    /// The longest sample that may be pinned, in bytes.
    in_place: u64,
    /// True if a publisher may wait for it.
    tells: bool,
    /// The entry by which its session finds the reader when there may be samples to take.
    watch: Option<WatchKey>,
}

impl Reader {
    /// Checks a ring and opens the lane.
    ///
    /// # Errors
    /// There is no ring of this publisher at that location, or the segment that contains it has not come.
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
            segments: SegmentCache::default(),
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

    /// Returns whether there is a sample to take. Reads one cache line that the publisher writes with each sample, and
    /// one that it seldom writes.
    #[inline]
    pub fn has_data(&self) -> bool {
        // In a forked child, a publisher of the same session does not exist.
        if self.corrupt.is_some() || self.given_up || self.attachment.lane.is_forked() {
            return false;
        }
        if let Some(segment) = self.awaited.segment() {
            let more = |(tail, head): (u64, u64)| {
                tail > self.cursor || head.saturating_sub(self.cursor) > self.reads.depth
            };
            return !matches!(self.reads.peer.find(segment), SegmentLookup::Absent)
                // The segment may not be needed any more.
                || protocol::bounds(self.attachment.ring()).is_ok_and(more)
                // The segment has to be requested again, or given up.
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
                // The next take requests the segment, or reports the error.
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

    /// Returns the number of samples to take; at most the subscription's depth.
    #[inline]
    pub fn unread(&self) -> u64 {
        if self.given_up || self.attachment.lane.is_forked() {
            return 0;
        }
        match (self.corrupt, protocol::bounds(self.attachment.ring())) {
            (None, Ok((tail, head))) => {
                // The stamp of the last sample may have come before the head.
                let unread = head.saturating_sub(self.cursor.max(tail));
                unread.max(u64::from(self.has_data())).min(self.reads.depth)
            }
            // The next take reports the error.
            (None, Err(_)) => 1,
            (Some(_), _) => 0,
        }
    }

    /// Returns the number of unread samples below a position.
    #[inline]
    pub fn unread_below(&self, position: u64) -> u64 {
        self.unread().min(position.saturating_sub(self.cursor))
    }

    /// Returns the metadata of the next sample, without taking it.
    ///
    /// # Errors
    /// The ring cannot be read.
    #[inline]
    pub fn peek(&mut self) -> Result<Option<Meta>, TakeError> {
        Ok(self.find()?.map(|record| meta(&record)))
    }

    /// Takes the next sample. Its payload replaces the content of `out`.
    ///
    /// Samples beyond the subscription's depth are skipped; samples within it that the publisher has overwritten are
    /// lost. Both are counted. Returns `None` if there is no sample, or if the publisher was faster again and again
    /// ([`has_data`](Self::has_data) is then true).
    ///
    /// # Errors
    /// The ring cannot be read, or the sample is longer than the subscription expects: that sample is skipped and lost.
    /// Or memory for it is short: it can be taken later. The content of `out` is of no use then.
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

    /// Like [`take`](Self::take), but a large sample stays in place.
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

    /// Like [`take_sample`](Self::take_sample), but always copies.
    ///
    /// # Errors
    /// As for [`take`](Self::take).
    pub fn take_copy(&mut self) -> Result<Option<Sample>, TakeError> {
        let mut out = Vec::new();
        Ok(self.take(&mut out)?.map(|taken| Sample::copied(taken, out)))
    }

    /// Skips the oldest untaken sample, which then counts as skipped, not as lost: for a subscription whose depth
    /// several publishers share. Returns false if there is none.
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

    /// Returns the number of samples taken.
    #[inline]
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Returns the number of samples overwritten before they could be taken, within the subscription's depth.
    #[inline]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Returns the number of samples skipped because more recent ones fill the subscription's depth.
    #[inline]
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// Returns the publisher.
    #[inline]
    pub fn writer(&self) -> Gid {
        self.reads.writer
    }

    /// Returns the publisher's session.
    pub(super) fn peer(&self) -> &RingPeer {
        &self.reads.peer
    }

    /// Returns the grant by which it reads.
    #[inline]
    pub fn grant(&self) -> Grant {
        self.reads.grant
    }

    /// Returns the position that it takes next.
    #[inline]
    pub fn position(&self) -> u64 {
        self.cursor
    }

    /// Returns the location of its lane.
    #[inline]
    pub fn lane(&self) -> Location {
        self.attachment.lane.location()
    }

    /// Returns whether it reads the same ring as another reader.
    #[inline]
    pub fn is_of_ring(&self, other: &Self) -> bool {
        std::ptr::eq(self.attachment.ring(), other.attachment.ring())
    }

    /// Returns when to look again for memory that is needed in order to continue and has not come.
    #[inline]
    pub fn look_again(&self) -> Option<Instant> {
        self.awaited.look_again()
    }

    /// Returns the number of the segment of the publisher's session that is needed in order to continue and has not
    /// come.
    pub fn missing(&self) -> Option<u32> {
        self.awaited.segment()
    }

    /// Gives up the remaining samples if memory that the reader needs in order to continue has not come. Returns
    /// whether it gave them up. These samples count as skipped: for a reader whose publisher is gone and whose samples
    /// another reader has, too.
    pub fn skip_missing(&mut self) -> bool {
        // The segment may have come since the last look-up.
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

    /// Returns whether there is nothing to take now, nor when the segments in flight come. For a reader whose publisher
    /// is gone.
    pub fn is_drained(&self) -> bool {
        self.awaited.segment().is_none() && !self.has_data()
    }

    /// Records that the publisher is gone and that all of its memory was handed over, whether or not its process has
    /// ended: memory that does not come soon never will.
    pub fn end(&mut self) {
        self.awaited.end();
    }

    /// Returns how many samples have come since the grant, whether taken, skipped or lost.
    #[inline]
    pub fn arrived(&self) -> u64 {
        if self.corrupt.is_some() || self.attachment.lane.is_forked() {
            return 0;
        }
        let head = protocol::bounds(self.attachment.ring()).map_or(self.cursor, |(_, head)| head);
        // A sample may be taken by its stamp before the head includes it.
        head.max(self.cursor).saturating_sub(self.reads.grant.first)
    }

    /// Returns the ring's header; `None` in a forked child of the reader's process.
    #[inline]
    pub(super) fn ring_words(&self) -> Option<&[AtomicU64]> {
        (!self.attachment.lane.is_forked()).then(|| self.attachment.ring())
    }

    /// Returns whether the publisher's process has ended, by a system call. Drain the reader before dropping it.
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

    /// Counts the sample at the cursor as taken, and shows that to its publisher.
    #[inline]
    fn taken(&mut self, record: &Record) -> Taken {
        let taken = self.taken_untold(record);
        self.tell_cursor();
        taken
    }

    /// Like [`taken`](Self::taken), but does not show it to the publisher.
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

    /// Makes its session find the reader by [`take_active`](crate::session::segment::SessionSegment::take_active) when
    /// there may be samples to take, and now, if the session
    /// [follows](crate::session::segment::SessionSegment::follow).
    pub fn follow(&mut self, reader: Gid) {
        let Some(words) = self.ring_words() else { return };
        // Relaxed: written before any reader learned where the ring is. A wrong number hides no ring for ever: each
        // look includes some readers in turn.
        let ring = words[layout::ring::NUMBER].load(Ordering::Relaxed) as u32;
        let session = self.attachment.lane.session();
        let (pair, peer) = ((reader, self.reads.writer), self.reads.peer.remote());
        self.reads.watch = session.activity().watch(pair, peer, session.journal(), ring);
    }

    /// Makes its session find the reader at the next look, if it is followed.
    pub fn mark_active(&self) {
        // In a forked child, a thread of the parent may have held the lock.
        if let Some(watch) = &self.reads.watch
            && !self.attachment.lane.is_forked()
        {
            watch.mark();
        }
    }

    /// Makes each take wake its publisher, if that waits: for a reader that stands for remote ones.
    #[inline]
    pub fn tell_progress(&mut self) {
        self.reads.tells = true;
    }

    /// Makes each take wake its publisher in another session, even one that waits for a KEEP_LAST reader.
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

    /// Returns the times in the publisher's ring.
    pub fn times(&self) -> Times {
        self.ring_words().map_or_else(Times::default, read)
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        // The lane closes with the last sample; until then the reader only stops holding up the publisher.
        if self.attachment.lane.is_forked() {
            // A thread of the parent may have held the entry's lock.
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
