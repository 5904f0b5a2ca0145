//! The samples that wait for one peer, for status.

use std::time::Duration;

use axon_transport::status::LinkStatus;

use crate::engine::rank::Class;

/// Bytes and samples that wait for one peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Backlog {
    /// Bytes that wait for QUIC, by the class of their flow's next sample.
    pub(super) bytes: [usize; 4],
    /// The time at which the oldest waiting sample was taken from its ring.
    pub(crate) oldest: Option<Duration>,
}

impl Backlog {
    /// Writes the backlog into the status of a link.
    pub(crate) fn fill(&self, status: &mut LinkStatus, now: Duration) {
        let of = |class: Class| self.bytes[class as usize] as u64;
        status.waiting_bytes = self.bytes.iter().sum::<usize>() as u64;
        status.waiting.services = of(Class::Service);
        status.waiting.small_reliable = of(Class::SmallReliable);
        status.waiting.small_best_effort = of(Class::SmallBestEffort);
        status.waiting.bulk = of(Class::Bulk);
        status.oldest_waits =
            self.oldest.map_or(Duration::ZERO, |oldest| now.saturating_sub(oldest));
    }
}
