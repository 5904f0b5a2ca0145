//! The state of the paths to each peer.

use std::collections::HashMap;

use axon_shm::ids::DaemonId;

use super::{
    choice::PathChoice, failover::Failover, search::PathSearch, take_over_budget::TakeOvers,
};

/// The paths to the peers that may have two links at a time.
#[derive(Default)]
pub(in crate::engine::links) struct PeerPaths {
    pub(super) all: HashMap<DaemonId, Paths>,
    pub(super) take_overs: TakeOvers,
}

/// The paths to one peer.
pub(super) struct Paths {
    pub(super) search: PathSearch,
    pub(super) failover: Failover,
    pub(super) choice: PathChoice,
}
