//! The layout of segments, in words of eight bytes (`docs/formats.md`, shared memory).

use std::sync::atomic::AtomicU64;

pub(crate) use crate::limits::{ALIGN, LINE, MAX_BUDGET, MAX_MESSAGE};
use crate::{
    error::ShmError,
    ids::{Gid, SessionId},
    sync::Ordering,
};

/// Longest sample in bytes that readers copy out; longer samples are pinned while they are read. So topics with small
/// samples need only their session's memory, which each reader maps once.
pub(crate) const COPIED: u64 = 4096;
/// Like [`COPIED`], for loans of a publisher that has memory for large samples in any case. Pinning a sample of this
/// length costs about as much as copying it.
pub(crate) const COPIED_ALWAYS: u64 = 512;
/// Bytes of a sample that fit in its descriptor.
pub(crate) const INLINE: usize = 88;
/// Alignment in bytes of a loan, or of the part behind its header. It is at least that of any C type.
pub(crate) const ALIGNED: usize = align_of::<u128>();
/// Lanes of a session: the most rings that it can read at a time. A gateway reads the rings of all topics that its
/// peers subscribe to. A lane takes memory once it is used.
pub(crate) const LANES: u32 = 1 << 17;

/// Offset of the lanes in a session's first segment. Nothing else is behind them, so there is room for all lanes
/// whatever else the session allocates.
pub(crate) const LANES_AT: u64 = 512 << 10;
/// Size of a session's first segment in bytes.
pub(crate) const SESSION_BYTES: u64 = LANES_AT + LANES as u64 * LANE;
/// Size of a further segment in bytes. A larger object gets a larger segment: up to [`HEAP_BYTES_MAX`], less a header.
pub(crate) const HEAP_BYTES: u64 = 8 << 20;
pub(crate) const HEAP_BYTES_MAX: u64 = MAX_DESCRIPTORS * DESCRIPTOR + HEAP_BYTES;
/// Offset of the objects in a further segment; [`SLOTS_AT`] is the offset of the slots in a publisher's segment.
pub(crate) const HEAP_AT: u64 = 4096;
pub(crate) const SLOTS_AT: u64 = ALIGN;

/// Entries of a session's journal, which is in its first segment before the objects. Up to this many samples may come
/// between two looks of a follower; after more, the follower looks at all rings. So it looks at few rings for each
/// sample, however many rings there are.
pub(crate) const JOURNAL: usize = 2048;
/// Offset of the objects in a session's first segment.
pub(crate) const FIRST_AT: u64 = HEAP_AT + JOURNAL as u64 * 8;

/// The largest segment number: 24 bits.
pub(crate) const MAX_NUMBER: u32 = (1 << 24) - 1;
/// Descriptors of a new ring. A ring grows by doubling.
pub(crate) const FIRST_DESCRIPTORS: u64 = 16;
/// The most descriptors of a ring. A publish that doubles the array copies all readable descriptors; half a GiB is the
/// most that it may spend time on.
pub(crate) const MAX_DESCRIPTORS: u64 = 1 << 22;

pub(crate) const DESCRIPTOR: u64 = 128;
/// Words of a descriptor.
pub(crate) const DESCRIPTOR_WORDS: usize = DESCRIPTOR as usize / 8;
pub(crate) const LANE: u64 = 128;
/// Words of a lane.
pub(crate) const LANE_WORDS: usize = LANE as usize / 8;
pub(crate) const RING: u64 = 384;
/// Words of a ring's header.
#[cfg(test)]
pub(crate) const RING_WORDS: usize = RING as usize / 8;

const VERSION: u32 = 4;
/// Reads as another number on a machine of another byte order.
const ORDER: u32 = 0x0a0b_0c0d;
const SEGMENT_MAGIC: u64 = u64::from_ne_bytes(*b"AXONSEG2");
const RING_MAGIC: u64 = u64::from_ne_bytes(*b"AXONRNG2");

/// Words of a session's first segment.
pub(crate) mod session {
    /// Ticket of waits for samples.
    pub(crate) const ARMED: usize = 128 / 8;
    /// Ticket of waits for room.
    pub(crate) const BLOCKED: usize = 256 / 8;
    /// The number of entries that the journal has had.
    pub(crate) const NOTED: usize = 384 / 8;
    /// The entries of the journal.
    pub(crate) const JOURNAL: std::ops::Range<usize> =
        super::HEAP_AT as usize / 8..super::FIRST_AT as usize / 8;
}

