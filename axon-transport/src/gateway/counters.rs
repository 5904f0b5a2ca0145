//! What a link carried and what was dropped on the way, for status.

use std::{
    collections::BTreeMap,
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering},
    },
};

use super::keyring::lock;

/// The counters of one peer. Relaxed throughout: they are shown, never acted upon.
#[derive(Debug, Default)]
pub(super) struct Counters {
    samples_in: AtomicU64,
    bytes_in: AtomicU64,
    samples_out: AtomicU64,
    bytes_out: AtomicU64,
    dropped: Mutex<BTreeMap<&'static str, u64>>,
}

impl Counters {
    /// A sample arrived and was published here.
    pub(super) fn arrived(&self, bytes: usize) {
        self.samples_in.fetch_add(1, Ordering::Relaxed);
        self.bytes_in.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// A sample was handed to QUIC.
    pub(super) fn sent(&self, bytes: usize) {
        self.samples_out.fetch_add(1, Ordering::Relaxed);
        self.bytes_out.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// `count` samples were dropped for `cause`.
    pub(super) fn dropped(&self, cause: &'static str, count: u64) {
        if count > 0 {
            *lock(&self.dropped).entry(cause).or_default() += count;
        }
    }

    /// Puts the counters into `status`.
    pub(super) fn fill(&self, status: &mut crate::daemon::status::LinkStatus) {
        status.samples_in = self.samples_in.load(Ordering::Relaxed);
        status.bytes_in = self.bytes_in.load(Ordering::Relaxed);
        status.samples_out = self.samples_out.load(Ordering::Relaxed);
        status.bytes_out = self.bytes_out.load(Ordering::Relaxed);
        status.dropped =
            lock(&self.dropped).iter().map(|(cause, n)| ((*cause).to_owned(), *n)).collect();
    }
}
