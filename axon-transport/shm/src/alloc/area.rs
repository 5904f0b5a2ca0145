//! Allocates ranges of a segment: first fit from the bottom, so that allocations touch little more memory than
//! they use. Plain data; the owner of the segment calls it under a lock.

use std::ops::Range;

use crate::ring::layout::LINE;

/// The free ranges of an area.
#[derive(Clone, Debug, Default)]
pub(crate) struct Area {
    /// Start and end of each free range in bytes, in ascending order; no two ranges touch.
    free: Vec<(u64, u64)>,
}

impl Area {
    /// Creates an area in which up to `pieces` pieces are expected at a time.
    pub(crate) fn new(range: Range<u64>, pieces: usize) -> Self {
        let mut free = Vec::with_capacity(pieces + 1);
        free.push((range.start, range.end));
        Self { free }
    }

    /// Returns the bytes that an allocation of `len` bytes takes.
    pub(crate) fn rounded(len: u64) -> u64 {
        len.max(1).next_multiple_of(LINE)
    }

    /// Returns whether there is space for `len` bytes below `limit`.
    pub(crate) fn fits_below(&self, limit: u64, len: u64) -> bool {
        self.find(limit, len).is_some()
    }

    fn find(&self, limit: u64, len: u64) -> Option<usize> {
        self.free.iter().position(|&(start, end)| end.min(limit).saturating_sub(start) >= len)
    }

    /// Returns the lowest free range of `len` bytes, a multiple of the line size.
    pub(crate) fn allocate(&mut self, len: u64) -> Option<u64> {
        self.allocate_below(u64::MAX, len)
    }

    /// Like [`allocate`](Self::allocate), if the range ends at or below `limit`.
    pub(crate) fn allocate_below(&mut self, limit: u64, len: u64) -> Option<u64> {
        let index = self.find(limit, len)?;
        let (start, end) = &mut self.free[index];
        let at = *start;
        *start += len;
        if start == end {
            self.free.remove(index);
        }
        Some(at)
    }

    /// Frees a range that [`Area::allocate`] returned.
    pub(crate) fn release(&mut self, at: u64, len: u64) {
        let index = self.free.partition_point(|&(start, _)| start < at);
        let touches_below = index > 0 && self.free[index - 1].1 == at;
        let touches_above = self.free.get(index).is_some_and(|&(start, _)| start == at + len);
        match (touches_below, touches_above) {
            (true, true) => {
                self.free[index - 1].1 = self.free[index].1;
                self.free.remove(index);
            }
            (true, false) => self.free[index - 1].1 = at + len,
            (false, true) => self.free[index].0 = at,
            (false, false) => self.free.insert(index, (at, at + len)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn pieces_never_overlap_and_all_comes_back(
            lens in proptest::collection::vec(1u64..5000, 1..200),
            keep in 0usize..20,
        ) {
            let size = 1 << 16;
            let mut area = Area::new(0..size, 4);
            let mut live: VecDeque<(u64, u64)> = VecDeque::new();
            for len in lens {
                let len = Area::rounded(len);
                let at = loop {
                    if let Some(at) = area.allocate(len) {
                        break at;
                    }
                    let (at, len) = live.pop_front().expect("one piece fits in an empty area");
                    area.release(at, len);
                };
                prop_assert!(at % LINE == 0 && at + len <= size);
                for &(other, length) in &live {
                    prop_assert!(at + len <= other || other + length <= at);
                }
                live.push_back((at, len));
                while live.len() > keep {
                    let (at, len) = live.pop_front().unwrap();
                    area.release(at, len);
                }
            }
            for (at, len) in live {
                area.release(at, len);
            }
            prop_assert_eq!(area.free, vec![(0, size)]);
        }
    }

    #[test]
    fn nothing_goes_beyond_the_limit() {
        let mut area = Area::new(0..1024, 4);
        assert_eq!(area.allocate_below(256, 384), None);
        assert_eq!(area.allocate_below(256, 256), Some(0));
        assert!(!area.fits_below(256, 128));
        assert_eq!(area.allocate(128), Some(256));
        assert_eq!(area.allocate_below(256, 128), None);
    }

    #[test]
    fn the_bottom_is_reused_first() {
        let mut area = Area::new(0..1 << 20, 4);
        let pieces: Vec<_> = (0..4).map(|_| area.allocate(128).unwrap()).collect();
        area.release(pieces[0], 128);
        area.release(pieces[1], 128);
        assert_eq!(area.allocate(256), Some(0));
        assert_eq!(area.allocate(128), Some(512));
    }
}
