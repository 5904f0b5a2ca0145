//! Publishers that ended before this subscription learned of their grants.

use axon_shm::internal::MAX_GAP;

use super::matched_readers::MatchedReaders;
use crate::ids::Gid;

impl MatchedReaders {
    /// `writer` has ended, and there were `samples` for us. Returns whether they are counted as lost: only if it was asked
    /// and its answer never came. Otherwise its ring is, or was, read, and tells what was lost.
    pub(in crate::session) fn count_unmet(&mut self, writer: &Gid, samples: u64) -> bool {
        let asked = self.pending.remove(writer).is_some();
        let reads = self.matched_readers.iter().any(|slot| slot.reader.writer() == *writer);
        // The writer's process may say any number. A loss that cannot be is not counted.
        let counts = asked && !reads && samples <= MAX_GAP;
        if counts {
            self.lost = self.lost.saturating_add(samples);
        }
        counts
    }
}
