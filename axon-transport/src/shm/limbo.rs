//! The segment of a publisher's samples that readers read in place: samples that were given up stay
//! in limbo until no reader pins them. Plain data, no shared memory.

use std::ops::Range;

use super::area::Area;

/// Who has which bytes of it. None until it is [opened](Self::open).
#[derive(Debug, Default)]
pub(super) struct Limbo {
    area: Area,
    retired: Vec<Retired>,
    /// Places that were handed out and not published yet.
    loans: u32,
}

#[derive(Debug)]
struct Retired {
    position: u64,
    at: u64,
    len: u64,
}

impl Limbo {
    /// Has places in `range` from now on.
    pub(super) fn open(&mut self, range: Range<u64>) {
        self.area = Area::new(range, 16);
    }

    /// A place that nobody reads, for a loan.
    pub(super) fn lend(&mut self, len: u64) -> Option<u64> {
        let at = self.area.allocate(len)?;
        self.loans += 1;
        Some(at)
    }

    /// The loan was not published, so no reader has heard of it.
    pub(super) fn give_back(&mut self, at: u64, len: u64) {
        self.area.release(at, len);
        self.loans -= 1;
    }

    /// The loan was published.
    pub(super) fn published(&mut self) {
        self.loans -= 1;
    }

    /// The sample at `position` has been given up; readers may still be at it.
    pub(super) fn retire(&mut self, position: u64, at: u64, len: u64) {
        self.retired.push(Retired { position, at, len });
    }

    /// Frees what no reader pins. The tail must have been raised above all that is here before
    /// the pins were looked at.
    pub(super) fn reclaim(&mut self, pinned: impl Fn(u64) -> bool) {
        let area = &mut self.area;
        self.retired.retain(|retired| {
            let keep = pinned(retired.position);
            if !keep {
                area.release(retired.at, retired.len);
            }
            keep
        });
    }

    /// The positions of samples that were given up and not reclaimed.
    pub(super) fn retired(&self) -> impl ExactSizeIterator<Item = u64> + '_ {
        self.retired.iter().map(|retired| retired.position)
    }

    pub(super) fn loans(&self) -> u32 {
        self.loans
    }
}
