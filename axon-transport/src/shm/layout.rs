//! Where things are in the segments, in words of eight bytes (`docs/formats.md`, shared memory).

use std::sync::atomic::AtomicU64;

use super::{ShmError, pins::RECORDS, ring::Geometry, sync::Ordering};
use crate::ids::{Gid, SessionId};

/// Segments are multiples of this many bytes, and memory is committed in them.
pub(super) const ALIGN: u64 = 64 << 10;
/// The largest message in bytes: its length has 32 bits, rounded down to a sample's alignment.
pub(super) const MAX_MESSAGE: u64 = u32::MAX as u64 & !(GRANULE - 1);
/// The most address space that one segment may take, in bytes.
pub(super) const MAX_RING: u64 = 64 << 30;
/// The most history that a ring may be asked to keep, in bytes: up to four times this is mapped.
pub(super) const MAX_BUDGET: u64 = MAX_RING / 4;
/// Samples in the payload area start at multiples of this many bytes.
pub(super) const GRANULE: u64 = 64;
/// Samples of more bytes than this are pinned while they are read, others are copied out.
pub(super) const COPIED: u64 = 4096;
/// Bytes of a sample that fit in its slot.
pub(super) const INLINE: usize = 96;
/// Lanes of a session: how many rings it can read at a time.
pub(super) const LANES: u32 = 4096;

const VERSION: u64 = 2;
const HEADER: u64 = 4096;
const SLOT: u64 = 128;
const LANE: u64 = 128;
/// Words of a lane.
pub(super) const LANE_WORDS: usize = LANE as usize / 8;
const MAX_SLOTS: u64 = 1 << 20;

const SESSION_MAGIC: u64 = u64::from_ne_bytes(*b"AXONSES1");
const RING_MAGIC: u64 = u64::from_ne_bytes(*b"AXONRNG1");

/// Words of a session segment.
pub(super) mod session {
    /// Ticket of the wait for samples.
    pub(in crate::shm) const ARMED: usize = 128 / 8;
    /// Ticket of the wait for room.
    pub(in crate::shm) const BLOCKED: usize = 256 / 8;
}

/// Words of a lane.
pub(super) mod lane {
    pub(in crate::shm) const GENERATION: usize = 0;
    pub(in crate::shm) const CURSOR: usize = 1;
    pub(in crate::shm) const RECEIVED: usize = 2;
    pub(in crate::shm) const LOST: usize = 3;
    pub(in crate::shm) const SKIPPED: usize = 4;
    /// The first of the pin records.
    pub(in crate::shm) const PINS: usize = 6;
    pub(in crate::shm) const READER: usize = 12;
    pub(in crate::shm) const WRITER: usize = 14;
}

pub(super) const fn session_bytes() -> u64 {
    (HEADER + LANES as u64 * LANE).next_multiple_of(ALIGN)
}

/// The words of lane `index`.
pub(super) fn lane_words(words: &[AtomicU64], index: u32) -> &[AtomicU64; LANE_WORDS] {
    let start = HEADER as usize / 8 + index as usize * LANE_WORDS;
    words[start..].first_chunk().expect("the number of lanes was checked")
}

/// Bytes that must be committed for lane `index`.
pub(super) fn lane_end(index: u32) -> u64 {
    HEADER + (u64::from(index) + 1) * LANE
}

pub(super) fn write_id(words: &[AtomicU64], at: usize, id: [u8; 16]) {
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

pub(super) fn write_session(words: &[AtomicU64], id: SessionId) {
    words[1].store(VERSION | u64::from(LANES) << 32, Ordering::Relaxed);
    write_id(words, 2, id.0);
    words[0].store(SESSION_MAGIC, Ordering::Release);
}

/// Checks another session's header and returns its number of lanes.
pub(super) fn read_session(words: &[AtomicU64], id: SessionId) -> Result<u32, ShmError> {
    let refuse = |what| Err(ShmError::Refused { what });
    if words[0].load(Ordering::Acquire) != SESSION_MAGIC {
        return refuse("it is not a session segment");
    }
    let (version, lanes) = halves(words[1].load(Ordering::Relaxed));
    if u64::from(version) != VERSION {
        return refuse("its version is another one");
    }
    if HEADER + u64::from(lanes) * LANE > words.len() as u64 * 8 {
        return refuse("its lanes do not fit in it");
    }
    if read_id(words, 2) != id.0 {
        return refuse("it belongs to another session");
    }
    Ok(lanes)
}

/// How a ring is laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct RingLayout {
    slots: u64,
    payload_at: u64,
    payload_bytes: u64,
    /// Of these, the first for samples that readers copy. No reader needs to know.
    copied_bytes: u64,
}

