//! The ring's protocol over plain words: what a publisher stores and what a reader believes.
//!
//! A reader copies first and checks afterwards, except for large samples, which it
//! [pins](super::pins). The publisher raises the tail above a position before it reuses that
//! position's slot or payload; a reader that finds the tail still at or below its position after
//! the copy has copied what was published. The head orders all that a sample consists of; a slot's
//! stamp only tells a scribbled ring from an honest one.

use std::ops::Range;

use super::sync::{Ordering, Site, Word, fence_at};

/// Words of a slot.
pub(super) const SLOT_WORDS: usize = 16;
const STAMP: usize = 0;
const SEQUENCE: usize = 1;
const TIMESTAMP: usize = 2;
const LENGTH: usize = 3;
const DATA: usize = 4;
const FLAG_INLINE: u32 = 1;
const INLINE_WORDS: usize = SLOT_WORDS - DATA;

/// No ring gets this far; a head beyond it was scribbled.
const MAX_POSITION: u64 = 1 << 62;

/// Where things are, as indices of words.
#[derive(Clone, Copy, Debug)]
pub(super) struct Geometry {
    pub(super) head: usize,
    pub(super) tail: usize,
    pub(super) slots: usize,
    /// Number of slots, less one.
    pub(super) mask: u64,
    pub(super) payload: usize,
    pub(super) payload_words: usize,
}

impl Geometry {
    fn slot<'a, W>(&self, words: &'a [W], position: u64) -> &'a [W] {
        let start = self.slots + (position & self.mask) as usize * SLOT_WORDS;
        &words[start..start + SLOT_WORDS]
    }

    /// The words of `len` bytes at `offset` bytes of the payload area, if they are inside it.
    pub(super) fn payload<'a, W>(&self, words: &'a [W], offset: u64, len: u64) -> Option<&'a [W]> {
        words.get(self.range(offset, len)?)
    }

    /// Where the words of a record that is not in its slot are, if they are inside the area.
    pub(super) fn placed<W>(&self, words: &[W], record: &Record) -> Option<Range<usize>> {
        let Place::At(offset) = record.place else { return None };
        self.range(offset, u64::from(record.len)).filter(|range| range.end <= words.len())
    }

    fn range(&self, offset: u64, len: u64) -> Option<Range<usize>> {
        let start = usize::try_from(offset / 8).ok()?;
        let count = usize::try_from(len.div_ceil(8)).ok()?;
        let end = start.checked_add(count).filter(|end| *end <= self.payload_words)?;
        Some(self.payload.checked_add(start)?..self.payload.checked_add(end)?)
    }
}

/// Where a sample's bytes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// In the slot.
    Inline,
    /// At this offset of the payload area, in bytes.
    At(u64),
}

/// What a slot says of its sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) sequence: u64,
    pub(super) timestamp: i64,
    pub(super) len: u32,
    pub(super) place: Place,
}

/// Publisher: positions below `tail` are about to be reused.
pub(super) fn retire<W: Word>(words: &[W], g: &Geometry, tail: u64) {
    // Pairs with `bounds`: a reader that sees this tail sees a head at least as high.
    words[g.tail].store(tail, Site::TailStore.order());
}

/// Publisher: stores to slots or payload follow on this thread. Whoever sees one of them sees the
/// tail that was retired before, by this thread or one that this thread synchronized with.
#[inline]
pub(super) fn about_to_write<W: Word>() {
    // Pairs with the acquire fence of `stands`.
    fence_at::<W>(Site::ReuseFence);
}

/// Publisher: makes `position` visible, after [`about_to_write`]. A sample outside the slot has
/// been copied in already.
pub(super) fn publish<W: Word>(
    words: &[W],
    g: &Geometry,
    position: u64,
    record: &Record,
    inline: &[u8],
) {
    let slot = g.slot(words, position);
    slot[STAMP].store(2 * position + 1, Ordering::Relaxed);
    slot[SEQUENCE].store(record.sequence, Ordering::Relaxed);
    slot[TIMESTAMP].store(record.timestamp.cast_unsigned(), Ordering::Relaxed);
    let flags = match record.place {
        Place::Inline => {
            copy_in(&slot[DATA..], inline);
            FLAG_INLINE
        }
        Place::At(offset) => {
            slot[DATA].store(offset, Ordering::Relaxed);
            0
        }
    };
    slot[LENGTH].store(u64::from(record.len) | u64::from(flags) << 32, Ordering::Relaxed);
    slot[STAMP].store(2 * position + 2, Ordering::Relaxed);
    // Pairs with `bounds`: whoever sees the head sees the sample.
    words[g.head].store(position + 1, Site::HeadStore.order());
}

