//! Limits the length of the samples that a reader may pin, so that readers never keep all of a publisher's memory.
//! Two readers may pin samples of any length, and many readers may pin shorter ones. Readers copy longer samples.
//! Plain data; the publisher computes a reader's limit when the reader attaches, and the grant carries the limit.

use crate::{
    alloc::classes,
    limits::{ALIGN, MAX_SEGMENT},
    ring::{
        layout::{ALIGNED, COPIED_ALWAYS, SLOTS_AT},
        pins::RECORDS,
    },
};

/// Position of the limit in a grant's generation, in bits.
const SHIFT: u32 = 24;
const BITS: u64 = (1 << 6) - 1;
/// Each further reader gets one part in this many of the remaining memory.
const PART: u64 = 16;

/// The longest sample that a reader may pin: a power of two in bytes, or none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PinLimit {
    /// The binary logarithm of the limit; 0 for none.
    power: u32,
}

impl PinLimit {
    pub(crate) const NONE: Self = Self { power: 0 };
    /// The limit for readers in the publisher's own session, which may pin everything.
    pub(crate) const ALL: Self = Self { power: BITS as u32 };

    /// Returns the limit for samples of `len` bytes, rounded up to a power of two.
    fn at_least(len: u64) -> Self {
        Self { power: len.max(1).next_power_of_two().ilog2() }
    }

    /// Returns the limit for samples of up to `len` bytes, rounded down to a power of two.
    fn at_most(len: u64) -> Self {
        // Shorter samples are never pinned.
        if len > COPIED_ALWAYS { Self { power: len.ilog2() } } else { Self::NONE }
    }

    pub(crate) fn of(generation: u64) -> Self {
        Self { power: (generation >> SHIFT & BITS) as u32 }
    }

    /// Returns the limit's bits of a generation.
    pub(crate) fn bits(self) -> u64 {
        u64::from(self.power) << SHIFT
    }

    /// Returns the longest sample in bytes.
    pub(crate) fn longest(self) -> u64 {
        if self == Self::NONE { 0 } else { 1 << self.power }
    }
}

/// The memory of a publisher that readers may pin.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PinPool {
    /// Bytes that all readers of other sessions may pin together. The rest of the publisher's segments is more than
    /// half of them.
    bytes: u64,
    /// The largest slot in bytes.
    largest: u64,
}

impl PinPool {
    /// Creates the pool of a publisher with this budget.
    pub(crate) fn new(budget: u64, max_message: u64) -> Self {
        let segment = samples_bytes(budget, max_message, RECORDS as u64) - SLOTS_AT;
        Self { bytes: segment / 2 * 3, largest: classes::rounded(max_message) }
    }

    /// Returns the limit for a new reader, if `taken` bytes have been granted and `process` of them to the reader's own
    /// process. A process gets at most three quarters of all.
    pub(crate) fn share(&self, taken: u64, process: u64) -> PinLimit {
        let whole = PinLimit::at_least(self.largest);
        if taken + self.cost(whole) <= self.bytes / 2 {
            return whole;
        }
        let left = self.bytes.saturating_sub(taken);
        let left = left.min((self.bytes / 4 * 3).saturating_sub(process));
        PinLimit::at_most(left / PART / RECORDS as u64)
    }

    /// Returns the bytes that a reader with this limit may pin in total.
    pub(crate) fn cost(&self, pin_limit: PinLimit) -> u64 {
        RECORDS as u64 * pin_limit.longest().min(self.largest)
    }
}

/// Returns the bytes of a publisher's segment for a history of `budget` bytes and samples of at most `max_message`
/// bytes. All of it is address space; memory is committed as needed.
pub(crate) fn samples_bytes(budget: u64, max_message: u64, pins: u64) -> u64 {
    // Four of the largest samples have room, so that one always fits beside one that is kept; and as many as two
    // readers can pin. Twice the budget has room, so that gaps between samples seldom shorten the history. A sample
    // behind a header may begin up to `ALIGNED` bytes later.
    let largest = classes::rounded(max_message + ALIGNED as u64);
    let bytes = (4 * largest).max(2 * budget) + 2 * pins * largest;
    (SLOTS_AT + bytes).next_multiple_of(ALIGN).min(MAX_SEGMENT)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    #[test]
    fn a_generation_encodes_its_pin_limit() {
        for pin_limit in [PinLimit::NONE, PinLimit::ALL, PinLimit::at_most(25 * MIB)] {
            let generation = 77 << 30 | pin_limit.bits() | 0xff_ffff;
            assert_eq!(PinLimit::of(generation), pin_limit);
        }
        assert_eq!(PinLimit::at_most(25 * MIB).longest(), 16 * MIB);
        assert_eq!(PinLimit::at_least(25 * MIB).longest(), 32 * MIB);
        assert_eq!(
            (PinLimit::NONE.longest(), PinLimit::at_most(COPIED_ALWAYS)),
            (0, PinLimit::NONE)
        );
    }

    /// Returns the limits of `readers` readers that attach one after the other, all in one process or each in its own.
    fn shares(pool: PinPool, readers: usize, one_process: bool) -> Vec<u64> {
        let mut taken = 0;
        let mut shares = Vec::new();
        for _ in 0..readers {
            let share = pool.share(taken, if one_process { taken } else { 0 });
            taken += pool.cost(share);
            shares.push(share.longest());
        }
        assert!(taken <= if one_process { pool.bytes / 4 * 3 } else { pool.bytes });
        shares
    }

    #[test]
    fn two_readers_keep_any_sample_and_many_keep_shorter_ones() {
        // The defaults of a publisher.
        let shares = shares(PinPool::new(64 * MIB, 256 * MIB), 1000, false);
        assert_eq!(shares[..2], [256 * MIB; 2]);
        assert!(shares[2..16].iter().all(|longest| *longest >= 8 * MIB), "{shares:?}");
        assert!(shares[16..64].iter().all(|longest| *longest >= MIB / 2), "{shares:?}");
        assert_eq!(shares[999], 0);
    }

    #[test]
    fn one_process_leaves_something_to_the_next() {
        for (budget, max_message) in [(64 * MIB, 256 * MIB), (0, 25 * MIB), (1 << 32, 1 << 31)] {
            let pool = PinPool::new(budget, max_message);
            let of_one = shares(pool, 5000, true);
            assert!(of_one[1] >= max_message && of_one[4999] == 0);
            let taken = of_one.iter().map(|longest| 6 * longest.min(&pool.largest)).sum();
            assert!(pool.share(taken, 0).longest() > COPIED_ALWAYS, "the next process has its own");
        }
    }
}
