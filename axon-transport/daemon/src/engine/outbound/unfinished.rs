//! The state of flows whose daemon is gone, for the next daemon of the same identity.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

use super::{progress::SentProgress, stall::Progress};

/// The flow of a publisher that ended with unacknowledged samples. It is only a few words long, and there is at most
/// one for each lane of the kept relays.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UnfinishedFlow {
    /// The peer's progress, and its time without progress.
    pub(super) progress: Progress,
    /// The position up to which QUIC took its samples.
    pub(super) sent_progress: SentProgress,
}

/// The unfinished flows of one route, by publisher.
pub(crate) type UnfinishedFlows = HashMap<Gid, UnfinishedFlow>;

impl UnfinishedFlow {
    /// Merges two flows of one publisher that continue as one, and keeps the worse values.
    pub(crate) fn and(self, other: Self) -> Self {
        Self {
            progress: self.progress.and(other.progress, (0, 0)),
            sent_progress: self.sent_progress.max(other.sent_progress),
        }
    }

    /// Adds the time for which the samples waited while no daemon of the peer existed. `idle` of it counts as time
    /// without progress.
    pub(crate) fn keep(&mut self, kept: Duration, idle: Duration) {
        self.progress.keep(kept, idle);
    }
}
