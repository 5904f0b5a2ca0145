//! Memory of publishers that were dropped while readers still pinned their samples. The session's owner
//! frees it once no reader pins it.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::{
    alloc::{
        budget::Holding,
        heap::{Block, Heap},
        segments::Segments,
    },
    session::pin_lanes::PinLanes,
};

/// One publisher's memory.
pub(crate) struct Orphan {
    /// The lanes of readers that may be reading the memory.
    pub(crate) pin_lanes: PinLanes,
    /// The position behind its last sample.
    pub(crate) head: u64,
    pub(crate) blocks: Vec<Block>,
    /// The numbers of the segments of its large samples.
    pub(crate) samples: Vec<u32>,
    /// The memory that it takes from the shared budget of its publisher, until it is freed.
    pub(crate) _holding: Holding,
}

/// Maximum number of orphans that are all checked whenever one comes or a reader leaves.
const CHECKS_PER_CALL: usize = 64;

/// The memory of a session's publishers that are gone.
#[derive(Default)]
pub(crate) struct Orphans(Mutex<OrphansState>);

#[derive(Default)]
struct OrphansState {
    all: Vec<Orphan>,
    /// Number of calls of [`sweep_some`](Orphans::sweep_some) since all were checked.
    calls: usize,
    /// Number of orphans checked since the start.
    #[cfg(test)]
    looks: usize,
}

impl Orphans {
    pub(crate) fn adopt(&self, orphan: Orphan) {
        self.lock().all.push(orphan);
    }

    /// Like [`sweep`](Self::sweep). If there are many orphans, it checks them only once in as many calls as there are
    /// orphans: thousands of publishers end one after the other, and each check asks whether the readers' processes
    /// live.
    pub(crate) fn sweep_some(&self, heap: &Heap, segments: &Segments) -> bool {
        {
            let mut state = self.lock();
            state.calls += 1;
            if state.all.len() > CHECKS_PER_CALL && state.calls < state.all.len() {
                return true;
            }
        }
        self.sweep(heap, segments)
    }

    /// Frees memory that no reader reads any more. Returns whether some is left.
    pub(crate) fn sweep(&self, heap: &Heap, segments: &Segments) -> bool {
        let mut state = self.lock();
        state.calls = 0;
        #[cfg(test)]
        {
            state.looks += state.all.len();
        }
        let orphans = &mut state.all;
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

    /// Returns whether readers in other sessions have yet to take samples.
    pub(crate) fn are_unread(&self) -> bool {
        self.lock().all.iter().any(|orphan| orphan.pin_lanes.lag_behind(orphan.head))
    }

    #[cfg(test)]
    pub(crate) fn looks(&self) -> usize {
        self.lock().looks
    }

    fn lock(&self) -> MutexGuard<'_, OrphansState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
