//! The free memory of a segment for large samples. Plain data that only the publisher uses.
//!
//! A returned slot goes on top of the list of its [class](super::classes), and the next sample of that class takes
//! it from there, because its memory is warm in the caches. If the list is empty, the allocator takes backed memory
//! that is in no list, then a slot of one of the next larger classes. Only if all of that fails does it empty the
//! lists, join adjacent ranges, and take the lowest range that is large enough, so that memory grows last.
//!
//! Slots that fit in a core's own cache are also [used in rotation](SegmentSlots::take_turn). If the publisher wrote to
//! the slot that was read last, each cache line would first have to move from the reader's core.

use std::ops::Range;

use crate::alloc::{
    area::Area,
    classes::{self, CLASSES},
};

/// Number of next larger classes whose free slots may be used: slots up to twice as large.
const HELPERS: usize = 4;
/// Number of slots that rotate.
pub(crate) const TURNS: u32 = 4;
/// Largest slot that rotates, in bytes. Above it, four buffers cost more than waiting.
const TURNING: u64 = 512 << 10;

/// The slots of one segment.
#[derive(Clone, Debug)]
pub(crate) struct SegmentSlots {
    /// Free slots by class, the one that was released last on top.
    free: Vec<Vec<u64>>,
    /// The ranges that are in no slot.
    rest: Area,
    /// Slots in use that are of a larger class than their samples: start and class.
    larger: Vec<(u64, usize)>,
    /// The lowest start of a slot.
    start: u64,
    /// The end of the memory that is backed.
    backed: u64,
    /// True if a slot could once not be backed.
    short: bool,
    /// Bytes of the slots in use.
    used: u64,
}

impl SegmentSlots {
    /// Creates the slots of `range`, none of which is backed by memory. Up to `pieces` free ranges are expected at a
    /// time.
    pub(crate) fn new(range: Range<u64>, pieces: usize) -> Self {
        Self {
            free: vec![Vec::new(); CLASSES],
            start: range.start,
            backed: range.start,
            short: false,
            rest: Area::new(range, pieces),
            larger: Vec::new(),
            used: 0,
        }
    }

    /// Takes a slot for `len` bytes and returns its start. Prefers backed memory. Other memory must be
    /// [backed](Self::back) before it is used.
    pub(crate) fn take(&mut self, len: u64) -> Option<u64> {
        let class = classes::class(len);
        let bytes = classes::size(class);
        let at = self.free[class]
            .pop()
            .or_else(|| self.cut_backed(bytes))
            .or_else(|| self.borrow(class))
            .or_else(|| {
                self.join();
                self.rest.allocate(bytes)
            })?;
        self.used += self.size_of(at, class);
        Some(at)
    }

    /// Like [`take`](Self::take), for slots that rotate, without effects on other slots: takes a free slot of the
    /// class, or memory that is in no list. Memory grows until there are as many slots as rotate, unless memory was
    /// short once.
    pub(crate) fn take_turn(&mut self, len: u64) -> Option<u64> {
        let class = classes::class(len);
        let bytes = classes::size(class);
        if bytes > TURNING {
            return None;
        }
        let first = if self.short { 0 } else { self.start + u64::from(TURNS) * bytes };
        let at = self.free[class]
            .pop()
            .or_else(|| self.rest.allocate_below(self.backed.max(first), bytes))?;
        self.used += bytes;
        Some(at)
    }

    /// Releases the slot at `at`, which was taken for `len` bytes.
    pub(crate) fn release(&mut self, at: u64, len: u64) {
        let mut class = classes::class(len);
        if let Some(index) = self.larger.iter().position(|&(start, _)| start == at) {
            (_, class) = self.larger.swap_remove(index);
        }
        self.used -= classes::size(class);
        self.free[class].push(at);
    }

    /// Releases the slot at `at`, which was taken for `len` bytes and could not be backed.
    pub(crate) fn release_unbacked(&mut self, at: u64, len: u64) {
        // The slot came from memory that is in no list. In a list it would be the next slot to be tried.
        let bytes = classes::rounded(len);
        self.used -= bytes;
        self.rest.release(at, bytes);
        self.short = true;
    }

