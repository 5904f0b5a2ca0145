//! How a pool stands, and what it knows of its KME's stock.

use std::time::Duration;

use crate::Status;

/// The part of the KME's status that a pool depends on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stock {
    /// Keys that the KME stores; 0: unknown.
    pub stored_key_count: u64,
    /// Most keys that a call may ask for; 0: unknown.
    pub max_key_per_request: u64,
}

impl From<&Status> for Stock {
    fn from(status: &Status) -> Self {
        Self {
            stored_key_count: status.stored_key_count,
            max_key_per_request: status.max_key_per_request,
        }
    }
}

/// How a pool stands.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PoolStatus {
    /// Keys that can be taken now.
    pub held: usize,
    /// Keys asked for and not there.
    pub asked: usize,
    /// Of them those whose call takes so long that they are not counted on.
    pub overdue: usize,
    /// Keys that the owner keeps ready, as it last said.
    pub elsewhere: usize,
    /// Keys that should be held or asked for: what was set, within the KME's stock.
    pub target: usize,
    /// Keys a second that the KME gives, where it was seen at its limit.
    pub supply: Option<f64>,
    /// How long keys have been wanted without any coming. See [`is_stalled`](Self::is_stalled).
    pub waiting: Option<Duration>,
    /// Failed calls for keys since the last one that gave some.
    pub failures: u32,
    /// Keys that came and could be taken.
    pub obtained: u64,
    /// Keys put in by the owner.
    pub put: u64,
    /// Keys taken.
    pub taken: u64,
    /// Keys dropped because nobody took them in time.
    pub expired: u64,
    /// Keys that came and were refused, as under a key_ID that was there before.
    pub unusable: u64,
    /// What the KME last said of its stock.
    pub stock: Option<Stock>,
}

impl PoolStatus {
    /// Whether keys have been wanted for a second or more and none came.
    #[must_use]
    pub fn is_stalled(&self) -> bool {
        self.waiting.is_some_and(|time| time >= Duration::from_secs(1))
    }
}
