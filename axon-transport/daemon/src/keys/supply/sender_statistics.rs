//! What a sender of messages counts, and its statistics for status.

use axon_envelope::Retirement;
use serde::Serialize;

/// The statistics of a [`KeySender`](super::KeySender), for status. Rates are keys per second.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct SenderStatistics {
    /// Keys that are READY, including the keys in use, on both connections.
    pub ready: usize,
    /// Keys that are announced and not answered.
    pub announced: usize,
    /// Keys that are requested and have not arrived.
    pub asked: usize,
    /// The number of keys that should be in flight or READY, within the KME's stock.
    pub target: usize,
    /// Keys per second that the messages and their copies need.
    pub demand: f64,
    /// Keys per second that the KME gives, if the KME was observed at its limit.
    pub supply: Option<f64>,
    /// The time from the request for a key to READY, in milliseconds.
    pub lead_ms: f64,
    /// Messages that were sealed under retired keys.
    pub sealed: u64,
    /// Retired keys.
    pub retired: u64,
    /// Keys that the peer could not fetch or did not answer, or that the KME gave before.
    pub failed: u64,
    /// Keys whose proof did not match: the peer's KME gave it another key under the same key_ID.
    pub disagreed: u64,
    /// The number of times that a message was refused for lack of a key.
    pub no_key: u64,
    /// The reason for which the last key or call failed.
    pub last_failure: Option<String>,
}

/// What a sender counts.
#[derive(Default)]
pub(super) struct SenderCounts {
    pub(super) sealed: u64,
    pub(super) retired: u64,
    pub(super) failed: u64,
    pub(super) disagreed: u64,
    pub(super) no_key: u64,
    pub(super) last_failure: Option<String>,
}

impl SenderCounts {
    /// Counts a retired key.
    pub(super) fn retired(&mut self, retirement: &Retirement) {
        self.retired += 1;
        self.sealed += retirement.used.len() as u64;
    }

    /// Counts a key that failed.
    pub(super) fn failed(&mut self, why: String) {
        self.failed += 1;
        self.last_failure = Some(why);
    }
}
