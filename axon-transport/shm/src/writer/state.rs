//! The state that a publisher's lock protects.

use super::{
    history::SampleHistory, numbers::WriterNumbers, reader_set::ReaderSet, reclaim::Maps,
    samples::Samples,
};
use crate::{
    alloc::{budget::Holding, heap::HeapObject},
    ring::protocol,
    session::pin_lanes::Pinned,
};

/// The kept samples, their readers and their memory.
pub(crate) struct WriterState {
    pub(crate) history: SampleHistory,
    pub(crate) reader_set: ReaderSet,
    /// The descriptors.
    pub(super) array: HeapObject,
    /// The segments that contain the blocks.
    pub(super) maps: Maps,
    /// The memory for large samples, which readers pin, once there has been one.
    pub(super) samples: Option<Samples>,
    /// The memory that it takes from the budget shared with other rings.
    pub(super) holding: Holding,
    /// The tail as readers see it.
    pub(super) shown_tail: u64,
    /// The pins found by the last scan, kept to reuse the memory.
    pub(super) pinned: Pinned,
    pub(super) numbers: WriterNumbers,
    /// Number of given-up samples that a wait has reported.
    pub(super) known_given_up: u64,
}

impl WriterState {
    pub(super) fn new(reader_set: ReaderSet, history: SampleHistory, array: HeapObject) -> Self {
        Self {
            history,
            reader_set,
            array,
            maps: Maps::default(),
            samples: None,
            holding: Holding::default(),
            shown_tail: 0,
            pinned: Pinned::default(),
            numbers: WriterNumbers::default(),
            known_given_up: 0,
        }
    }

    /// Returns the first kept position whose sample has a higher number.
    pub(super) fn position_after(&self, number: u64) -> u64 {
        let standing = self.history.tail()..self.history.head();
        let later = |position: &u64| protocol::number(self.array.words(), *position) > number;
        standing.rev().take_while(later).last().unwrap_or(self.history.head())
    }

    /// Returns the position below which every reader has taken what it wanted, and no reader asks for a sample again.
    pub(super) fn consumed(&self) -> u64 {
        self.reader_set.consumed(self.history.head())
    }

    /// Returns whether a reader has yet to take the oldest kept sample, or a later reader would get it.
    pub(super) fn is_oldest_wanted(&self) -> bool {
        self.reader_set.is_wanted(self.history.tail(), self.history.head())
    }

    /// Returns the number of the last sample in front of a position.
    pub(super) fn number_before(&self, position: u64) -> u64 {
        let stands = position >= self.history.tail() && position < self.history.head();
        if stands {
            protocol::number(self.array.words(), position).saturating_sub(1)
        } else {
            self.numbers.last()
        }
    }
}
