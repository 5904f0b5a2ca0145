//! The samples that a ring keeps, oldest to newest, and the choice of samples to drop for the next one. Plain data,
//! no shared memory.

use crate::{
    alloc::{blocks::Blocks, classes, heap::Block, retire_list::RetireList},
    ring::layout::{self, Location},
};

/// The kept samples, oldest to newest, and the memory that they take.
///
/// Samples that readers copy out are in blocks. A block is overwritten as soon as its sample is given up, because
/// readers detect that. Samples that readers pin are in slots.
#[derive(Debug)]
pub(crate) struct SampleHistory {
    head: u64,
    tail: u64,
    /// The memory of each sample, by descriptor.
    extents: Box<[SampleStorage]>,
    blocks: Blocks,
    pinned: RetireList,
    /// Bytes that samples and loans take; slots in the retire list do not count.
    used: u64,
    /// Number of samples in blocks and slots.
    placed: u64,
    budget: u64,
    /// Bytes of the budget that each sample takes beside its block or slot.
    overhead: u64,
}

/// The memory that a sample takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum SampleStorage {
    /// No memory beside its descriptor.
    #[default]
    Inline,
    Block(Block),
    /// In a segment of the publisher's own.
    Slot {
        at: Location,
        len: u64,
        /// Bytes of the sample itself.
        sample: u64,
    },
}

/// The error that the oldest sample must not be given up.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct OldestInUse;

impl SampleHistory {
    /// Creates a history with `descriptors` descriptors.
    pub(crate) fn new(descriptors: u64, budget: u64) -> Self {
        Self {
            head: 0,
            tail: 0,
            extents: vec![SampleStorage::Inline; descriptors as usize].into_boxed_slice(),
            blocks: Blocks::default(),
            pinned: RetireList::default(),
            used: 0,
            placed: 0,
            budget,
            overhead: 0,
        }
    }

    /// Counts descriptors in the budget, too, because the budget is the only bound of this history.
    pub(crate) fn count_descriptors(&mut self) {
        self.overhead = layout::DESCRIPTOR;
    }

    /// Returns the next position.
    pub(crate) fn head(&self) -> u64 {
        self.head
    }

    /// Returns the oldest kept position.
    pub(crate) fn tail(&self) -> u64 {
        self.tail
    }

    /// Returns the maximum number of samples that can be kept while another is written.
    pub(crate) fn capacity(&self) -> u64 {
        self.extents.len() as u64 - 1
    }

    /// Returns whether the next position has no descriptor.
    pub(crate) fn is_full(&self) -> bool {
        self.head - self.tail > self.capacity()
    }

    /// Doubles the number of descriptors.
    pub(crate) fn grow(&mut self) {
        let mut extents = vec![SampleStorage::Inline; 2 * self.extents.len()].into_boxed_slice();
        for position in self.tail..self.head {
            extents[index(&extents, position)] = self.extents[index(&self.extents, position)];
        }
        self.extents = extents;
    }

    /// Returns the blocks for the next samples.
    pub(crate) fn blocks(&mut self) -> &mut Blocks {
        &mut self.blocks
    }

    /// Returns the slots.
    pub(crate) fn pinned(&mut self) -> &mut RetireList {
        &mut self.pinned
    }

    /// Returns all blocks, of kept samples and for later samples.
    pub(crate) fn all_blocks(&mut self) -> Vec<Block> {
        let standing = self.extents.iter().filter_map(|extent| match extent {
            SampleStorage::Block(block) => Some(*block),
            SampleStorage::Inline | SampleStorage::Slot { .. } => None,
        });
        standing.chain(self.blocks.drain()).collect()
    }

    /// Gives up all samples below `floor`.
    pub(crate) fn release_below(&mut self, floor: u64) {
        while self.tail < floor.min(self.head) {
            let at = index(&self.extents, self.tail);
            match std::mem::take(&mut self.extents[at]) {
                SampleStorage::Inline => {}
                SampleStorage::Block(block) => {
                    self.blocks.put(block);
                    self.used -= block.len;
                    self.placed -= 1;
                }
                SampleStorage::Slot { at, len, sample } => {
                    self.pinned.retire(self.tail, at, len, sample);
                    self.used -= len;
                    self.placed -= 1;
                }
            }
            self.tail += 1;
        }
    }

    /// Makes sure that the next position has a descriptor, and gives up the oldest samples that `may_go` for that.
    pub(crate) fn make_place(&mut self, may_go: impl Fn(u64) -> bool) -> Result<(), OldestInUse> {
        while self.is_full() {
            self.give_up_oldest(&may_go)?;
        }
        Ok(())
    }

