//! Sends the BEST_EFFORT samples of one flow: each over a stream of its own, which is reset when the sample's time is
//! over. Two samples at a time are with QUIC, or as many as fit the congestion window. The rest waits in the queue,
//! where a newer sample replaces it.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use axon_envelope::Delivery;
use bytes::Bytes;
use quinn_proto::{Connection, Dir, StreamId, VarInt, WriteError};

use super::{
    FlowPause,
    credit::{CreditShare, UsedCredit},
    info::FlowInfo,
};
use crate::{
    engine::{
        counters::Counters,
        outbound::{queue::Queue, source::FlowProgress},
        quic::connection::Carrier,
        rank::SMALL,
        sample::{frames::Frames, protection::Seal},
    },
    link::CloseCode,
};

/// A sample without a lifespan that is older than this once it has crossed the link is dropped for a newer one.
pub(super) const DEFAULT_LIFESPAN: Duration = Duration::from_millis(200);
/// Maximum time that QUIC may take to deliver a sample, which is then given up.
const DELIVERY_TIMEOUT: Duration = Duration::from_secs(10);
/// The same for a sample with an envelope. The peer erases the key 5 s after it learned that the key is retired, and a
/// message that comes later ends the link.
const SEALED_DELIVERY_TIMEOUT: Duration = Duration::from_secs(4);
/// Number of samples that may be in flight whatever the congestion window.
const ALWAYS: usize = 2;

/// A sample that QUIC does not have entirely.
#[derive(Debug)]
struct Writing {
    stream: StreamId,
    pending: VecDeque<Bytes>,
    sample: SampleInFlight,
}

/// A sample in flight.
#[derive(Debug)]
struct SampleInFlight {
    stream: StreamId,
    priority: i32,
    /// Bytes including header and envelope.
    bytes: u64,
    /// Bytes of the serialized message; `payload` has the bytes that are sent of it.
    length: usize,
    payload: usize,
    begun: Duration,
    /// The time at which it is given up.
    deadline: Duration,
    /// The credit that it uses.
    _credit: CreditShare,
}

/// The best-effort samples of one flow.
#[derive(Debug, Default)]
pub(super) struct BestEffort {
    writing: Option<Writing>,
    under_way: VecDeque<SampleInFlight>,
    /// Number of samples that arrived.
    arrived: u64,
    /// The time that the last sample took to arrive.
    took: Duration,
}

impl BestEffort {
    /// Returns whether QUIC has a part of a sample.
    pub(super) fn is_writing(&self) -> bool {
        self.writing.is_some()
    }

    /// Returns the number of samples that arrived.
    pub(super) fn arrived(&self) -> u64 {
        self.arrived
    }

    /// Returns whether no sample is in flight.
    pub(super) fn is_idle(&self) -> bool {
        self.writing.is_none() && self.under_way.is_empty()
    }

    /// Takes the stream of a sample that QUIC does not have entirely. The sample is given up.
    pub(super) fn take_cut(&mut self) -> Option<StreamId> {
        Some(self.writing.take()?.stream)
    }

    /// Drops samples that are too late. Returns the reason why QUIC may not take the next sample now, if it may not.
    pub(super) fn look_at_next(
        &mut self,
        info: &FlowInfo,
        queue: &mut Queue,
        carrier: &Carrier<'_>,
        counters: &Counters,
        now: Duration,
    ) -> Option<FlowPause> {
        if self.writing.is_some() {
            return None;
        }
        let under_way: u64 = self.under_way.iter().map(|sample| sample.bytes).sum();
        if self.under_way.len() >= ALWAYS && under_way >= carrier.window() {
            return Some(FlowPause::Blocked);
        }
        counters.lost(&info.topic, "late", queue.drop_late(DEFAULT_LIFESPAN, self.took, now));
        queue.peek().is_none().then_some(FlowPause::Empty)
    }

    /// Hands the next sample, or a part of it, to QUIC. Returns `None` if the flow can continue.
    #[expect(clippy::too_many_arguments, reason = "the parts of a flow, borrowed one by one")]
    pub(super) fn write(
        &mut self,
        info: &FlowInfo,
        mut credit: CreditShare,
        queue: &mut Queue,
        frames: &mut Frames,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut FlowProgress,
        now: Duration,
    ) -> Option<FlowPause> {
        if self.writing.is_none() {
            let Some(next) = queue.peek() else { return Some(FlowPause::Empty) };
            let uses = UsedCredit::of(next.size(), next.size());
            let is_open = carrier.is_open_to(info.best_effort_rank(next.payload.len()));
            if next.length() > SMALL && !(is_open && credit.may_use(uses)) {
                return Some(FlowPause::NoCredit);
            }
            let Some(stream) = carrier.quic.streams().open(Dir::Uni) else {
                return Some(FlowPause::NoStream);
            };
            let Some(sample) = queue.pop_best_effort() else { return Some(FlowPause::Empty) };
            let (sequence, length) = (sample.info.sequence, sample.length());
            let payload = sample.payload.len();
            done.sequence = done.sequence.max(Some(sequence));
            let mut headers = carrier.seal.short_headers();
            headers = headers.filter(|_| info.short_headers && !sample.is_compressed());
            let short = headers.is_some();
            let (delivery, headers) = (Delivery::BestEffort, headers.as_mut());
            if carrier.seal.write(&sample, info.route, delivery, headers, frames, now).is_err() {
                counters.lost(&info.topic, "no_key", 1);
                let _ = carrier.quic.send_stream(stream).reset(goodbye());
                return None;
            }
            let mut pending = VecDeque::from(frames.take());
            let header = info.best_effort_header(short);
            pending.push_front(Bytes::copy_from_slice(&header.encode()));
            let rank = carrier.rank(info.best_effort_rank(payload));
            let priority = rank.of_stream() - i32::from(!self.under_way.is_empty());
            let _ = carrier.quic.send_stream(stream).set_priority(priority);
            carrier.streams.insert(stream, carrier.flow);
            let most = match carrier.seal {
                Seal::Link => DELIVERY_TIMEOUT,
                Seal::Envelope { .. } => SEALED_DELIVERY_TIMEOUT,
            };
            let left = sample.lifespan_left(now).unwrap_or(most).min(most);
            let bytes = pending.iter().map(|piece| piece.len() as u64).sum();
            credit.set(uses);
            let (begun, deadline) = (now, now + left);
            let sample = SampleInFlight {
                stream,
                priority,
                bytes,
                length,
                payload,
                begun,
                deadline,
                _credit: credit,
            };
            self.writing = Some(Writing { stream, pending, sample });
        }
        let Writing { stream, pending, sample } = self.writing.as_mut()?;
        carrier.limit(carrier.rank(info.best_effort_rank(sample.payload)));
        let mut quic = carrier.quic.send_stream(*stream);
        match quic.write_chunks(pending.make_contiguous()) {
            Ok(taken) => {
                pending.drain(..taken.chunks);
                carrier.taken += taken.bytes as u64;
                if pending.is_empty() {
                    let _ = quic.finish();
                    self.under_way.extend(self.writing.take().map(|writing| writing.sample));
                }
                None
            }
            Err(WriteError::Blocked) => Some(FlowPause::Blocked),
            Err(WriteError::Stopped(_) | WriteError::ClosedStream) => {
                let _ = quic.reset(goodbye());
                counters.lost(&info.topic, "no_route", 1);
                self.writing = None;
                None
            }
        }
    }