impl RingLayout {
    /// A ring of at least `slots` slots, for a history of `budget` bytes of samples of at most
    /// `max_message` bytes. All of it is address space, not memory.
    pub(super) fn new(slots: u64, budget: u64, max_message: u64) -> Self {
        let slots = slots.next_power_of_two().min(MAX_SLOTS);
        let payload_at = (HEADER + slots * SLOT).next_multiple_of(ALIGN);
        // Twice the budget, so that pieces between samples seldom shorten the history.
        let copied_bytes = (2 * budget).min(2 * COPIED * slots).max(1).next_multiple_of(ALIGN);
        // Room for four of the largest, so that one of them always fits beside one that stands;
        // and for as many as two readers can pin.
        let largest = max_message.max(1).next_multiple_of(GRANULE);
        let pinned = (4 * largest).max(2 * budget) + 2 * RECORDS as u64 * largest;
        let pinned = pinned.next_multiple_of(ALIGN).min(MAX_RING - payload_at - copied_bytes);
        Self { slots, payload_at, payload_bytes: copied_bytes + pinned, copied_bytes }
    }

    pub(super) fn slots(&self) -> u64 {
        self.slots
    }

    pub(super) fn payload_at(&self) -> u64 {
        self.payload_at
    }

    pub(super) fn payload_bytes(&self) -> u64 {
        self.payload_bytes
    }

    pub(super) fn copied_bytes(&self) -> u64 {
        self.copied_bytes
    }

    pub(super) fn bytes(&self) -> u64 {
        self.payload_at + self.payload_bytes
    }

    /// Bytes that must be committed for the slot of `position`.
    pub(super) fn slot_end(&self, position: u64) -> u64 {
        HEADER + ((position & (self.slots - 1)) + 1) * SLOT
    }

    pub(super) fn geometry(&self) -> Geometry {
        Geometry {
            head: 128 / 8,
            tail: 256 / 8,
            slots: HEADER as usize / 8,
            mask: self.slots - 1,
            payload: self.payload_at as usize / 8,
            payload_words: self.payload_bytes as usize / 8,
        }
    }

    pub(super) fn write(&self, words: &[AtomicU64], writer: Gid) {
        words[1].store(VERSION | self.slots << 32, Ordering::Relaxed);
        words[2].store(self.payload_at, Ordering::Relaxed);
        words[3].store(self.payload_bytes, Ordering::Relaxed);
        write_id(words, 4, writer.0);
        words[0].store(RING_MAGIC, Ordering::Release);
    }

    /// Checks another process's ring and copies its layout.
    pub(super) fn read(words: &[AtomicU64], writer: Gid) -> Result<Self, ShmError> {
        let refuse = |what| Err(ShmError::Refused { what });
        if words[0].load(Ordering::Acquire) != RING_MAGIC {
            return refuse("it is not a ring");
        }
        let (version, slots) = halves(words[1].load(Ordering::Relaxed));
        if u64::from(version) != VERSION {
            return refuse("its version is another one");
        }
        let slots = u64::from(slots);
        if !slots.is_power_of_two() || !(2..=MAX_SLOTS).contains(&slots) {
            return refuse("its number of slots is absurd");
        }
        let payload_at = words[2].load(Ordering::Relaxed);
        let payload_bytes = words[3].load(Ordering::Relaxed);
        let fits = payload_at >= HEADER + slots * SLOT
            && payload_at.is_multiple_of(GRANULE)
            && payload_bytes.is_multiple_of(GRANULE)
            && payload_at
                .checked_add(payload_bytes)
                .is_some_and(|end| end <= words.len() as u64 * 8);
        if !fits {
            return refuse("its payload area does not fit in it");
        }
        if read_id(words, 4) != writer.0 {
            return refuse("it belongs to another publisher");
        }
        Ok(Self { slots, payload_at, payload_bytes, copied_bytes: 0 })
    }
}

/// Two 32-bit fields that share a word.
pub(super) fn halves(word: u64) -> (u32, u32) {
    (word as u32, (word >> 32) as u32)
}
