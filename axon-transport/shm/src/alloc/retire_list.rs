//! The memory of a publisher's samples that readers read in place: samples that the publisher gave up stay in the
//! retire list until no reader pins them. Plain data, no shared memory.

use std::ops::Range;

use crate::{alloc::slots::SegmentSlots, ring::layout::Location};

/// Retired samples by segment. One segment at a time takes new samples. The publisher leaves a segment when it opens
/// another; the segment is [vacated](Self::vacated) once its last sample has been released.
#[derive(Clone, Debug, Default)]
pub(crate) struct RetireList {
    /// The last segment takes new samples, unless the publisher left it.
    stores: Vec<Store>,
    retired: Vec<Retired>,
    /// The number of loans that are not published yet.
    loans: u32,
}

/// One segment.
#[derive(Clone, Debug)]
struct Store {
    number: u32,
    slots: SegmentSlots,
    left: bool,
}

#[derive(Clone, Debug)]
struct Retired {
    position: u64,
    at: Location,
    len: u64,
    sample: u64,
}

impl RetireList {
    /// Adds a segment that takes new samples in `range`, and leaves the others.
    pub(crate) fn open(&mut self, number: u32, range: Range<u64>) {
        self.leave();
        self.stores.push(Store { number, slots: SegmentSlots::new(range, 16), left: false });
    }

    /// Leaves all segments: none takes new samples until another one is opened.
    pub(crate) fn leave(&mut self) {
        self.stores.iter_mut().for_each(|store| store.left = true);
    }

    /// Returns the slots of the segment at a loan's location.
    pub(crate) fn slots(&mut self, at: Location) -> &mut SegmentSlots {
        slots(&mut self.stores, at)
    }

    /// Returns the bytes in use of the segment that takes new samples, and the end of its backed memory.
    pub(crate) fn extent(&self) -> Option<(u64, u64)> {
        let store = self.stores.last().filter(|store| !store.left)?;
        Some((store.slots.used(), store.slots.backed()))
    }

    /// Returns the numbers of all segments.
    pub(crate) fn segments(&self) -> impl ExactSizeIterator<Item = u32> + '_ {
        self.stores.iter().map(|store| store.number)
    }

    /// Takes a free slot in the segment that takes new samples.
    pub(crate) fn take(&mut self, len: u64) -> Option<Location> {
        self.take_by(|slots| slots.take(len))
    }

    fn take_by(&mut self, take: impl FnOnce(&mut SegmentSlots) -> Option<u64>) -> Option<Location> {
        let store = self.stores.last_mut().filter(|store| !store.left)?;
        let offset = take(&mut store.slots)?;
        Some(Location { segment: store.number, offset })
    }

    /// Releases a slot that was not published.
    pub(crate) fn put_back(&mut self, at: Location, len: u64) {
        slots(&mut self.stores, at).release(at.offset, len);
    }

    /// Releases a slot that could not be backed by memory.
    pub(crate) fn release_unbacked(&mut self, at: Location, len: u64) {
        slots(&mut self.stores, at).release_unbacked(at.offset, len);
    }

    /// Takes a free slot for a loan. Uses a segment that was left only if no other has space.
    pub(crate) fn lend(&mut self, len: u64) -> Option<Location> {
        let at = self.take(len).or_else(|| {
            let mut left = self.stores.iter_mut().filter(|store| store.left);
            left.find_map(|store| {
                let offset = store.slots.take(len)?;
                Some(Location { segment: store.number, offset })
            })
        })?;
        self.loans += 1;
        Some(at)
    }

    /// Like [`lend`](Self::lend), as long as slots [rotate](SegmentSlots::take_turn).
    pub(crate) fn lend_turn(&mut self, len: u64) -> Option<Location> {
        let at = self.take_by(|slots| slots.take_turn(len))?;
        self.loans += 1;
        Some(at)
    }

    /// Returns whether there would be space for `len` bytes if `samples` were given up, without the memory that readers
    /// pin. Counts only backed memory, unless the segments can `grow`.
    pub(crate) fn would_hold(
        &self,
        len: u64,
        samples: impl Iterator<Item = (Location, u64)>,
        grow: bool,
    ) -> bool {
        let mut stores = self.stores.clone();
        for (at, len) in samples {
            slots(&mut stores, at).release(at.offset, len);
        }
        stores.iter_mut().any(|Store { slots, .. }| {
            slots.take(len).is_some_and(|at| grow || slots.end(at, len) <= slots.backed())
        })
    }

    /// Releases a loan that was not published.
    pub(crate) fn give_back(&mut self, at: Location, len: u64) {
        self.put_back(at, len);
        self.loans -= 1;
    }

    /// Releases a loan for which there is no memory.
    pub(crate) fn withdraw(&mut self, at: Location, len: u64) {
        self.release_unbacked(at, len);
        self.loans -= 1;
    }

    /// Records that a loan was published.
    pub(crate) fn published(&mut self) {
        self.loans -= 1;
    }

    /// Adds the sample at `position`, of `sample` bytes in a slot of `len` bytes, which has been given up. Readers may
    /// still read it.
    pub(crate) fn retire(&mut self, position: u64, at: Location, len: u64, sample: u64) {
        self.retired.push(Retired { position, at, len, sample });
    }

    /// Frees the samples that no reader pins, by position and length. A reader's limit applies to the length of the
    /// sample, so a sample in a longer loan keeps the whole slot. The tail must have been raised above all retired
    /// positions before the pins were read.
    pub(crate) fn reclaim(&mut self, pinned: impl Fn(u64, u64) -> bool) {
        let keeps = |retired: &Retired| pinned(retired.position, retired.sample);
        // In reverse order, so that the slots that were read longest ago are reused first.
        for Retired { at, len, .. } in self.retired.iter().rev().filter(|retired| !keeps(retired)) {
            slots(&mut self.stores, *at).release(at.offset, *len);
        }
        self.retired.retain(keeps);
    }

    /// Returns the positions of samples that were given up and not reclaimed.
    pub(crate) fn retired(&self) -> impl ExactSizeIterator<Item = u64> + '_ {
        self.retired.iter().map(|retired| retired.position)
    }

    pub(crate) fn loans(&self) -> u32 {
        self.loans
    }

    /// Removes the segments that were left and hold no sample. Returns their numbers, each with the end of its backed
    /// memory.
    pub(crate) fn vacated(&mut self) -> Vec<(u32, u64)> {
        let vacant = |store: &Store| store.left && store.slots.used() == 0;
        let vacated = self.stores.iter().filter(|store| vacant(store));
        let vacated = vacated.map(|store| (store.number, store.slots.backed())).collect();
        self.stores.retain(|store| !vacant(store));
        vacated
    }
}

