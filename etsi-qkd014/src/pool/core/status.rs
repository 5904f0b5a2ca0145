//! The state of a pool, and what it knows of its KME's stock.

use std::time::Duration;

use crate::Status;

/// The part of the KME's status that a pool uses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stock {
    /// Number of keys that the KME stores; 0 if unknown.
    pub stored_key_count: u64,
    /// Most keys that a call may ask for; 0 if unknown.
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

/// The state of a pool.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PoolStatus {
    /// Number of keys that can be taken now.
    pub held: usize,
    /// Number of keys that were requested and have not come.
    pub asked: usize,
    /// Number of those whose call takes so long that the pool does not count on them.
    pub overdue: usize,
    /// Number of keys that the owner keeps ready, as it last reported.
    pub elsewhere: usize,
    /// Number of keys that should be held or requested: the target that was set, within the KME's
    /// stock.
    pub target: usize,
    /// Keys per second that the KME gives, if it was seen at its limit.
    pub supply: Option<f64>,
    /// Time for which keys have been wanted without any coming. See
    /// [`is_stalled`](Self::is_stalled).
    pub waiting: Option<Duration>,
    /// Number of failed calls for keys since the last one that gave some.
    pub failures: u32,
    /// Number of usable keys that came.
    pub obtained: u64,
    /// Number of keys that the owner put in.
    pub put: u64,
    /// Number of keys taken.
    pub taken: u64,
    /// Number of keys dropped because nobody took them in time.
    pub expired: u64,
    /// Number of keys that came and were refused, for example because of a known key_ID.
    pub unusable: u64,
    /// The KME's stock as last reported.
    pub stock: Option<Stock>,
}

impl PoolStatus {
    /// Returns whether keys have been wanted for a second or more and none came.
    #[must_use]
    pub fn is_stalled(&self) -> bool {
        self.waiting.is_some_and(|time| time >= Duration::from_secs(1))
    }
}