/// Words of a lane.
pub(crate) mod lane {
    pub(crate) const GENERATION: usize = 0;
    pub(crate) const CURSOR: usize = 1;
    pub(crate) const RECEIVED: usize = 2;
    pub(crate) const LOST: usize = 3;
    pub(crate) const SKIPPED: usize = 4;
    /// The highest number of the publisher's segments that the reader has received. Lower numbers may be missing: the
    /// segments of other publishers are, and a segment for which the reader was short of something comes later.
    pub(crate) const MAPPED: usize = 5;
    /// The first of the pin records.
    pub(crate) const PINS: usize = 6;
    pub(crate) const READER: usize = 12;
    /// The source timestamp of the sample that was taken last.
    pub(crate) const TAKEN: usize = 14;
    /// The number of samples below the cursor that the reader gave up. The upper bits identify the attachment.
    pub(crate) const GIVEN_UP: usize = 15;
}

/// Words of a ring's header.
pub(crate) mod ring {
    pub(crate) const WRITER: usize = 2;
    /// The number of samples that are kept at least.
    pub(crate) const WINDOW: usize = 4;
    /// Bytes of the session's memory that the ring, its descriptors and its blocks take.
    pub(crate) const BYTES: usize = 5;
    /// Publishes that failed, by cause.
    pub(crate) const BLOCKED: usize = 6;
    pub(crate) const NO_MEMORY: usize = 7;
    pub(crate) const PINNED: usize = 8;
    /// The ring's number in its session. The journal names the ring by it.
    pub(crate) const NUMBER: usize = 9;
    /// Publishes that found no room because a KEEP_ALL reader had not taken the oldest sample, whether they waited or
    /// not.
    pub(crate) const REFUSED: usize = 10;
    pub(crate) const HEAD: usize = 128 / 8;
    /// The number of samples published, including those that had no reader.
    pub(crate) const PUBLISHED: usize = 136 / 8;
    /// When the publisher last asserted its liveliness, if its lease is finite.
    pub(crate) const ASSERTED: usize = 144 / 8;
    /// When the publisher last published, if its deadline is finite.
    pub(crate) const SAMPLED: usize = 152 / 8;
    pub(crate) const TAIL: usize = 256 / 8;
    /// The location and number of the descriptors.
    pub(crate) const ARRAY: usize = 264 / 8;
    /// The offered lease and lifespan in nanoseconds; 0 if infinite.
    pub(crate) const LEASE: usize = 272 / 8;
    pub(crate) const LIFESPAN: usize = 280 / 8;
}

/// The purpose of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SegmentKind {
    /// A session's first segment: the words for its wake-ups, and objects.
    Session,
    /// A further segment for objects.
    Heap,
    /// A segment for large samples of this publisher.
    Samples(Gid),
}

impl SegmentKind {
    fn number(self) -> u32 {
        match self {
            Self::Session => 0,
            Self::Heap => 1,
            Self::Samples(_) => 2,
        }
    }

    fn publisher(self) -> Gid {
        match self {
            Self::Session | Self::Heap => Gid([0; 16]),
            Self::Samples(gid) => gid,
        }
    }
}

/// The location of an object of a session.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, minicbor::Encode, minicbor::Decode,
)]
pub struct Location {
    /// The number of the session's segment.
    #[n(0)]
    pub segment: u32,
    /// The offset in the segment in bytes: a multiple of 128, except for a sample that was lent behind a header.
    #[n(1)]
    pub offset: u64,
}

impl Location {
    /// Returns the range of words of the `bytes` bytes at this location. Returns `None` if a segment of `limit` words
    /// does not contain them.
    pub(crate) fn words(&self, bytes: u64, limit: usize) -> Option<std::ops::Range<usize>> {
        if !self.offset.is_multiple_of(LINE) { None } else { self.words_of(bytes, limit) }
    }

    /// Like [`words`](Self::words), for bytes that may begin anywhere, also within a word.
    pub(crate) fn words_of(&self, bytes: u64, limit: usize) -> Option<std::ops::Range<usize>> {
        if self.offset < HEAP_AT {
            return None;
        }
        let start = usize::try_from(self.offset / 8).ok()?;
        let count = usize::try_from((self.offset % 8).checked_add(bytes)?.div_ceil(8)).ok()?;
        let end = start.checked_add(count).filter(|end| *end <= limit)?;
        Some(start..end)
    }
}

