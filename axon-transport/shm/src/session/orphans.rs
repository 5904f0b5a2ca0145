//! Memory of publishers that were dropped while readers still pinned their samples. The session's owner
//! frees it once no reader pins it.

use std::sync::{Mutex, PoisonError};

use crate::{
    alloc::{
        heap::{Block, Heap},
        segments::Segments,
    },
    session::pin_lanes::PinLanes,
};

/// One publisher's memory.
pub(crate) struct Orphan {
    /// Those who may be reading it.
    pub(crate) pin_lanes: PinLanes,
    pub(crate) blocks: Vec<Block>,
    /// The numbers of the segments of its large samples.
    pub(crate) samples: Vec<u32>,
}

/// The memory of a session's publishers that are gone.
#[derive(Default)]
pub(crate) struct Orphans(Mutex<Vec<Orphan>>);

impl Orphans {
    pub(crate) fn adopt(&self, orphan: Orphan) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(orphan);
    }

    /// Takes back what nobody reads any more. Whether something is left.
    pub(crate) fn sweep(&self, heap: &Heap, segments: &Segments) -> bool {
        let mut orphans = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        orphans.retain_mut(|orphan| {
            orphan.pin_lanes.sweep(|_| true);
            if !orphan.pin_lanes.is_empty() {
                return true;
            }
            orphan.blocks.drain(..).for_each(|block| heap.release(block));
            orphan.samples.drain(..).for_each(|number| segments.close(number));
            false
        });
        !orphans.is_empty()
    }
}
