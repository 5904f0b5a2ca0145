//! Which samples of a ring stand, and how room is made for the next: plain data, no shared memory.

use super::{area::Area, layout::COPIED, limbo::Limbo};

/// The samples that stand, oldest to newest, and what they take of the payload area.
///
/// The area has two parts. Samples that readers copy out are in one; it is written over as soon as
/// a sample is given up, for the readers find out. Samples that readers pin are in the other.
#[derive(Debug)]
pub(super) struct History {
    head: u64,
    tail: u64,
    /// Offset and length by slot; length 0 for a sample inside its slot.
    extents: Box<[(u64, u64)]>,
    copied: Area,
    pinned: Limbo,
    /// Bytes of the area that samples and loans take; what is in limbo does not count.
    used: u64,
    /// Samples in the area.
    placed: u64,
    budget: u64,
}

/// The oldest sample may not be given up.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Held;

impl History {
    /// A history of samples in `slots` slots and in a payload area of which the first `copied`
    /// bytes are for samples that are copied, the rest, up to `area`, for those that are pinned.
    pub(super) fn new(slots: u64, copied: u64, area: u64, budget: u64) -> Self {
        let slots = slots as usize;
        Self {
            head: 0,
            tail: 0,
            extents: vec![(0, 0); slots].into_boxed_slice(),
            copied: Area::new(0..copied, slots + 1),
            pinned: Limbo::new(copied..area, slots + 1),
            used: 0,
            placed: 0,
            budget,
        }
    }

    /// The next position.
    pub(super) fn head(&self) -> u64 {
        self.head
    }

    /// The oldest position that stands.
    pub(super) fn tail(&self) -> u64 {
        self.tail
    }

    /// The most samples that can stand while another is written.
    pub(super) fn capacity(&self) -> u64 {
        self.extents.len() as u64 - 1
    }

    /// What of the area readers pin.
    pub(super) fn pinned(&mut self) -> &mut Limbo {
        &mut self.pinned
    }

    /// Gives up all samples below `floor`.
    pub(super) fn release_below(&mut self, floor: u64) {
        while self.tail < floor.min(self.head) {
            let index = self.index(self.tail);
            let (at, len) = std::mem::take(&mut self.extents[index]);
            if len > 0 {
                if is_pinned(len) {
                    self.pinned.retire(self.tail, at, len);
                } else {
                    self.copied.release(at, len);
                }
                self.used -= len;
                self.placed -= 1;
            }
            self.tail += 1;
        }
    }

    /// Makes sure that the next position has a slot, giving up the oldest that `may_go`.
    pub(super) fn slot(&mut self, may_go: impl Fn(u64) -> bool) -> Result<(), Held> {
        while self.head - self.tail > self.capacity() {
            self.give_up_oldest(&may_go)?;
        }
        Ok(())
    }

    /// Gives up the oldest samples that `may_go` until `len` bytes more are within the budget. One
    /// sample always stays, whatever its length.
    pub(super) fn make_room(&mut self, len: u64, may_go: impl Fn(u64) -> bool) -> Result<(), Held> {
        while self.placed > 1 && self.used + len > self.budget {
            self.give_up_oldest(&may_go)?;
        }
        Ok(())
    }

    /// Gives up the oldest sample, if another one stands in the area. Whether it did.
    pub(super) fn shrink(&mut self, may_go: impl Fn(u64) -> bool) -> Result<bool, Held> {
        if self.placed <= 1 {
            return Ok(false);
        }
        self.give_up_oldest(&may_go)?;
        Ok(true)
    }

    /// Takes `len` bytes for a sample that is copied, giving up the oldest that `may_go`. It must
    /// be [pushed](Self::push) before anything else.
    pub(super) fn place(&mut self, len: u64, may_go: impl Fn(u64) -> bool) -> Result<u64, Held> {
        self.make_room(len, &may_go)?;
        loop {
            if let Some(at) = self.copied.allocate(len) {
                self.used += len;
                return Ok(at);
            }
            self.give_up_oldest(&may_go)?;
        }
    }

    /// Takes it back.
    pub(super) fn displace(&mut self, at: u64, len: u64) {
        self.copied.release(at, len);
        self.used -= len;
    }

