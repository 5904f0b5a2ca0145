//! Sets of message indexes under one key.

use core::fmt;

/// The most messages that a key seals. Indexes run from 0 to one less.
pub const MESSAGES_PER_KEY: u8 = 10;

/// The delivery guarantee of a message. RETIRE tells the receiver for which messages to wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Delivery {
    /// The message may be lost. The receiver stops waiting for it a few seconds after RETIRE.
    BestEffort,
    /// The message will arrive as long as the connection lives. The receiver keeps the key until it
    /// has arrived, for a limited time.
    Reliable,
}

/// A set of message indexes 0 to 9. Bit *n* stands for index *n*.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct IndexMask(u16);

impl IndexMask {
    /// The empty set.
    pub const EMPTY: Self = Self(0);
    /// The set of all ten indexes.
    pub const ALL: Self = Self((1 << MESSAGES_PER_KEY) - 1);

    /// Makes a set from bits. Returns `None` if a bit from 10 upwards is set.
    pub fn from_bits(bits: u16) -> Option<Self> {
        (bits & !Self::ALL.0 == 0).then_some(Self(bits))
    }

    /// Returns the set as bits, with index 0 as the lowest.
    pub fn bits(self) -> u16 {
        self.0
    }

    /// Returns whether `index` is in the set.
    pub fn contains(self, index: u8) -> bool {
        index < MESSAGES_PER_KEY && self.0 & (1 << index) != 0
    }

    /// Returns the number of indexes in the set.
    pub fn len(self) -> usize {
        self.0.count_ones() as usize
    }

    /// Returns whether the set is empty.
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Returns whether every index of this set is in `other`.
    pub fn is_subset(self, other: Self) -> bool {
        self.0 & !other.0 == 0
    }

    /// Returns the indexes of this set that are not in `other`.
    #[must_use]
    pub fn minus(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    pub(crate) fn insert(&mut self, index: u8) {
        debug_assert!(index < MESSAGES_PER_KEY);
        self.0 |= 1 << index;
    }
}

impl fmt::Debug for IndexMask {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "IndexMask({:#012b})", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_is_no_index_ten() {
        assert_eq!(IndexMask::from_bits(1 << 10), None);
        assert_eq!(IndexMask::from_bits(0x3ff), Some(IndexMask::ALL));
        assert_eq!(IndexMask::ALL.len(), 10);
        assert!(!IndexMask::ALL.contains(10));
        assert!(!IndexMask::ALL.contains(255));
    }
}
