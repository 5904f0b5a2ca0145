//! Reads the counters of rings and lanes from a segment's descriptor, without mapping the segment. The daemon uses
//! it for `axon status`. Another process wrote the values, so they are not trusted.

use std::os::fd::BorrowedFd;

use crate::ring::{
    layout::{
        self, Array, DESCRIPTOR, DESCRIPTOR_WORDS, LANE_WORDS, Location,
        lane::{CURSOR, LOST, RECEIVED, SKIPPED, TAKEN},
        ring::{ARRAY, BLOCKED, BYTES, HEAD, NO_MEMORY, PINNED, PUBLISHED, TAIL, WINDOW},
    },
    protocol,
};

/// The header of a ring.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RingCounts {
    /// The number of samples published, including those that had no reader.
    pub published: u64,
    /// The oldest readable position, and the next position to be published.
    pub standing: (u64, u64),
    /// The number of samples that are kept at least.
    pub window: u64,
    /// Bytes of the session's memory that the ring takes, without the publisher's own segments.
    pub bytes: u64,
    /// Publishes that failed because a KEEP_ALL reader left no room during the whole time that they could wait.
    pub blocked: u64,
    /// Publishes that failed for lack of memory, and samples that were dropped for lack of it although they had to be
    /// kept: for late joiners, or within the depth of a reader.
    pub no_memory: u64,
    /// Publishes that failed because readers or loans hold all of the publisher's memory.
    pub pinned: u64,
    array: Option<Array>,
}

impl RingCounts {
    /// Reads the header at `at` of the segment behind `memory`; `None` if that fails.
    pub fn read(memory: BorrowedFd<'_>, at: Location) -> Option<Self> {
        let words: [u64; layout::RING as usize / 8] = words(memory, at.offset)?;
        Some(Self {
            published: words[PUBLISHED],
            standing: (words[TAIL], words[HEAD]),
            window: words[WINDOW],
            bytes: words[BYTES],
            blocked: words[BLOCKED],
            no_memory: words[NO_MEMORY],
            pinned: words[PINNED],
            array: Array::from_word(words[ARRAY]),
        })
    }

    /// Returns the location of the descriptor of the sample at `position`.
    pub fn descriptor(&self, position: u64) -> Option<Location> {
        let Array { at, descriptors } = self.array?;
        let offset = at.offset.checked_add((position & (descriptors - 1)) * DESCRIPTOR)?;
        Some(Location { segment: at.segment, offset })
    }
}

/// Returns the source timestamp of the sample at `position`, whose descriptor is at `at` of the segment behind
/// `memory`. Returns `None` if the descriptor holds another sample or cannot be read.
pub fn timestamp(memory: BorrowedFd<'_>, at: Location, position: u64) -> Option<i64> {
    let words: [u64; DESCRIPTOR_WORDS] = words(memory, at.offset)?;
    protocol::timestamp_of(&words, position)
}

/// The counters of a lane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LaneCounts {
    /// The next position that the reader takes.
    pub cursor: u64,
    /// Samples taken.
    pub received: u64,
    /// Samples overwritten before they could be taken, within the subscription's depth.
    pub lost: u64,
    /// Samples passed over because more recent ones fill the subscription's depth.
    pub skipped: u64,
    /// The source timestamp of the sample that was taken last.
    pub taken: Option<i64>,
}

impl LaneCounts {
    /// Reads the lane at `at` of the segment behind `memory`; `None` if that fails.
    pub fn read(memory: BorrowedFd<'_>, at: Location) -> Option<Self> {
        let words: [u64; LANE_WORDS] = words(memory, at.offset)?;
        let received = words[RECEIVED];
        Some(Self {
            cursor: words[CURSOR],
            received,
            lost: words[LOST],
            skipped: words[SKIPPED],
            taken: (received > 0).then_some(words[TAKEN].cast_signed()),
        })
    }
}

/// Returns the bytes of memory that are committed to the segment behind `memory`.
pub fn committed(memory: BorrowedFd<'_>) -> u64 {
    let blocks = rustix::fs::fstat(memory).map_or(0, |stat| stat.st_blocks);
    u64::try_from(blocks).unwrap_or(0).saturating_mul(512)
}

fn words<const N: usize>(memory: BorrowedFd<'_>, offset: u64) -> Option<[u64; N]> {
    let mut bytes = [[0; 8]; N];
    let read = rustix::io::pread(memory, bytes.as_flattened_mut(), offset).ok()?;
    (read == N * 8).then(|| bytes.map(u64::from_ne_bytes))
}