    /// Takes `len` bytes that nobody reads for a loan.
    pub(super) fn lend(&mut self, len: u64) -> Option<u64> {
        let at = self.pinned.lend(len)?;
        self.used += len;
        Some(at)
    }

    /// Gives back a loan.
    pub(super) fn give_back(&mut self, at: u64, len: u64) {
        self.pinned.give_back(at, len);
        self.used -= len;
    }

    /// The next position is taken by a sample, at `extent` where it is in the area. There must be
    /// a [slot](Self::slot) for it.
    pub(super) fn push(&mut self, extent: Option<(u64, u64)>) -> u64 {
        let position = self.head;
        let index = self.index(position);
        self.extents[index] = extent.unwrap_or_default();
        if let Some((_, len)) = extent {
            self.placed += 1;
            if is_pinned(len) {
                self.pinned.published();
            }
        }
        self.head += 1;
        position
    }

    fn give_up_oldest(&mut self, may_go: &impl Fn(u64) -> bool) -> Result<(), Held> {
        if self.tail == self.head || !may_go(self.tail) {
            return Err(Held);
        }
        self.release_below(self.tail + 1);
        Ok(())
    }

    fn index(&self, position: u64) -> usize {
        (position & (self.extents.len() as u64 - 1)) as usize
    }
}

/// Whether readers pin a sample that takes `len` bytes of the area, rather than copy it.
fn is_pinned(len: u64) -> bool {
    len > COPIED
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: u64 = 1 << 16;

    #[test]
    fn depth_one_holds_the_last_sample_while_the_largest_is_written() {
        let max = 1 << 20;
        let mut history = History::new(16, SMALL, SMALL + 4 * max, 4096);
        let mut places = Vec::new();
        for position in 0..100 {
            history.slot(|_| true).unwrap();
            history.make_room(max, |_| true).unwrap();
            history.pinned().reclaim(|_| false);
            let at = history.lend(max).unwrap();
            if position > 0 {
                assert!(history.tail() < position, "the last one stands");
            }
            history.push(Some((at, max)));
            places.push(at);
        }
        assert!(places.iter().all(|at| *at <= SMALL + max), "memory stays near the live window");
    }

    #[test]
    fn what_may_not_go_is_kept() {
        let mut history = History::new(4, SMALL, 2 * SMALL, SMALL);
        for _ in 0..3 {
            history.slot(|_| false).unwrap();
            history.push(None);
        }
        history.push(None);
        assert_eq!(history.slot(|position| position > 0), Err(Held));
        assert_eq!(history.slot(|_| true), Ok(()));
        assert_eq!((history.tail(), history.head()), (1, 4));
    }

    #[test]
    fn a_place_is_not_given_out_again_while_it_is_pinned() {
        let mut history = History::new(4, SMALL, SMALL + 2 * SMALL, 0);
        let first = history.lend(SMALL).unwrap();
        let position = history.push(Some((first, SMALL)));
        history.release_below(1);
        let second = history.lend(SMALL).unwrap();
        assert_ne!(first, second, "nobody has looked at the pins");
        history.pinned().reclaim(|pinned| pinned == position);
        assert_eq!(history.lend(SMALL), None);
        assert_eq!(history.pinned().retired().collect::<Vec<_>>(), [position]);
        assert_eq!(history.pinned().loans(), 1);
        history.pinned().reclaim(|_| false);
        assert_eq!(history.lend(SMALL), Some(first));
    }

    #[test]
    fn what_is_copied_and_what_is_pinned_never_share_memory() {
        let mut history = History::new(64, SMALL, 2 * SMALL, 1 << 20);
        for round in 0..1000u64 {
            history.slot(|_| true).unwrap();
            if round % 3 == 0 {
                let at = history.lend(COPIED + 64).unwrap_or_else(|| {
                    while history.shrink(|_| true).unwrap() {}
                    history.release_below(u64::MAX);
                    history.pinned().reclaim(|_| false);
                    history.lend(COPIED + 64).unwrap()
                });
                assert!(at >= SMALL && at + COPIED + 64 <= 2 * SMALL);
                history.push(Some((at, COPIED + 64)));
            } else {
                let at = history.place(COPIED, |_| true).unwrap();
                assert!(at + COPIED <= SMALL);
                history.push(Some((at, COPIED)));
            }
        }
    }
}
