//! The memory of this host that the samples from one peer take, for the simulator.

use super::Inbound;

impl Inbound {
    /// Returns the number of streams that are being read, and of the bytes that were read from QUIC and are not
    /// delivered.
    pub(in crate::engine) fn held(&self) -> (usize, usize) {
        let bytes = self.streams.values().map(super::incoming::IncomingStream::held).sum();
        (self.streams.len(), bytes)
    }

    /// Returns the length of the longest list that has at most one entry for each stream.
    pub(in crate::engine) fn listed(&self) -> usize {
        let turns = self.turns.values().map(std::collections::VecDeque::len).sum::<usize>();
        let lists = [
            turns,
            self.waiting.len(),
            self.full.len(),
            self.without_room.len(),
            self.limited.len(),
            self.parked.len(),
            self.copies.waiting(),
        ];
        lists.into_iter().max().unwrap_or_default()
    }

    /// Returns the number of copies that wait for the sample before them.
    pub(in crate::engine) fn waiting_copies(&self) -> usize {
        self.copies.waiting()
    }
}