fn slots(stores: &mut [Store], at: Location) -> &mut SegmentSlots {
    let store = stores.iter_mut().find(|store| store.number == at.segment);
    // A segment is removed only once it holds nothing.
    &mut store.expect("the segment of what is in use").slots
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEN: u64 = 8192;

    #[test]
    fn a_segment_that_was_left_goes_with_the_last_that_it_holds() {
        let mut list = RetireList::default();
        list.open(1, 0..4 * LEN);
        let [sample, loan] = [(); 2].map(|()| list.lend(LEN).unwrap());
        list.published();
        list.open(2, 0..4 * LEN);
        assert_eq!(list.lend(LEN).unwrap().segment, 2, "the new one takes over");
        assert!(list.vacated().is_empty());

        list.retire(7, sample, LEN, LEN);
        list.reclaim(|position, _| position == 7);
        list.give_back(loan, LEN);
        assert!(list.vacated().is_empty(), "a reader is still at it");
        list.reclaim(|_, _| false);
        assert_eq!(list.vacated(), [(1, 0)], "nothing of it was backed");
        assert_eq!(list.segments().collect::<Vec<_>>(), [2]);
    }

    #[test]
    fn a_segment_that_takes_samples_in_stays_though_it_is_empty() {
        let mut list = RetireList::default();
        assert_eq!(list.lend(LEN), None);
        list.open(1, 0..4 * LEN);
        assert!(list.vacated().is_empty());
        list.leave();
        assert!(list.extent().is_none());
        assert_eq!((list.take(LEN), list.vacated()), (None, vec![(1, 0)]));
        assert_eq!(list.lend(LEN), None);
    }

    #[test]
    fn a_segment_that_was_left_helps_out_while_it_is_there() {
        let mut list = RetireList::default();
        list.open(1, 0..2 * LEN);
        let kept = list.lend(LEN).unwrap();
        list.open(2, 0..LEN);
        let places = [(); 3].map(|()| list.lend(LEN).map(|at| at.segment));
        assert_eq!(places, [Some(2), Some(1), None]);
        assert!(list.would_hold(LEN, [(kept, LEN)].into_iter(), true));
        assert!(!list.would_hold(LEN, [(kept, LEN)].into_iter(), false), "it is not backed");
        assert!(!list.would_hold(LEN, std::iter::empty(), true));
        assert_eq!(list.loans(), 3, "to ask takes nothing");
    }
}
