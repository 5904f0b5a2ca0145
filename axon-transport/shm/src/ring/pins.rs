//! Hazard pins over plain words: a reader keeps a large sample in place while it reads the sample, and the
//! publisher never waits for the reader.
//!
//! The reader stores the position in a record of its lane, fences, and loads the tail. If the tail is still at or below
//! the position, the sample stays until the record is cleared. The publisher raises the tail above the samples that it
//! wants to reuse, fences, and loads the records of every reader that may have a pin. It leaves pinned samples alone.
//!
//! The two fences have an order. If the reader's fence comes first, the publisher sees the pin, or a later
//! store of the same reader to that record. If the publisher's fence comes first, the reader sees the tail and gives
//! the sample up. So the publisher has seen every reader that continues.
//!
//! A pin names a position, not a place, and each position is used once: a stale pin has no effect.

use crate::{
    ring::layout::lane::PINS,
    sync::{Ordering, Site, Word, fence_at},
};

/// Pin records of a lane: the most samples of one publisher that a reader can pin.
pub(crate) const RECORDS: usize = 6;

/// Reader: returns a record, among the first `count`, that pins nothing. It stays free until this thread uses it,
/// because only one thread at a time pins, though any thread may unpin.
#[inline]
pub(crate) fn free<W: Word>(lane: &[W], count: usize) -> Option<usize> {
    let mut records = lane[PINS..PINS + count].iter();
    // Pairs with `unpin`: another thread's reads come before the pin that this thread stores in the record.
    records.position(|record| record.load(Site::FreeLoad.order()) == 0)
}

/// Reader: pins `position` in a free record. Returns false, without a pin, if the publisher has already given the
/// sample up.
#[inline]
pub(crate) fn pin<W: Word>(lane: &[W], record: usize, position: u64, tail: &W) -> bool {
    // Pairs with `scan`: a publisher that sees this pin knows that the sample pinned in this record before was read.
    lane[PINS + record].store(position + 1, Site::PinStore.order());
    // Pairs with the fence of `about_to_scan`.
    fence_at::<W>(Site::PinFence);
    if tail.load(Ordering::Relaxed) <= position {
        return true;
    }
    unpin(lane, record);
    false
}

/// Reader: clears the record. The pinned sample must not be read afterwards.
#[inline]
pub(crate) fn unpin<W: Word>(lane: &[W], record: usize) {
    // Pairs with `scan`: all reads come before the publisher's next write there. Also pairs with `free`.
    lane[PINS + record].store(0, Site::UnpinStore.order());
}

/// Publisher: fences after the tail has been raised above all positions to be reused. [`scan`] follows.
#[inline]
pub(crate) fn about_to_scan<W: Word>() {
    // Pairs with the fence of `pin`.
    fence_at::<W>(Site::ReclaimFence);
}

/// Publisher: returns the positions that a lane pins. Any other may be overwritten.
#[inline]
pub(crate) fn scan<W: Word>(lane: &[W]) -> impl Iterator<Item = u64> + '_ {
    lane[PINS..PINS + RECORDS].iter().filter_map(|record| {
        // Pairs with the stores of `pin` and `unpin`.
        record.load(Site::ScanLoad.order()).checked_sub(1)
    })
}
