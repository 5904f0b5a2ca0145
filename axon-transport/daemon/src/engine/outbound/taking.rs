//! Moves the samples of one flow from their rings into its queue.

use std::{sync::Arc, time::Duration};

use axon_envelope::Kind;
use axon_shm::{
    ids::Gid,
    qos::{Durability, Qos},
};
use axon_transport::internal::session::merge::{Merge, Taken};

use super::{
    queue::{Offered, Queue},
    source::Source,
};
use crate::engine::{counters::Counters, rings::Sample};

/// Samples, and bytes, that one turn moves from the rings.
const FILL: (usize, usize) = (256, 256 << 10);
/// A KEEP_ALL flow with so many bytes waiting leaves further samples in the ring, which keeps them.
const AHEAD: usize = 1 << 20;
/// Bytes that a KEEP_LAST flow moves that is behind. What it leaves in the ring is replaced there without a copy.
const BEHIND: usize = 64 << 10;
/// Turns that move a burst while QUIC takes nothing. A publisher that never rests must not keep the others waiting.
const BURST: usize = 16;

/// The samples of a flow that are in its rings.
pub(super) struct Taking {
    /// The publisher, or the client of a service.
    of: Gid,
    kind: Kind,
    /// The samples of all sources, in one order.
    merge: Merge<Sample>,
    /// A sample that the queue had no room for.
    held: Option<Sample>,
    /// Whether the rings may hold more samples than the last turn moved.
    more: bool,
    /// The relay whose losses are counted, and how many are.
    counted: Option<(Gid, u64)>,
}

impl Taking {
    /// Takes from nothing yet.
    pub(super) fn new(of: Gid, kind: Kind) -> Self {
        Self { of, kind, merge: Merge::default(), held: None, more: false, counted: None }
    }

    /// Takes these sources; the peer has the samples up to number `seen`.
    pub(super) fn set_sources(&mut self, sources: &[Source], seen: Option<u64>) {
        self.merge.set(sources.iter().map(Source::gid));
        self.merge.pass(seen.unwrap_or(0));
        self.more = true;
    }

    /// Samples wait in a ring.
    pub(super) fn handle_samples(&mut self) {
        self.more = true;
    }

    /// Whether there may be samples to move.
    pub(super) fn has_more(&self) -> bool {
        self.more || self.held.is_some()
    }

    /// Whether a sample found no room.
    pub(super) fn is_held(&self) -> bool {
        self.held.is_some()
    }

    /// Whether it has taken no sample that is not in the queue.
    pub(super) fn is_idle(&self) -> bool {
        self.held.is_none() && !self.merge.holds_any()
    }

    /// Forgets the samples that it has taken and that are not in the queue. Returns how many.
    pub(super) fn end(&mut self) -> usize {
        usize::from(self.held.take().is_some()) + self.merge.held()
    }

    /// Moves samples from the rings into the queue. Returns how many were queued.
    pub(super) fn fill(
        &mut self,
        sources: &[Source],
        queue: &mut Queue,
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> u32 {
        if !self.has_more() || !queue.wants_more(now) {
            return 0;
        }
        let first = sources.iter().find(|source| source.reads(&self.of));
        queue.set_qos(&first.map_or_else(Qos::keep_all, Source::qos));
        let most_bytes = self.leave_stale(sources, queue, now);
        let (mut samples, mut bytes, mut dropped) = (0, 0, 0);
        while samples < FILL.0 && bytes < most_bytes {
            if queue.keeps_all() && queue.waiting_bytes() >= AHEAD {
                break;
            }
            let Some(sample) = self.next(sources, now) else {
                self.more = self.merge.is_behind();
                if !self.more {
                    queue.handle_empty_ring();
                }
                break;
            };
            bytes += sample.payload.len();
            match queue.offer(sample, now) {
                Offered::Queued { dropped: older } => {
                    samples += 1;
                    dropped += older;
                }
                Offered::Full(sample) => {
                    self.held = Some(sample);
                    break;
                }
            }
        }
        counters.lost(topic, "queue", dropped);
        self.count_overwritten(sources, topic, counters);
        samples as u32
    }

    /// Moves a burst into the queue while QUIC takes nothing. Returns how many samples were queued.
    pub(super) fn take_burst(
        &mut self,
        sources: &[Source],
        queue: &mut Queue,
        topic: &Arc<str>,
        counters: &Counters,
        now: Duration,
    ) -> u32 {
        let mut all = 0;
        for _ in 0..BURST {
            let queued = self.fill(sources, queue, topic, counters, now);
            all += queued;
            if queued == 0 || !self.more {
                break;
            }
        }
        all
    }

    /// Passes over the samples in the rings that the queue would drop for newer ones. Returns how many bytes are then
    /// to be moved.
    fn leave_stale(&self, sources: &[Source], queue: &Queue, now: Duration) -> usize {
        let Some(depth) = queue.depth().filter(|_| queue.is_behind(now)) else { return FILL.1 };
        for source in sources.iter().filter(|source| source.reads(&self.of)) {
            source.skip_of(&self.of, depth);
        }
        // What is best effort is judged by its age, so it has to be looked at; that is the depth at most.
        if queue.keeps_bursts() { BEHIND } else { usize::MAX }
    }

    /// Counts the samples that newer ones replaced in the ring. The relay that asks for most loses the fewest: a sample
    /// that it has is sent.
    pub(super) fn count_overwritten(
        &mut self,
        sources: &[Source],
        topic: &Arc<str>,
        counters: &Counters,
    ) {
        let Some(first) = sources.iter().find(|source| source.reads(&self.of)) else { return };
        let (relay, lost) = (first.gid(), first.lost_of(&self.of));
        let before = self.counted.replace((relay, lost));
        let counted = match before {
            Some((before, counted)) if before == relay => counted,
            // What a relay with history passes over when it begins is no loss.
            _ if first.qos().durability == Durability::TransientLocal => lost,
            _ => 0,
        };
        counters.lost(topic, "queue", lost.saturating_sub(counted));
    }

    fn next(&mut self, sources: &[Source], now: Duration) -> Option<Sample> {
        let of = self.of;
        if let Some(held) = self.held.take() {
            return Some(held);
        }
        if self.kind == Kind::Response {
            return sources.iter().find_map(|source| source.take_of(&of, now));
        }
        let next = self.merge.next(|reader| {
            let source = sources.iter().find(|source| source.gid() == *reader)?;
            let content = source.take_of(&of, now)?;
            Some(Taken { number: content.info.sequence, lost: 0, content })
        });
        Some(next?.content)
    }
}
