//! What publishers that are gone left to those that still read it.

use std::sync::{Mutex, PoisonError};

use super::{
    heap::{Block, Heap},
    seats::Seats,
    segments::Segments,
};

/// One publisher's memory.
pub(super) struct Orphan {
    /// Those who may be reading it.
    pub(super) seats: Seats,
    pub(super) blocks: Vec<Block>,
    /// The number of the segment of its large samples.
    pub(super) samples: Option<u32>,
}

/// The memory of a session's publishers that are gone.
#[derive(Default)]
pub(super) struct Orphans(Mutex<Vec<Orphan>>);

impl Orphans {
    pub(super) fn adopt(&self, orphan: Orphan) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(orphan);
    }

    /// Takes back what nobody reads any more.
    pub(super) fn sweep(&self, heap: &Heap, segments: &Segments) {
        let mut orphans = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        orphans.retain_mut(|orphan| {
            orphan.seats.sweep(|_| true);
            if !orphan.seats.is_empty() {
                return true;
            }
            orphan.blocks.drain(..).for_each(|block| heap.release(block));
            orphan.samples.take().into_iter().for_each(|number| segments.close(number));
            false
        });
    }
}
