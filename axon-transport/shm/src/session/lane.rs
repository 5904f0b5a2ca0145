//! The lane of a reader: its cursor, pins and counters. The lane is in the segment of the reader's session, where
//! the publisher reads it.
//!
//! The first word of a lane identifies its user. 0 means that the lane is unused. A value with the highest bit set
//! means that a reader has not seen its grant yet. Any other value is the grant's. No value is used twice. A publisher
//! knows the word from the time of the reader's request, and the value that it granted. So it can detect that another
//! reader uses the lane.

use std::sync::{Arc, atomic::AtomicU64};

use crate::{
    alloc::{heap::HeapObject, pin_limit::PinLimit},
    ids::Gid,
    memory::segment::Map,
    ring::{
        layout::{
            self, LANE_WORDS, Location,
            lane::{CURSOR, GENERATION, GIVEN_UP, LOST, MAPPED, READER, RECEIVED, SKIPPED, TAKEN},
        },
        pins,
        types::Grant,
    },
    session::segment::SessionSegment,
    sync::{Ordering, Site, Word},
};

/// Set in the generation word of a lane that is not open yet.
const ASKED: u64 = 1 << 63;

/// The part of a generation that tells the time of the lane's use: a grant for another time would bring back a reader
/// that has left, for the publisher that gave the grant then.
const TIME: u64 = (1 << 24) - 1;

/// Number of bits for the count in the word of given-up samples. The rest of the word is [`TIME`]'s part of the
/// generation.
const GIVEN_UP_BITS: u32 = 40;
const GIVEN_UP_MAX: u64 = (1 << GIVEN_UP_BITS) - 1;

/// Returns whether a grant of this generation is for the `number`th time that the session uses a lane.
fn is_for(generation: u64, number: u64) -> bool {
    // Any other value leaves the lane without a reader, or to a reader that still asks.
    (1..ASKED).contains(&generation) && generation & TIME == number & TIME
}

/// The state of a reader's lane, as its publisher sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LaneState {
    /// The reader has not seen its grant yet.
    Asked,
    Open,
    /// The reader has left, and has read everything that it pinned.
    Left,
}

/// The values by which a publisher recognizes a reader's use of a lane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LaneId {
    /// The generation word when the reader asked.
    asked: u64,
    /// The generation that was granted.
    generation: u64,
}

impl LaneId {
    /// Publisher: grants a generation to the reader that asked with this lane.
    pub(crate) fn grant<W: Word>(lane: &[W], pin_limit: PinLimit) -> Self {
        let asked = lane[GENERATION].load(Site::GenerationLoad.order());
        let random = rand::random_range(1..ASKED >> 30) << 30;
        Self { asked, generation: random | pin_limit.bits() | asked & TIME }
    }

    /// Returns what its reader may pin.
    pub(crate) fn pin_limit(&self) -> PinLimit {
        PinLimit::of(self.generation)
    }

    /// Publisher: returns whether the lane is as it was when the reader asked.
    pub(crate) fn is_asked<W: Word>(&self, lane: &[W]) -> bool {
        lane[GENERATION].load(Site::GenerationLoad.order()) == self.asked
    }

    pub(crate) fn generation(&self) -> u64 {
        self.generation
    }

    /// Publisher: returns how many samples the reader gave up by now. Samples below its [cursor](Self::cursor) are
    /// counted if the cursor was read before. Returns `None` once the lane has passed on to another reader.
    pub(crate) fn given_up<W: Word>(&self, lane: &[W]) -> Option<u64> {
        // Ordered by the cursor.
        match lane[GIVEN_UP].load(Ordering::Relaxed) {
            // Readers of an older version leave it so.
            0 => Some(0),
            word => {
                (word >> GIVEN_UP_BITS == self.generation & TIME).then_some(word & GIVEN_UP_MAX)
            }
        }
    }

    /// Publisher: returns the state that the lane shows now.
    #[inline]
    pub(crate) fn standing<W: Word>(&self, lane: &[W]) -> LaneState {
        // Pairs with `open`: a publisher that sees the lane open sees its cursor. Pairs with `close`: a publisher that
        // sees it closed, or in other hands, writes after all reads.
        match lane[GENERATION].load(Site::GenerationLoad.order()) {
            0 => LaneState::Left,
            word if word == self.generation => LaneState::Open,
            word if word == self.asked => LaneState::Asked,
            _ => LaneState::Left,
        }
    }

    /// Publisher: returns the next position that the reader takes, if it has opened the lane.
    #[inline]
    pub(crate) fn cursor<W: Word>(&self, lane: &[W]) -> Option<u64> {
        (self.standing(lane) == LaneState::Open).then(|| {
            // Pairs with `advance`: memory from which the reader has copied is not overwritten before.
            lane[CURSOR].load(Site::CursorLoad.order())
        })
    }
}

/// Publisher: returns the highest number of its segments that came to the reader.
#[inline]
pub(crate) fn mapped<W: Word>(lane: &[W]) -> u64 {
    // Pairs with `set_mapped`: a sample that names the segment from now on finds it at the reader.
    lane[MAPPED].load(Site::MappedLoad.order())
}

/// Reader: records the highest number of its publisher's segments that came.
pub(crate) fn set_mapped<W: Word>(lane: &[W], number: u64) {
    // Pairs with `mapped`.
    lane[MAPPED].store(number, Site::MappedStore.order());
}

/// Reader: prepares to ask with this lane for the `number`th time that the session uses one.
pub(crate) fn ask<W: Word>(lane: &[W], number: u64) {
    lane[MAPPED].store(0, Ordering::Relaxed);
    // Pairs with `standing`, for the publisher of the reader that had the lane before.
    lane[GENERATION].store(ASKED | number, Site::AskStore.order());
}

