//! The counters of a relayed session, which the daemon's status shows.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::status::RelayStatus;

/// Maximum length in bytes of the reason for which a session is relayed.
pub(super) const MAX_REASON: usize = 200;

/// Counts the samples and bytes that cross a relay's socket.
#[derive(Debug, Default)]
pub struct RelayCounters {
    reason: String,
    samples_in: AtomicU64,
    bytes_in: AtomicU64,
    samples_out: AtomicU64,
    bytes_out: AtomicU64,
    lost: AtomicU64,
}

impl RelayCounters {
    /// Creates the counters of a session that is relayed for this reason.
    pub fn new(reason: &str) -> Self {
        let reason = crate::text::plain(reason, MAX_REASON);
        Self { reason, ..Self::default() }
    }

    // All accesses are relaxed: the counters are independent of other memory.

    pub(crate) fn arrived(&self, bytes: usize) {
        self.samples_in.fetch_add(1, Ordering::Relaxed);
        self.bytes_in.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    pub(crate) fn departed(&self, bytes: usize) {
        self.samples_out.fetch_add(1, Ordering::Relaxed);
        self.bytes_out.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Counts samples of the session's publishers that did not arrive here, or samples of others that the session did
    /// not take.
    pub fn lost(&self, samples: u64) {
        self.lost.fetch_add(samples, Ordering::Relaxed);
    }

    /// Returns the counters in the form that `axon status` shows.
    pub fn show(&self) -> RelayStatus {
        RelayStatus {
            reason: self.reason.clone(),
            samples_in: self.samples_in.load(Ordering::Relaxed),
            bytes_in: self.bytes_in.load(Ordering::Relaxed),
            samples_out: self.samples_out.load(Ordering::Relaxed),
            bytes_out: self.bytes_out.load(Ordering::Relaxed),
            lost: self.lost.load(Ordering::Relaxed),
        }
    }
}
