//! Moves the samples of one publisher, or of one client of a service, from their rings into the queue
//! towards a peer. Runs in the outbound task of that peer.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::Kind;
use axon_shm::{
    ids::Gid,
    qos::{Qos, Reliability},
};
use axon_transport::internal::session::merge::{Merge, Taken};

use super::{Flow, Moved, Shared, Source, stream::Stream};
use crate::gateway::queue::{Offered, Sample};

/// Samples moved before the next feed has its turn, and bytes.
const BATCH: (usize, usize) = (64, 256 << 10);
/// After a turn in which most samples took the room of others a feed is left alone for so long: what
/// its publisher writes over meanwhile nobody has copied in vain. That is longer where they are long,
/// by so many nanoseconds a byte.
const REST: (Duration, u64) = (Duration::from_millis(1), 2);

/// So many bytes sent are progress.
const PART: u64 = 256 << 10;

pub(super) struct Feed {
    of: Gid,
    /// Of what its sources have, what was not queued and need be.
    samples: Merge<Sample>,
    /// A sample for which there was no room.
    held: Option<Sample>,
    /// Until when it is left alone.
    rests: Option<Instant>,
    /// As long as there is something to be sent, and a while longer.
    stream: Option<Stream>,
    /// Samples that the peer acknowledged.
    acknowledged: u64,
}

impl Feed {
    /// The feed of a publisher or client.
    pub(super) fn new(of: Gid) -> Self {
        Self {
            of,
            samples: Merge::default(),
            held: None,
            rests: None,
            stream: None,
            acknowledged: 0,
        }
    }

    /// From now on it has these sources, and the peer has what was published up to `seen`.
    pub(super) fn set(&mut self, sources: &[Source], seen: Option<u64>) {
        self.samples.set(sources.iter().map(Source::gid));
        self.samples.pass(seen.unwrap_or(0));
    }

    /// Whether it has a sample that was taken and is not queued.
    pub(super) fn holds(&self) -> bool {
        self.held.is_some() || self.samples.holds_any()
    }

    /// Whether something may still wait to be sent.
    pub(super) fn is_in_use(&mut self) -> bool {
        self.stream.take_if(|stream| stream.is_over());
        self.holds() || self.stream.is_some()
    }

    /// The link is over. How many samples were taken and not written.
    pub(super) async fn end(&mut self) -> u64 {
        let held = usize::from(self.held.take().is_some()) + self.samples.held();
        let queued = match self.stream.take() {
            Some(stream) => stream.end().await,
            None => 0,
        };
        held as u64 + queued
    }

    /// The peer acknowledged so many samples that were sent to it.
    pub(super) fn acknowledge(&mut self, samples: u64) {
        self.acknowledged += samples;
        if let Some(stream) = &self.stream {
            stream.has_room();
        }
    }

    /// What changes when it gets on: samples that were acknowledged, and large parts of one that were
    /// sent.
    pub(super) fn progress(&self) -> (u64, u64) {
        (self.acknowledged, self.stream.as_ref().map_or(0, Stream::moved) / PART)
    }

    /// Moves what its sources have to the queue.
    pub(super) fn turn(
        &mut self,
        flow: &Flow,
        sources: &[Source],
        shared: &Arc<Shared>,
        moved: &mut Moved,
    ) {
        if let Some(until) = self.rests {
            if until > Instant::now() {
                moved.again = moved.again.into_iter().chain([until]).min();
                return;
            }
            self.rests = None;
        }
        // As the first asks that reads it: those that ask for more come first.
        let first = sources.iter().find(|source| source.reads(&self.of));
        let qos = first.map_or_else(Qos::keep_all, Source::qos);
        let (mut samples, mut bytes, mut dropped) = (0, 0, 0);
        while samples < BATCH.0 && bytes < BATCH.1 {
            let Some(sample) = self.next(flow.route.kind, sources) else {
                moved.any |= self.samples.is_behind();
                break;
            };
            samples += 1;
            bytes += sample.payload.len();
            match self.queue(sample, &qos, flow, shared) {
                Offered::Queued { dropped: older } => {
                    dropped += older;
                    moved.queued += 1;
                    moved.any = true;
                }
                Offered::Full(sample) | Offered::Over(sample) => {
                    self.held = Some(sample);
                    break;
                }
            }
        }
        // Of BEST_EFFORT little waits, which is gone before such a rest is over, unless the
        // publisher is far ahead.
        let whole = samples >= BATCH.0 || bytes >= BATCH.1;
        let reliable = qos.reliability == Reliability::Reliable;
        if 2 * dropped >= samples as u64 && dropped > 0 && (whole || reliable) {
            let rest = REST.0.max(Duration::from_nanos(bytes as u64 * REST.1));
            self.rests = Some(Instant::now() + rest);
        }
    }

    fn next(&mut self, kind: Kind, sources: &[Source]) -> Option<Sample> {
        let of = self.of;
        if let Some(held) = self.held.take() {
            return Some(held);
        }
        if kind == Kind::Response {
            // They come in whatever order the servers like, all by way of what stands in for the client.
            return sources.iter().find_map(|source| source.take_of(&of));
        }
        let next = self.samples.next(|reader| {
            let content = sources.iter().find(|source| source.gid() == *reader)?.take_of(&of)?;
            // Who is subscribed there counts what is lost by the numbers.
            Some(Taken { number: content.info.sequence, lost: 0, content })
        });
        Some(next?.content)
    }

    pub(super) fn queue(
        &mut self,
        sample: Sample,
        qos: &Qos,
        flow: &Flow,
        shared: &Arc<Shared>,
    ) -> Offered {
        let (of, mut sample) = (self.of, sample);
        let offered = loop {
            let start = || Stream::new(flow.clone(), of, qos, Arc::clone(shared));
            match self.stream.get_or_insert_with(start).offer(sample, qos) {
                // It had nothing to send for a while, and ended.
                Offered::Over(back) => (self.stream, sample) = (None, back),
                offered => break offered,
            }
        };
        if let Offered::Queued { dropped } = offered {
            shared.counters.lost(&flow.topic, "queue", dropped);
        }
        offered
    }
}
