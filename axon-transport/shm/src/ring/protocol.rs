//! The ring's protocol over plain words: the stores of a publisher and the checks of a reader.
//!
//! A descriptor's stamp says which position the descriptor holds. The stamp is stored with release after the
//! sample, so a reader that sees the stamp sees the sample. A reader that waits for the next sample polls one
//! cache line. A lagging reader uses the head instead, which covers all positions below it.
//!
//! A reader copies first and checks afterwards. Large samples are the exception: the reader [pins](super::pins)
//! them. The publisher raises the tail above a position before it reuses that position's descriptor or block. A
//! reader that finds the tail still at or below its position after the copy has copied the published sample. In the
//! same way the reader finds out that the descriptors have moved to a larger array, and that the memory of the
//! old array has been reused.

use std::ops::Range;

use crate::{
    memory::prefetch::prefetch,
    ring::layout::{
        DESCRIPTOR_WORDS, Location, halves,
        ring::{ARRAY, HEAD, LIFESPAN, TAIL},
    },
    sync::{Ordering, Site, Word, fence_at},
};

const STAMP: usize = 0;
const SEQUENCE: usize = 1;
const TIMESTAMP: usize = 2;
/// The sample's length in bytes, the kind of its location, and the number of its segment.
const PLACE: usize = 3;
const DATA: usize = 4;
/// The time of publication on the monotonic clock, if the lifespan is finite.
const PUBLISHED: usize = DESCRIPTOR_WORDS - 1;
const INLINE_WORDS: usize = PUBLISHED - DATA;

/// The largest head. No ring gets this far; a larger head is corrupt.
pub(crate) const MAX_POSITION: u64 = 1 << 62;

/// The location of a sample's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PayloadLocation {
    /// In the descriptor.
    Inline,
    /// In memory that is overwritten as soon as the sample is given up.
    Block(Location),
    /// In memory that does not change while the sample is pinned.
    Slot(Location),
}

impl PayloadLocation {
    fn word(self) -> (u32, u64) {
        match self {
            Self::Inline => (0, 0),
            Self::Block(at) => (1 | at.segment << 8, at.offset),
            Self::Slot(at) => (2 | at.segment << 8, at.offset),
        }
    }
}

/// The fields of a descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) sequence: u64,
    pub(crate) timestamp: i64,
    /// 0 if the ring's lifespan is infinite.
    pub(crate) published: u64,
    pub(crate) len: u32,
    pub(crate) place: PayloadLocation,
}

fn descriptor<W>(array: &[W], position: u64) -> &[W] {
    &array[words_of(array.len(), position)]
}

/// Returns the range of words of a position's descriptor, in an array of `len` words.
fn words_of(len: usize, position: u64) -> Range<usize> {
    let mask = (len / DESCRIPTOR_WORDS) as u64 - 1;
    let start = (position & mask) as usize * DESCRIPTOR_WORDS;
    start..start + DESCRIPTOR_WORDS
}

/// Returns the source timestamp from a copy of a descriptor's words, if the descriptor held `position` at that time.
pub(crate) fn timestamp_of(words: &[u64; DESCRIPTOR_WORDS], position: u64) -> Option<i64> {
    let stamp = position.checked_mul(2)?.checked_add(2)?;
    (words[STAMP] == stamp).then_some(words[TIMESTAMP].cast_signed())
}

/// Publisher: raises the tail, before positions below `tail` are reused.
pub(crate) fn retire<W: Word>(ring: &[W], tail: u64) {
    // Pairs with `bounds`: a reader that sees this tail sees a head at least as high.
    ring[TAIL].store(tail, Site::TailStore.order());
}

/// Publisher: fences before this thread stores to descriptors, blocks or other memory of the heap. A reader that sees
/// one of those stores also sees the tail that was raised, and the array that was replaced, before this call by this
/// thread or by one that this thread synchronized with.
#[inline]
pub(crate) fn about_to_write<W: Word>() {
    // Pairs with the acquire fence of `stands`.
    fence_at::<W>(Site::ReuseFence);
}