    /// Gives up the oldest samples that `may_go` until `len` more bytes are within the budget. One sample always stays,
    /// whatever its length.
    pub(crate) fn make_room(
        &mut self,
        len: u64,
        may_go: impl Fn(u64) -> bool,
    ) -> Result<(), OldestInUse> {
        while !self.has_room(len) {
            self.give_up_oldest(&may_go)?;
        }
        Ok(())
    }

    /// Gives up the oldest sample, if more than `kept` samples are in blocks or slots. Returns whether it did.
    pub(crate) fn shrink(
        &mut self,
        kept: u64,
        may_go: impl Fn(u64) -> bool,
    ) -> Result<bool, OldestInUse> {
        if self.placed <= kept {
            return Ok(false);
        }
        self.give_up_oldest(&may_go)?;
        Ok(true)
    }

    /// Returns whether a sample of `len` bytes needs more memory in any case: the budget requires that samples are
    /// given up for it, and the existing memory has no slot for it even then. This is slow if samples differ in length.
    pub(crate) fn is_short_of(&self, len: u64) -> bool {
        let alike = match self.extents[index(&self.extents, self.tail)] {
            SampleStorage::Slot { len: oldest, .. } => {
                oldest >= len && classes::class(oldest) == classes::class(len)
            }
            SampleStorage::Inline | SampleStorage::Block(_) => false,
        };
        !self.has_room(len) && !alike && !self.would_hold(len, 1, false)
    }

    /// Returns whether there would be a slot of `len` bytes if all samples except `kept` were given up, and no slot
    /// that readers pin: in the existing memory, unless it can `grow`. This is slow.
    pub(crate) fn would_hold(&self, len: u64, kept: u64, grow: bool) -> bool {
        let placed = (self.tail..self.head)
            .map(|position| self.extents[index(&self.extents, position)])
            .filter(|extent| *extent != SampleStorage::Inline)
            .take(self.placed.saturating_sub(kept) as usize);
        let slots = placed.filter_map(|extent| match extent {
            SampleStorage::Slot { at, len, .. } => Some((at, len)),
            SampleStorage::Inline | SampleStorage::Block(_) => None,
        });
        self.pinned.would_hold(len, slots, grow)
    }

    /// Takes `len` bytes that no reader reads, for a loan.
    pub(crate) fn lend(&mut self, len: u64) -> Option<Location> {
        let at = self.pinned.lend(len)?;
        self.used += len;
        Some(at)
    }

    /// Like [`lend`](Self::lend), if the loan is within the budget without giving up samples and slots [take
    /// turns](RetireList::lend_turn).
    pub(crate) fn lend_turn(&mut self, len: u64) -> Option<Location> {
        if !self.has_room(len) {
            return None;
        }
        let at = self.pinned.lend_turn(len)?;
        self.used += len;
        Some(at)
    }

    /// Returns whether `len` more bytes are within the budget.
    pub(crate) fn has_room(&self, len: u64) -> bool {
        let standing = self.head - self.tail;
        let counted = if self.overhead == 0 { self.placed } else { standing };
        counted <= 1 || self.used + self.overhead * (standing + 1) + len <= self.budget
    }

    /// Returns whether the next sample's descriptor is within the budget.
    pub(crate) fn has_room_for_descriptor(&self) -> bool {
        self.overhead == 0 || self.has_room(0)
    }

    /// Gives back a loan.
    pub(crate) fn give_back(&mut self, at: Location, len: u64) {
        self.pinned.give_back(at, len);
        self.used -= len;
    }

    /// Withdraws a loan for which there is no memory.
    pub(crate) fn withdraw(&mut self, at: Location, len: u64) {
        self.pinned.withdraw(at, len);
        self.used -= len;
    }

    /// Assigns the next position to a sample. There must be a [place](Self::make_place) for it.
    pub(crate) fn push(&mut self, extent: SampleStorage) -> u64 {
        let position = self.head;
        match extent {
            SampleStorage::Inline => {}
            SampleStorage::Block(block) => {
                self.placed += 1;
                self.used += block.len;
            }
            SampleStorage::Slot { .. } => {
                self.placed += 1;
                self.pinned.published();
            }
        }
        self.extents[index(&self.extents, position)] = extent;
        self.head += 1;
        position
    }

