//! Which samples of a ring stand, and how room is made for the next: plain data, no shared memory.

use super::area::Area;

/// The samples that stand, oldest to newest, and what they take of the payload area.
#[derive(Debug)]
pub(super) struct History {
    head: u64,
    tail: u64,
    /// Offset and length by slot; length 0 for a sample inside its slot.
    extents: Box<[(u64, u64)]>,
    area: Area,
    /// Bytes of the area that samples and loans take.
    used: u64,
    /// Samples in the area.
    placed: u64,
    /// Loans in the area.
    loans: u32,
    budget: u64,
}

/// Why there is no room.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Full {
    /// The oldest sample may not be given up.
    Held,
    /// Loans take the area.
    Loaned(u32),
}

impl History {
    pub(super) fn new(slots: u64, area: u64, budget: u64) -> Self {
        let slots = slots as usize;
        Self {
            head: 0,
            tail: 0,
            extents: vec![(0, 0); slots].into_boxed_slice(),
            area: Area::new(area, slots + 1),
            used: 0,
            placed: 0,
            loans: 0,
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

    /// Gives up all samples below `floor`.
    pub(super) fn release_below(&mut self, floor: u64) {
        while self.tail < floor.min(self.head) {
            let index = self.index(self.tail);
            let (at, len) = std::mem::take(&mut self.extents[index]);
            if len > 0 {
                self.area.release(at, len);
                self.used -= len;
                self.placed -= 1;
            }
            self.tail += 1;
        }
    }

    /// Makes sure that the next position has a slot, giving up the oldest that `may_go`.
    pub(super) fn slot(&mut self, mut may_go: impl FnMut(u64) -> bool) -> Result<(), Full> {
        while self.head - self.tail > self.capacity() {
            self.give_up_oldest(&mut may_go)?;
        }
        Ok(())
    }

    /// Takes `len` bytes of the area for a loan, giving up the oldest samples that `may_go` to
    /// stay within the budget. One sample always stays, whatever its length.
    pub(super) fn reserve(
        &mut self,
        len: u64,
        mut may_go: impl FnMut(u64) -> bool,
    ) -> Result<u64, Full> {
        loop {
            if self.placed <= 1 || self.used + len <= self.budget {
                if let Some(at) = self.area.allocate(len) {
                    self.used += len;
                    self.loans += 1;
                    return Ok(at);
                }
                if self.placed <= 1 {
                    return Err(Full::Loaned(self.loans));
                }
            }
            self.give_up_oldest(&mut may_go)?;
        }
    }

    /// Gives back a loan.
    pub(super) fn unreserve(&mut self, at: u64, len: u64) {
        self.area.release(at, len);
        self.used -= len;
        self.loans -= 1;
    }

    /// The next position is taken by a sample, `loan` where it is in the area. There must be a
    /// [slot](Self::slot) for it.
    pub(super) fn push(&mut self, loan: Option<(u64, u64)>) -> u64 {
        let position = self.head;
        let index = self.index(position);
        self.extents[index] = loan.unwrap_or_default();
        if loan.is_some() {
            self.loans -= 1;
            self.placed += 1;
        }
        self.head += 1;
        position
    }

    fn give_up_oldest(&mut self, may_go: &mut impl FnMut(u64) -> bool) -> Result<(), Full> {
        if self.tail == self.head || !may_go(self.tail) {
            return Err(Full::Held);
        }
        self.release_below(self.tail + 1);
        Ok(())
    }

    fn index(&self, position: u64) -> usize {
        (position & (self.extents.len() as u64 - 1)) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_one_holds_the_last_sample_while_the_largest_is_written() {
        let max = 1 << 20;
        let mut history = History::new(16, 4 * max, 4096);
        let mut places = Vec::new();
        for position in 0..100 {
            history.slot(|_| true).unwrap();
            let at = history.reserve(max, |_| true).unwrap();
            assert!(at + max <= 4 * max);
            if position > 0 {
                assert!(history.tail() < position, "the last one stands");
            }
            history.push(Some((at, max)));
            places.push(at);
        }
        assert!(places.iter().all(|at| *at <= 2 * max), "memory stays near the live window");
    }

    #[test]
    fn what_may_not_go_is_kept() {
        let mut history = History::new(4, 1 << 16, 1 << 16);
        for _ in 0..3 {
            history.slot(|_| false).unwrap();
            history.push(None);
        }
        history.push(None);
        assert_eq!(history.slot(|position| position > 0), Err(Full::Held));
        assert_eq!(history.slot(|_| true), Ok(()));
        assert_eq!((history.tail(), history.head()), (1, 4));
    }

    #[test]
    fn loans_are_told_apart_from_samples() {
        let mut history = History::new(4, 1 << 16, 1 << 16);
        let a = history.reserve(1 << 15, |_| true).unwrap();
        let b = history.reserve(1 << 15, |_| true).unwrap();
        assert_eq!(history.reserve(64, |_| true), Err(Full::Loaned(2)));
        history.unreserve(a, 1 << 15);
        history.push(Some((b, 1 << 15)));
        assert!(history.reserve(64, |_| true).is_ok());
    }
}