/// Publisher: makes `position` visible, after [`about_to_write`]. If the sample is not in the descriptor, it has been
/// copied already.
pub(crate) fn publish<W: Word>(
    ring: &[W],
    array: &[W],
    position: u64,
    record: &Record,
    inline: &[u8],
) {
    let slot = descriptor(array, position);
    slot[SEQUENCE].store(record.sequence, Ordering::Relaxed);
    slot[TIMESTAMP].store(record.timestamp.cast_unsigned(), Ordering::Relaxed);
    let (place, offset) = record.place.word();
    slot[PLACE].store(u64::from(record.len) | u64::from(place) << 32, Ordering::Relaxed);
    if record.published != 0 {
        slot[PUBLISHED].store(record.published, Ordering::Relaxed);
    }
    match record.place {
        PayloadLocation::Inline => copy_in(&slot[DATA..PUBLISHED], inline),
        PayloadLocation::Block(_) | PayloadLocation::Slot(_) => {
            slot[DATA].store(offset, Ordering::Relaxed)
        }
    }
    // Pairs with `state`: a reader that sees the stamp sees the sample.
    slot[STAMP].store(2 * position + 2, Site::StampStore.order());
    // Pairs with `bounds`: a reader that sees the head sees the stamp.
    ring[HEAD].store(position + 1, Site::HeadStore.order());
}

/// Publisher: returns the sequence number of the sample at a readable position.
pub(crate) fn number<W: Word>(array: &[W], position: u64) -> u64 {
    // Relaxed: no other process or thread stores to it.
    descriptor(array, position)[SEQUENCE].load(Ordering::Relaxed)
}

/// Publisher: fills a new array with the descriptors from `tail` up to `head` of the old one. Call it after
/// [`about_to_write`]; [`replace`] follows.
pub(crate) fn copy_descriptors<W: Word>(old: &[W], new: &[W], tail: u64, head: u64) {
    let descriptors = (new.len() / DESCRIPTOR_WORDS) as u64;
    // Stamps each descriptor as if it had been used in the round before. A reader that asks for a position that was
    // given up must find that it is late, and a reader that asks for the next position must wait.
    for next in head..head + descriptors {
        let stamp = next.checked_sub(descriptors).map_or(0, |last| 2 * last + 2);
        descriptor(new, next)[STAMP].store(stamp, Ordering::Relaxed);
    }
    for position in tail..head {
        for (to, from) in descriptor(new, position).iter().zip(descriptor(old, position)) {
            to.store(from.load(Ordering::Relaxed), Ordering::Relaxed);
        }
    }
}

/// Publisher: replaces the array of descriptors. The old array may be used for something else, after
/// [`about_to_write`].
pub(crate) fn replace<W: Word>(ring: &[W], array: u64) {
    // Pairs with `array`: a reader that sees the new word sees the descriptors there.
    ring[ARRAY].store(array, Site::ArrayStore.order());
}

/// Reader: returns the word with the location of the descriptors.
#[inline]
pub(crate) fn array<W: Word>(ring: &[W]) -> u64 {
    // Pairs with `replace`.
    ring[ARRAY].load(Site::ArrayLoad.order())
}

/// Reader: returns the oldest readable position and the next position to be published.
pub(crate) fn bounds<W: Word>(ring: &[W]) -> Result<(u64, u64), &'static str> {
    // In this order: a head that is loaded after a tail is never below that tail.
    let tail = ring[TAIL].load(Site::TailLoad.order());
    let head = ring[HEAD].load(Site::HeadLoad.order());
    if tail > head || head > MAX_POSITION {
        return Err("its head and tail make no sense");
    }
    Ok((tail, head))
}

/// Reader: the state of a position's descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PositionState {
    /// The position is not published yet.
    Ahead,
    /// The position is readable, or has just been given up.
    Here,
    /// The descriptor holds a later position.
    Gone,
}