    /// Returns whether a free slot of the class of `len` bytes is ready.
    pub(crate) fn has_another(&self, len: u64) -> bool {
        !self.free[classes::class(len)].is_empty()
    }

    /// Returns the end of the memory that is backed.
    pub(crate) fn backed(&self) -> u64 {
        self.backed
    }

    /// Records that memory is backed up to `end`.
    pub(crate) fn back(&mut self, end: u64) {
        self.backed = self.backed.max(end);
    }

    /// Returns the end of the slot at `at`, which was taken for `len` bytes.
    pub(crate) fn end(&self, at: u64, len: u64) -> u64 {
        at + self.size_of(at, classes::class(len))
    }

    /// Returns the bytes of the slots in use.
    pub(crate) fn used(&self) -> u64 {
        self.used
    }

    /// Takes a slot from backed memory that is in no list.
    fn cut_backed(&mut self, bytes: u64) -> Option<u64> {
        self.rest.allocate_below(self.backed, bytes)
    }

    /// Takes the smallest free slot of the next larger classes.
    fn borrow(&mut self, class: usize) -> Option<u64> {
        let helpers = class + 1..CLASSES.min(class + 1 + HELPERS);
        let (helper, at) =
            helpers.into_iter().find_map(|helper| Some((helper, self.free[helper].pop()?)))?;
        self.larger.push((at, helper));
        Some(at)
    }

    /// Empties all lists into `rest`.
    fn join(&mut self) {
        for (class, list) in self.free.iter_mut().enumerate() {
            for at in list.drain(..) {
                self.rest.release(at, classes::size(class));
            }
        }
    }