/// Reader: opens the lane, having seen its grant.
pub(crate) fn open<W: Word>(lane: &[W], grant: Grant) {
    // The records are clear since the last pin was given up. Clearing them once more could hide from the last reader's
    // publisher that this reader's reads come after that reader's.
    for word in [RECEIVED, LOST, SKIPPED, TAKEN] {
        lane[word].store(0, Ordering::Relaxed);
    }
    give_up(lane, grant.generation, 0);
    lane[CURSOR].store(grant.first, Ordering::Relaxed);
    // Pairs with `standing`.
    lane[GENERATION].store(grant.generation, Site::OpenStore.order());
}

/// Reader: records that it has taken, or will not take, the samples below `cursor`.
#[inline]
pub(crate) fn advance<W: Word>(lane: &[W], cursor: u64) {
    // Pairs with `cursor`.
    lane[CURSOR].store(cursor, Site::CursorStore.order());
}

/// Reader: records how many samples it gave up since it came. Call it before the reader is done with them.
pub(crate) fn give_up<W: Word>(lane: &[W], number: u64, samples: u64) {
    let word = (number & TIME) << GIVEN_UP_BITS | samples.min(GIVEN_UP_MAX);
    // `advance` shows it.
    lane[GIVEN_UP].store(word, Ordering::Relaxed);
}

/// Reader: records that it has left, and pins nothing.
pub(crate) fn close<W: Word>(lane: &[W]) {
    // Pairs with `standing`.
    lane[GENERATION].store(0, Site::CloseStore.order());
}

/// A publisher's view of a lane of another session or its own.
#[derive(Clone)]
pub(crate) struct LaneView {
    map: Arc<Map>,
    /// The lane's first word.
    start: usize,
}

impl LaneView {
    /// Returns the lane at an offset of a map, if the offset is valid.
    pub(crate) fn new(map: &Arc<Map>, at: Location) -> Option<Self> {
        let start = at.words(layout::LANE, map.words().len())?.start;
        Some(Self { map: Arc::clone(map), start })
    }

    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64; LANE_WORDS] {
        self.map.words()[self.start..].first_chunk().expect("a lane is inside its map")
    }
}

/// Memory of a session in which one reader reports its progress to its publisher.
///
/// Freed when dropped.
pub struct Lane {
    session: Arc<SessionSegment>,
    object: HeapObject,
    /// The count of lanes that the session had given out, including this one.
    number: u64,
}

impl Lane {
    /// Creates the lane in `object`, for the `number`th time that the session gives one out.
    pub(crate) fn new(session: Arc<SessionSegment>, object: HeapObject, number: u64) -> Self {
        let lane = Self { session, object, number };
        ask(lane.words(), number);
        lane
    }

    /// Returns its location, by which a publisher finds it.
    #[inline]
    pub fn location(&self) -> Location {
        self.object.block.at
    }

    /// Returns whether the calling process is a fork of the lane's: it must not touch the lane.
    #[inline]
    pub(crate) fn is_forked(&self) -> bool {
        self.session.is_forked()
    }

    /// Returns the session of its reader.
    pub(crate) fn session(&self) -> &Arc<SessionSegment> {
        &self.session
    }

    /// Returns whether a grant may be the answer to this reader.
    pub(crate) fn is_meant_by(&self, grant: Grant) -> bool {
        is_for(grant.generation, self.number)
    }

    pub(crate) fn open(&self, grant: Grant, reader: Gid) {
        layout::write_id(self.words(), READER, reader.0);
        open(self.words(), grant);
    }

    /// Records the source timestamp of the sample that is taken now.
    #[inline]
    pub(crate) fn taken(&self, timestamp: i64) {
        self.words()[TAKEN].store(timestamp.cast_unsigned(), Ordering::Relaxed);
    }

    /// Records that the reader is done with all samples below `cursor`, and its counters.
    #[inline]
    pub(crate) fn advance(&self, cursor: u64, received: u64, lost: u64, skipped: u64) {
        let words = self.words();
        words[RECEIVED].store(received, Ordering::Relaxed);
        words[LOST].store(lost, Ordering::Relaxed);
        words[SKIPPED].store(skipped, Ordering::Relaxed);
        advance(words, cursor);
    }

    /// Records how many samples were given up since the lane was opened.
    pub(crate) fn give_up(&self, samples: u64) {
        give_up(self.words(), self.number, samples);
    }

    /// Records the highest number of the publisher's segments that have come.
    pub(crate) fn set_mapped(&self, number: u32) {
        set_mapped(self.words(), number.into());
    }

    /// Records that the reader takes no more samples; pinned samples stay pinned.
    pub(crate) fn leave(&self) {
        advance(self.words(), u64::MAX);
    }

    /// Returns a record [that pins nothing](pins::free), of the first `count`.
    #[inline]
    pub(crate) fn free_record(&self, count: usize) -> Option<usize> {
        pins::free(self.words(), count)
    }

    /// [Pins](pins::pin) `position`.
    #[inline]
    pub(crate) fn pin(&self, record: usize, position: u64, tail: &AtomicU64) -> bool {
        pins::pin(self.words(), record, position, tail)
    }

    #[inline]
    pub(crate) fn unpin(&self, record: usize) {
        pins::unpin(self.words(), record);
    }

    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        self.object.words()
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        if !self.is_forked() {
            close(self.words());
            self.session.free_lane(self.object.clone());
        }
    }
}