    fn give_up_oldest(&mut self, may_go: &impl Fn(u64) -> bool) -> Result<(), OldestInUse> {
        if self.tail == self.head || !may_go(self.tail) {
            return Err(OldestInUse);
        }
        self.release_below(self.tail + 1);
        Ok(())
    }
}

fn index(extents: &[SampleStorage], position: u64) -> usize {
    (position & (extents.len() as u64 - 1)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEGMENT: u32 = 3;

    fn history(descriptors: u64, slots: u64, budget: u64) -> SampleHistory {
        let mut history = SampleHistory::new(descriptors, budget);
        history.pinned().open(SEGMENT, 0..slots);
        history
    }

    #[test]
    fn depth_one_holds_the_last_sample_while_the_largest_is_written() {
        let max = 1 << 20;
        let mut history = history(16, 4 * max, 4096);
        let mut places = Vec::new();
        for position in 0..100 {
            history.make_place(|_| true).unwrap();
            history.make_room(max, |_| true).unwrap();
            history.pinned().reclaim(|_, _| false);
            let at = history.lend(max).unwrap();
            if position > 0 {
                assert!(history.tail() < position, "the last one stands");
            }
            history.push(SampleStorage::Slot { at, len: max, sample: max });
            places.push(at);
        }
        assert!(places.iter().all(|at| at.offset <= max), "memory stays near the live window");
    }

    #[test]
    fn history_keeps_samples_in_use() {
        let mut history = SampleHistory::new(4, 0);
        for _ in 0..3 {
            history.make_place(|_| false).unwrap();
            history.push(SampleStorage::Inline);
        }
        history.push(SampleStorage::Inline);
        assert_eq!(history.make_place(|position| position > 0), Err(OldestInUse));
        assert_eq!(history.make_place(|_| true), Ok(()));
        assert_eq!((history.tail(), history.head()), (1, 4));
    }

    #[test]
    fn a_place_is_not_given_out_again_while_it_is_pinned() {
        let size = 1 << 16;
        let mut history = history(4, 2 * size, 0);
        let first = history.lend(size).unwrap();
        let position = history.push(SampleStorage::Slot { at: first, len: size, sample: size });
        history.release_below(1);
        let second = history.lend(size).unwrap();
        assert_ne!(first, second, "nobody has looked at the pins");
        history.pinned().reclaim(|pinned, _| pinned == position);
        assert_eq!(history.lend(size), None);
        assert_eq!(history.pinned().retired().collect::<Vec<_>>(), [position]);
        assert_eq!(history.pinned().loans(), 1);
        history.pinned().reclaim(|_, _| false);
        assert_eq!(history.lend(size), Some(first));
    }

    #[test]
    fn descriptors_that_count_share_the_budget_with_blocks() {
        const BUDGET: u64 = 100 * 128;
        let mut history = SampleHistory::new(256, BUDGET);
        history.count_descriptors();
        let mut inline = 0..1000;
        while inline.next().is_some() {
            history.make_place(|_| true).unwrap();
            if !history.has_room_for_descriptor() {
                history.make_room(0, |_| true).unwrap();
            }
            history.push(SampleStorage::Inline);
        }
        assert_eq!(history.head() - history.tail(), 100);
        for position in history.head()..history.head() + 1000 {
            history.make_room(128, |_| true).unwrap();
            let at = Location { segment: 0, offset: position * 128 };
            history.push(SampleStorage::Block(Block { at, len: 128 }));
        }
        assert_eq!(history.head() - history.tail(), 50);
        // One sample stays, whatever memory it takes.
        history.make_room(BUDGET, |_| true).unwrap();
        assert_eq!(history.head() - history.tail(), 1);
    }

    #[test]
    fn growing_the_history_preserves_its_entries() {
        let mut history = history(4, 1 << 20, 1 << 20);
        let mut expected = std::collections::VecDeque::new();
        for round in 0..100u64 {
            if round % 30 == 29 {
                history.grow();
            }
            history.make_place(|_| true).unwrap();
            let at = Location { segment: 0, offset: round * 128 };
            expected.push_back(Block { at, len: 128 });
            history.push(SampleStorage::Block(expected[expected.len() - 1]));
            while (expected.len() as u64) > history.head() - history.tail() {
                expected.pop_front();
            }
        }
        assert_eq!(history.capacity(), 31);
        history.release_below(u64::MAX);
        // The last slot that was given up is reused first.
        while let Some(block) = expected.pop_back() {
            assert_eq!(history.blocks().take(128), Some(block));
        }
    }
}