    /// Handles the end of a sample's stream: the peer's QUIC has all of the sample, or wants no more of it.
    pub(super) fn handle_finished(
        &mut self,
        now: Duration,
        stream: StreamId,
        quic: &mut Connection,
        counters: &Counters,
    ) {
        let Some(at) = self.under_way.iter().position(|sample| sample.stream == stream) else {
            return;
        };
        let Some(sample) = self.under_way.remove(at) else { return };
        self.arrived += 1;
        self.took = now.saturating_sub(sample.begun);
        counters.sent(sample.length);
        if let Some(first) = self.under_way.front() {
            let _ = quic.send_stream(first.stream).set_priority(first.priority + 1);
        }
    }

    /// Returns when the next sample is given up.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let writing = self.writing.as_ref().map(|writing| writing.sample.deadline);
        self.under_way.iter().map(|sample| sample.deadline).chain(writing).min()
    }

    /// Handles that the peer wants no more of a sample.
    pub(super) fn handle_stopped(
        &mut self,
        stream: StreamId,
        quic: &mut Connection,
        counters: &Counters,
        topic: &Arc<str>,
    ) {
        let before = self.under_way.len();
        self.under_way.retain(|sample| sample.stream != stream);
        let writing = self.writing.take_if(|writing| writing.stream == stream).is_some();
        if writing || self.under_way.len() < before {
            let _ = quic.send_stream(stream).reset(goodbye());
            counters.lost(topic, "no_route", 1);
        }
    }

    /// Gives up the samples whose time is over. Returns whether there were any.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        topic: &Arc<str>,
    ) -> bool {
        let mut late = Vec::new();
        late.extend(self.writing.take_if(|w| w.sample.deadline <= now).map(|w| w.stream));
        self.under_way.retain(|sample| {
            let over = sample.deadline <= now;
            late.extend(over.then_some(sample.stream));
            !over
        });
        for stream in &late {
            // Reset, not finished: otherwise the sample would look complete.
            let _ = carrier.quic.send_stream(*stream).reset(goodbye());
            carrier.streams.remove(stream);
        }
        counters.lost(topic, "late", late.len() as u64);
        !late.is_empty()
    }

    /// Moves the flow to a new link. The old link delivers the samples that it has, and the rest of a sample if it
    /// takes that.
    pub(super) fn leave(
        &mut self,
        old: Option<&mut Connection>,
        counters: &Counters,
        topic: &Arc<str>,
    ) {
        let Some(old) = old else { return self.link_over(counters, topic) };
        if let Some(Writing { stream, mut pending, sample }) = self.writing.take() {
            old.set_send_window(u64::MAX);
            let mut quic = old.send_stream(stream);
            let whole: usize = pending.iter().map(Bytes::len).sum();
            let taken = quic.write_chunks(pending.make_contiguous()).map_or(0, |t| t.bytes);
            if taken == whole {
                let _ = quic.finish();
                self.under_way.push_back(sample);
            } else {
                let _ = quic.reset(goodbye());
                counters.lost(topic, "no_link", 1);
            }
        }
        for sample in self.under_way.drain(..) {
            counters.sent(sample.length);
        }
    }

    /// Handles the end of the link: samples in flight are lost.
    pub(super) fn link_over(&mut self, counters: &Counters, topic: &Arc<str>) {
        let lost = self.under_way.len() + usize::from(self.writing.is_some());
        counters.lost(topic, "no_link", lost as u64);
        *self = Self::default();
    }
}

fn goodbye() -> VarInt {
    VarInt::from_u32(CloseCode::Goodbye.code())
}

#[cfg(test)]
mod tests {
    use axon_envelope::Limits;

    use super::*;

    #[test]
    fn sealed_sample_is_given_up_before_the_peer_erases_its_key() {
        // A round trip of a second passes between the two.
        let erased = Limits::default().best_effort_grace;
        assert!(SEALED_DELIVERY_TIMEOUT + Duration::from_secs(1) <= erased, "{erased:?}");
    }
}
