//! What is known of flows whose daemon is gone, for the next daemon of the same identity.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

use super::{progress::SentProgress, stall::Progress};

/// The flow of a publisher that ended with samples that are not acknowledged. It is no larger than a few words, and there
/// is one at most for each lane of the relays that are kept.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UnfinishedFlow {
    /// What the peer did, and did not do.
    pub(super) progress: Progress,
    /// How far QUIC took its samples.
    pub(super) sent_progress: SentProgress,
}

/// Those of one route, by publisher.
pub(crate) type UnfinishedFlows = HashMap<Gid, UnfinishedFlow>;

impl UnfinishedFlow {
    /// The worse of two flows of one publisher, which go on as one.
    pub(crate) fn and(self, other: Self) -> Self {
        Self {
            progress: self.progress.and(other.progress, (0, 0)),
            sent_progress: self.sent_progress.max(other.sent_progress),
        }
    }

    /// The samples waited for so long while no daemon of the peer was there. `idle` of it counts as time without progress.
    pub(crate) fn keep(&mut self, kept: Duration, idle: Duration) {
        self.progress.keep(kept, idle);
    }
}
