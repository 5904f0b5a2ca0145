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
    /// Those who may be reading it.
    pub(crate) pin_lanes: PinLanes,
    /// Below this position are its samples.
    pub(crate) head: u64,
    pub(crate) blocks: Vec<Block>,
    /// The numbers of the segments of its large samples.
    pub(crate) samples: Vec<u32>,
    /// What all of it takes of the memory that its publisher shared with others, until it is freed.
    pub(crate) _holding: Holding,
}

/// So many of them are looked at whenever one comes or a reader leaves.
const CHECKS_PER_CALL: usize = 64;

/// The memory of a session's publishers that are gone.
#[derive(Default)]
pub(crate) struct Orphans(Mutex<OrphansState>);

#[derive(Default)]
struct OrphansState {
    all: Vec<Orphan>,
    /// How often [`sweep_some`](Orphans::sweep_some) was called since all were looked at.
    calls: usize,
    /// How many were looked at since the start.
    #[cfg(test)]
    looks: usize,
}

impl Orphans {
    pub(crate) fn adopt(&self, orphan: Orphan) {
        self.lock().all.push(orphan);
    }

    /// As [`sweep`](Self::sweep), but of many once for as many calls as there are: thousands of publishers end one after
    /// the other, and a look at each asks whether its readers' processes live.
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

    /// Takes back what nobody reads any more. Whether something is left.
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

    /// Whether readers in other sessions have yet to take samples.
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