/// Reader: the oldest position that stands and the next position to come.
pub(super) fn bounds<W: Word>(words: &[W], g: &Geometry) -> Result<(u64, u64), &'static str> {
    // In this order: a tail is never above the head that a later load sees.
    let tail = words[g.tail].load(Site::TailLoad.order());
    let head = words[g.head].load(Site::HeadLoad.order());
    if tail > head || head > MAX_POSITION {
        return Err("its head and tail make no sense");
    }
    Ok((tail, head))
}

/// Reader: what a look at a published position gave.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Look {
    Sample(Record),
    /// The publisher has reused the slot: look at the tail again.
    Lapped,
    Corrupt(&'static str),
}

/// Reader: the record at `position`, which is below the head. Good only if [`stands`] afterwards.
pub(super) fn look<W: Word>(words: &[W], g: &Geometry, position: u64) -> Look {
    let slot = g.slot(words, position);
    if slot[STAMP].load(Ordering::Relaxed) != 2 * position + 2 {
        return if stands(words, g, position) {
            Look::Corrupt("a slot that stands carries another position")
        } else {
            Look::Lapped
        };
    }
    let sequence = slot[SEQUENCE].load(Ordering::Relaxed);
    let timestamp = slot[TIMESTAMP].load(Ordering::Relaxed).cast_signed();
    let length = slot[LENGTH].load(Ordering::Relaxed);
    let offset = slot[DATA].load(Ordering::Relaxed);
    if !stands(words, g, position) {
        return Look::Lapped;
    }
    let (len, flags) = super::layout::halves(length);
    let place = if flags & FLAG_INLINE != 0 {
        if len as usize > INLINE_WORDS * 8 {
            return Look::Corrupt("a sample in a slot is longer than the slot");
        }
        Place::Inline
    } else {
        if !offset.is_multiple_of(8) || g.payload(words, offset, u64::from(len)).is_none() {
            return Look::Corrupt("a sample lies outside the payload area");
        }
        Place::At(offset)
    };
    Look::Sample(Record { sequence, timestamp, len, place })
}

/// Reader: the words of a record at `position`.
pub(super) fn data<'a, W>(
    words: &'a [W],
    g: &Geometry,
    position: u64,
    record: &Record,
) -> Option<&'a [W]> {
    match record.place {
        Place::Inline => g.slot(words, position).get(DATA..),
        Place::At(offset) => g.payload(words, offset, u64::from(record.len)),
    }
}

/// Reader: whether all that was loaded of `position` so far is what was published.
pub(super) fn stands<W: Word>(words: &[W], g: &Geometry, position: u64) -> bool {
    // Pairs with the release fence of `about_to_write`: had one of the loads before seen a reuse, the
    // load after sees the tail that was stored ahead of it.
    fence_at::<W>(Site::StandsFence);
    words[g.tail].load(Ordering::Relaxed) <= position
}

/// Copies `bytes` into words; the last is filled up with zeros.
pub(super) fn copy_in<W: Word>(words: &[W], bytes: &[u8]) {
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

/// Fills `out` with the bytes from `at` on, which are inside the words.
pub(super) fn read_at<W: Word>(words: &[W], at: usize, out: &mut [u8]) {
    let load = |index: usize| words[index].load(Ordering::Relaxed).to_ne_bytes();
    let mut next = at / 8;
    let skip = at % 8;
    let mut out = out;
    if skip > 0 && !out.is_empty() {
        let (first, rest) = out.split_at_mut(out.len().min(8 - skip));
        first.copy_from_slice(&load(next)[skip..][..first.len()]);
        out = rest;
        next += 1;
    }
    let (whole, rest) = out.as_chunks_mut::<8>();
    for chunk in whole {
        *chunk = load(next);
        next += 1;
    }
    if !rest.is_empty() {
        rest.copy_from_slice(&load(next)[..rest.len()]);
    }
}

/// Replaces `out` by the first `len` bytes of `words`.
///
/// # Errors
/// Memory for them is not to be had.
pub(super) fn copy_out<W: Word>(
    words: &[W],
    len: usize,
    out: &mut Vec<u8>,
) -> Result<(), std::collections::TryReserveError> {
    out.clear();
    out.try_reserve(len)?;
    let (whole, rest) = out.spare_capacity_mut()[..len].as_chunks_mut::<8>();
    let count = whole.len();
    for (chunk, word) in whole.iter_mut().zip(&words[..count]) {
        let bytes = word.load(Ordering::Relaxed).to_ne_bytes();
        for (to, from) in chunk.iter_mut().zip(bytes) {
            to.write(from);
        }
    }
    if !rest.is_empty() {
        let bytes = words[count].load(Ordering::Relaxed).to_ne_bytes();
        for (to, from) in rest.iter_mut().zip(bytes) {
            to.write(from);
        }
    }
    // SAFETY: within the reserved capacity, and the loops above wrote each of the `len` bytes:
    // `words[..count]` is as long as `whole`, and a word is longer than `rest`.
    unsafe { out.set_len(len) };
    Ok(())
}