/// Reader: the result of reading a published descriptor.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum RecordRead {
    Sample(Record),
    /// The publisher has reused the descriptor. The reader has to load the tail again.
    Lapped,
    Corrupt(&'static str),
}

/// A reader's view of a ring.
pub(crate) struct View<'a, W> {
    /// The ring's header.
    pub(crate) ring: &'a [W],
    /// The word from [`array`], and the descriptors at its location.
    pub(crate) word: u64,
    pub(crate) array: &'a [W],
}

impl<'a, W: Word> View<'a, W> {
    #[inline]
    pub(crate) fn state(&self, position: u64) -> PositionState {
        let stamp = descriptor(self.array, position)[STAMP].load(Site::StampLoad.order());
        // Pairs with `publish`.
        match stamp.cmp(&(2 * position + 2)) {
            std::cmp::Ordering::Less => PositionState::Ahead,
            std::cmp::Ordering::Equal => PositionState::Here,
            std::cmp::Ordering::Greater => PositionState::Gone,
        }
    }

    /// Reads the record at `position`, whose descriptor is [here](PositionState::Here). The location of the sample is
    /// not checked.
    pub(crate) fn look(&self, position: u64) -> RecordRead {
        let slot = descriptor(self.array, position);
        let sequence = slot[SEQUENCE].load(Ordering::Relaxed);
        let timestamp = slot[TIMESTAMP].load(Ordering::Relaxed).cast_signed();
        let (len, place) = halves(slot[PLACE].load(Ordering::Relaxed));
        let offset = slot[DATA].load(Ordering::Relaxed);
        // For a short sample, the word with the time is in a cache line that otherwise is not needed.
        let finite = self.ring[LIFESPAN].load(Ordering::Relaxed) != 0;
        let published = if finite { slot[PUBLISHED].load(Ordering::Relaxed) } else { 0 };
        if !self.stands(position) {
            return RecordRead::Lapped;
        }
        let at = Location { segment: place >> 8, offset };
        let place = match place & 0xff {
            0 if len as usize > INLINE_WORDS * 8 => {
                return RecordRead::Corrupt("a sample in a descriptor is longer than that");
            }
            0 => PayloadLocation::Inline,
            1 => PayloadLocation::Block(at),
            2 => PayloadLocation::Slot(at),
            _ => return RecordRead::Corrupt("a sample is in no known kind of place"),
        };
        RecordRead::Sample(Record { sequence, timestamp, published, len, place })
    }

    /// Prefetches the rest of a descriptor that is [here](PositionState::Here) from the publisher's core, while the
    /// caller prepares to take the sample. Otherwise the atomic operations of the locks in between would delay the
    /// fetch.
    #[inline]
    pub(crate) fn expect(&self, position: u64) {
        prefetch(&descriptor(self.array, position)[DESCRIPTOR_WORDS / 2]);
    }

    /// Returns the words of a sample that is in its descriptor.
    pub(crate) fn inline(&self, position: u64) -> &'a [W] {
        &descriptor(self.array, position)[DATA..PUBLISHED]
    }

    /// Returns whether everything that was loaded of `position` so far is what was published.
    pub(crate) fn stands(&self, position: u64) -> bool {
        // Pairs with the release fence of `about_to_write`. If one of the earlier loads saw a reuse, the following
        // loads see the tail and the array that were stored before it.
        fence_at::<W>(Site::StandsFence);
        self.ring[TAIL].load(Ordering::Relaxed) <= position
            && self.ring[ARRAY].load(Ordering::Relaxed) == self.word
    }
}

/// Copies `bytes` into words and pads the last word with zeros.
pub(crate) fn copy_in<W: Word>(words: &[W], bytes: &[u8]) {
    let (whole, rest) = bytes.as_chunks::<8>();
    for (word, chunk) in words.iter().zip(whole) {
        word.store(u64::from_ne_bytes(*chunk), Ordering::Relaxed);
    }
    if !rest.is_empty() {
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        words[whole.len()].store(u64::from_ne_bytes(last), Ordering::Relaxed);
    }
}