/// The location of a ring's descriptors. It is encoded in one word, so that growing the array takes one store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Array {
    pub(crate) at: Location,
    /// A power of two.
    pub(crate) descriptors: u64,
}

impl Array {
    pub(crate) fn word(&self) -> u64 {
        let log2 = u64::from(self.descriptors.trailing_zeros());
        u64::from(self.at.segment) << 40 | (self.at.offset / LINE) << 6 | log2
    }

    /// Decodes a word; `None` if it is invalid.
    pub(crate) fn from_word(word: u64) -> Option<Self> {
        let offset = (word >> 6 & ((1 << 34) - 1)) * LINE;
        let descriptors = 1u64.checked_shl((word & 63) as u32)?;
        let at = Location { segment: (word >> 40) as u32, offset };
        (2..=MAX_DESCRIPTORS).contains(&descriptors).then_some(Self { at, descriptors })
    }
}

pub(crate) fn write_id(words: &[AtomicU64], at: usize, id: [u8; 16]) {
    for (word, half) in words[at..].iter().zip(id.as_chunks::<8>().0) {
        word.store(u64::from_ne_bytes(*half), Ordering::Relaxed);
    }
}

fn read_id(words: &[AtomicU64], at: usize) -> [u8; 16] {
    let mut id = [0; 16];
    for (half, word) in id.as_chunks_mut::<8>().0.iter_mut().zip(&words[at..]) {
        *half = word.load(Ordering::Relaxed).to_ne_bytes();
    }
    id
}

/// Writes the header of a new segment, before any other process has its descriptor.
pub(crate) fn write_segment(
    words: &[AtomicU64],
    session: SessionId,
    number: u32,
    kind: SegmentKind,
) {
    let pair = |low: u32, high: u32| u64::from(low) | u64::from(high) << 32;
    words[0].store(SEGMENT_MAGIC, Ordering::Relaxed);
    words[1].store(pair(VERSION, ORDER), Ordering::Relaxed);
    write_id(words, 2, session.0);
    words[4].store(pair(number, kind.number()), Ordering::Relaxed);
    words[5].store(words.len() as u64 * 8, Ordering::Relaxed);
    write_id(words, 6, kind.publisher().0);
}

/// Checks that another session's segment has the properties that were announced.
pub(crate) fn check_segment(
    words: &[AtomicU64],
    session: SessionId,
    number: u32,
    kind: SegmentKind,
) -> Result<(), ShmError> {
    let refuse = |what| Err(ShmError::Refused { what });
    if words[0].load(Ordering::Relaxed) != SEGMENT_MAGIC {
        return refuse("it is not a segment of AXON");
    }
    let (version, order) = halves(words[1].load(Ordering::Relaxed));
    if order != ORDER {
        return refuse("it was written in another byte order");
    }
    if version != VERSION {
        return refuse("it is laid out by another version of AXON");
    }
    if read_id(words, 2) != session.0 {
        return refuse("it belongs to another session");
    }
    if halves(words[4].load(Ordering::Relaxed)) != (number, kind.number()) {
        return refuse("it is another one of the session's segments");
    }
    if words[5].load(Ordering::Relaxed) != words.len() as u64 * 8 {
        return refuse("it is not as large as it says");
    }
    if read_id(words, 6) != kind.publisher().0 {
        return refuse("it belongs to another publisher");
    }
    Ok(())
}

/// Writes the header of an empty ring that no reader knows yet.
pub(crate) fn write_ring(words: &[AtomicU64], writer: Gid, number: u32, array: &Array) {
    words.iter().for_each(|word| word.store(0, Ordering::Relaxed));
    write_id(words, ring::WRITER, writer.0);
    words[ring::NUMBER].store(number.into(), Ordering::Relaxed);
    words[ring::ARRAY].store(array.word(), Ordering::Relaxed);
    words[0].store(RING_MAGIC, Ordering::Relaxed);
}

/// Checks the header of another process's ring.
pub(crate) fn check_ring(words: &[AtomicU64], writer: Gid) -> Result<(), ShmError> {
    let refuse = |what| Err(ShmError::Refused { what });
    if words[0].load(Ordering::Relaxed) != RING_MAGIC {
        return refuse("it has no ring there");
    }
    if read_id(words, ring::WRITER) != writer.0 {
        return refuse("the ring belongs to another publisher");
    }
    Ok(())
}

/// Splits a word into two 32-bit fields, the lower one first.
pub(crate) fn halves(word: u64) -> (u32, u32) {
    (word as u32, (word >> 32) as u32)
}