    fn size_of(&self, at: u64, class: usize) -> u64 {
        let larger = self.larger.iter().find(|&&(start, _)| start == at);
        classes::size(larger.map_or(class, |&(_, class)| class))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MIB: u64 = 1 << 20;

    fn slots(bytes: u64) -> SegmentSlots {
        SegmentSlots::new(0..bytes, 16)
    }

    /// Takes a slot and backs it, as a publisher does.
    fn take(slots: &mut SegmentSlots, len: u64) -> Option<u64> {
        let at = slots.take(len)?;
        slots.back(slots.end(at, len));
        Some(at)
    }

    #[test]
    fn the_slot_that_came_back_last_goes_first() {
        let mut slots = slots(16 * MIB);
        let [first, second, third] = [(); 3].map(|()| take(&mut slots, MIB).unwrap());
        slots.release(second, MIB);
        slots.release(first, MIB);
        slots.release(third, MIB);
        assert_eq!([(); 3].map(|()| take(&mut slots, MIB - 9).unwrap()), [third, first, second]);
        assert_eq!(slots.backed(), 3 * MIB);
    }

    #[test]
    fn four_small_slots_take_turns() {
        let len = 64 << 10;
        let mut slots = slots(16 * MIB);
        let first: Vec<_> = (0..4).map(|_| slots.take_turn(len).unwrap()).collect();
        assert_eq!(slots.end(first[3], len), 4 * len);
        slots.back(4 * len);
        assert_eq!(slots.take_turn(len), None, "memory grows no further for that");
        // The publisher reclaims them newest first.
        first.iter().rev().for_each(|at| slots.release(*at, len));
        let again: Vec<_> = (0..4).map(|_| slots.take_turn(len).unwrap()).collect();
        assert_eq!(again, first);
        assert_eq!(slots.take_turn(MIB), None, "a large one is best written where it is warm");
    }

    #[test]
    fn memory_that_is_short_does_not_grow_for_turns() {
        let len = 64 << 10;
        let mut slots = slots(16 * MIB);
        let low = take(&mut slots, len).unwrap();
        let unbacked = slots.take_turn(len).unwrap();
        slots.release_unbacked(unbacked, len);
        assert_eq!(slots.take_turn(len), None);
        slots.release(low, len);
        assert_eq!((slots.take_turn(len), slots.used()), (Some(low), len));
    }

    #[test]
    fn a_larger_slot_helps_out_before_memory_grows_and_goes_back_to_its_class() {
        let mut slots = slots(64 * MIB);
        let large = take(&mut slots, 2 * MIB).unwrap();
        slots.release(large, 2 * MIB);
        assert_eq!(take(&mut slots, MIB + MIB / 4), Some(large));
        assert_eq!(slots.used(), 2 * MIB);
        slots.release(large, MIB + MIB / 4);
        assert_eq!(take(&mut slots, 2 * MIB), Some(large));
        assert_eq!((slots.used(), slots.backed()), (2 * MIB, 2 * MIB));
    }

    #[test]
    fn small_slots_that_touch_make_a_large_one_before_memory_grows() {
        let mut slots = slots(64 * MIB);
        let small: Vec<_> = (0..8).map(|_| take(&mut slots, MIB).unwrap()).collect();
        for at in small {
            slots.release(at, MIB);
        }
        assert_eq!(take(&mut slots, 7 * MIB), Some(0));
        assert_eq!(take(&mut slots, MIB), Some(7 * MIB));
        assert_eq!(slots.backed(), 8 * MIB);
    }

    #[test]
    fn a_full_segment_says_so_and_goes_on() {
        let mut slots = slots(4 * MIB);
        assert_eq!(slots.take(5 * MIB), None);
        let all: Vec<_> = (0..4).map(|_| take(&mut slots, MIB).unwrap()).collect();
        assert_eq!(slots.take(1), None);
        slots.release(all[2], MIB);
        assert_eq!(slots.take(8192).map(|at| at / MIB), Some(2), "of the next free memory");
    }

    #[test]
    fn backed_slots_are_taken_before_unbacked_ones() {
        let mut slots = slots(64 * MIB);
        let [low, high] = [(); 2].map(|()| take(&mut slots, 4 * MIB).unwrap());
        let unbacked = slots.take(MIB).unwrap();
        assert!(slots.end(unbacked, MIB) > slots.backed());
        slots.release_unbacked(unbacked, MIB);
        slots.release(low, 4 * MIB);
        assert_eq!(slots.take(MIB), Some(low));
        slots.release(low, MIB);
        slots.release(high, 4 * MIB);
        assert_eq!(slots.take(64 * MIB), Some(0), "all of it comes back");
    }

    #[test]
    fn one_slot_serves_a_window_of_one() {
        let mut slots = slots(1 << 30);
        let len = 25 << 20;
        let mut last = take(&mut slots, len).unwrap();
        for _ in 0..1000 {
            let next = take(&mut slots, len).unwrap();
            slots.release(last, len);
            last = next;
        }
        assert_eq!(slots.backed(), 2 * classes::rounded(len));
    }

    proptest! {
        /// For any sequence of sizes and turns, no two slots overlap, no memory is lost, and backed memory stays within
        /// a small multiple of the peak use.
        #[test]
        fn slots_never_overlap_and_all_comes_back(
            turns in proptest::collection::vec((4097u64..3 << 20, any::<prop::sample::Index>(), 0usize..12), 1..300),
        ) {
            let size = 1 << 30;
            let mut slots = slots(size);
            let mut live: Vec<(u64, u64)> = Vec::new();
            let mut peak = 0;
            for (len, index, keep) in turns {
                let at = take(&mut slots, len).expect("far more room than is ever used");
                let end = slots.end(at, len);
                prop_assert!(at.is_multiple_of(classes::PAGE) && end - at >= len && end <= size);
                for &(other, length) in &live {
                    prop_assert!(end <= other || slots.end(other, length) <= at);
                }
                live.push((at, len));
                peak = peak.max(slots.used());
                while live.len() > keep {
                    let (at, len) = live.swap_remove(index.index(live.len()));
                    slots.release(at, len);
                }
            }
            prop_assert!(slots.backed() <= 4 * peak.max(MIB), "{} of {peak}", slots.backed());
            for (at, len) in live.drain(..) {
                slots.release(at, len);
            }
            prop_assert_eq!(slots.used(), 0);
            prop_assert!(slots.larger.is_empty());
            slots.join();
            prop_assert_eq!(slots.rest.allocate(size), Some(0));
        }
    }
}
