//! One flow: the samples of a publisher, or of a client's service calls, towards one peer. It moves them from their
//! rings into its queue, and from there into QUIC streams as the scheduler gives it turns.

mod batch;
mod best_effort;
mod credit;
mod taking;
#[cfg(test)]
mod tests;

use std::{rc::Rc, sync::Arc, time::Duration};

use axon_envelope::{Delivery, Kind, Route};
use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::config::TopicPriority;
use quinn_proto::{Dir, StreamId, VarInt, WriteError};

pub(super) use self::credit::{Credit, CreditQueue, PeerCredit};
use self::{
    batch::{Batch, Sealed},
    best_effort::BestEffort,
    credit::{ALWAYS, CreditShare},
    taking::Taking,
};
use super::{
    budget::Budget,
    queue::Queue,
    schedule::{Class, Rank, SMALL},
    served::FlowRoute,
    source::{Done, Source},
};
use crate::{
    engine::{
        connection::Carrier, counters::Counters, frames::Frames, inbound::StreamHeader,
        short_header::ShortHeaders,
    },
    keys::NoKey,
    link::CloseCode,
};

/// Bytes of samples that are sealed and written together.
const TOGETHER: usize = 64 << 10;
/// A sample of at most so many bytes is copied to its neighbours.
const COPIED: usize = 4096;
/// Bytes that one turn writes before other flows have theirs.
const TURN: usize = 256 << 10;
/// Bytes that count as progress of a long sample.
const PART: u64 = 256 << 10;
/// A reliable stream that sent nothing for so long is finished.
pub(super) const STREAM_IDLE: Duration = Duration::from_secs(30);

/// Why a flow has nothing to write now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pause {
    /// Its turn is over. More waits.
    Turn,
    /// It has nothing to send.
    Empty,
    /// QUIC takes no more, of this stream or of the connection, until it says so.
    Blocked,
    /// The peer allows no more streams now.
    NoStream,
    /// There is no key for the next message.
    NoKey,
    /// The peer does not take in the next sample before others.
    NoCredit,
}

/// One flow.
pub(super) struct Flow {
    pub(super) route_number: u32,
    /// The publisher, or the client of a service.
    pub(super) of: Gid,
    pub(super) topic: Arc<str>,
    route: Route,
    /// Of the topic.
    priority: TopicPriority,
    /// Whether the peer acknowledges the samples.
    acknowledged: bool,
    /// Whether the peer reads short headers.
    short_headers: bool,
    taking: Taking,
    /// Samples for which the sender of message keys was not told that it will need keys.
    undemanded: u32,
    queue: Queue,
    /// The stream of its RELIABLE samples.
    stream: Option<StreamId>,
    /// The headers of that stream, or of the one that the pending batch will open, if they are short.
    headers: Option<ShortHeaders>,
    /// The priority that QUIC knows of the stream.
    stream_priority: i32,
    frames: Frames,
    batch: Batch,
    best_effort: BestEffort,
    /// When it last handed something to QUIC.
    active_at: Duration,
    /// Whether QUIC said that it takes no more.
    pub(super) blocked: bool,
    /// Whether the peer did not take in its next sample when it had its last turn.
    pub(super) waits_for_credit: bool,
    /// Its samples were given up.
    is_given_up: bool,
    /// When [`handle_timeout`](Self::handle_timeout) is due, if it is.
    pub(super) timer: Option<Duration>,
    acknowledged_samples: u64,
    /// Bytes that QUIC took.
    taken_bytes: u64,
    /// The credit that the samples use that were sent over the stream.
    credit: CreditShare,
}

impl Flow {
    /// A flow without sources.
    pub(super) fn new(
        of: Gid,
        of_route: &FlowRoute,
        qos: &Qos,
        budget: &Rc<Budget>,
        now: Duration,
    ) -> Self {
        let FlowRoute {
            number,
            ref topic,
            route,
            priority,
            acknowledged,
            short_headers,
            ref responses,
            ref credit,
        } = *of_route;
        // Each response has a number that rises, so that the peer can acknowledge it and drop a second copy.
        let numbers = (acknowledged && route.kind == Kind::Response).then(|| responses.clone());
        Self {
            route_number: number,
            of,
            topic: Arc::clone(topic),
            route,
            priority,
            acknowledged,
            short_headers,
            taking: Taking::new(of, route.kind, numbers),
            undemanded: 0,
            queue: Queue::new(qos, Rc::clone(budget)),
            stream: None,
            headers: None,
            stream_priority: 0,
            frames: Frames::default(),
            batch: Batch::default(),
            best_effort: BestEffort::default(),
            active_at: now,
            blocked: false,
            waits_for_credit: false,
            is_given_up: false,
            timer: None,
            acknowledged_samples: 0,
            taken_bytes: 0,
            credit: credit.share(),
        }
    }

    /// Takes these sources; the peer has the samples up to number `seen`.
    pub(super) fn set_sources(&mut self, sources: &[Source], seen: Option<u64>) {
        self.taking.set_sources(sources, seen);
    }

    /// Whether it has no sample that waits or is not acknowledged. There may be some in its rings.
    fn has_none(&self) -> bool {
        self.taking.is_idle()
            && self.queue.is_empty()
            && self.batch.is_empty()
            && self.best_effort.is_idle()
    }

    /// Whether nothing of it waits or is not acknowledged, and no stream is open.
    pub(super) fn is_idle(&self) -> bool {
        self.has_none() && self.stream.is_none()
    }

    /// Whether nothing of it waits, in its rings either, or is not acknowledged.
    pub(super) fn is_quiet(&self) -> bool {
        self.has_none() && !self.taking.has_more()
    }

    /// Whether its stream carries nothing, and nothing in its rings is to be looked at: its timer is free.
    pub(super) fn has_idle_stream(&self) -> bool {
        self.stream.is_some()
            && self.queue.is_empty()
            && self.batch.is_empty()
            && !self.taking.has_more()
    }

    /// The rank of what it sends next, or `None` if it has nothing to send.
    pub(super) fn rank(&self) -> Option<Rank> {
        let length = match self.queue.peek() {
            _ if !self.batch.is_empty() => self.batch.left(),
            Some(next) => next.payload.len(),
            None if self.best_effort.is_writing() => usize::MAX,
            None if self.taking.has_more() => 0,
            None => return None,
        };
        let reliable = self.queue.delivery() == Delivery::Reliable;
        let class = Class::of(self.route.kind != Kind::Topic, reliable, length);
        Some(Rank { priority: self.priority, class })
    }

    /// Samples wait in a ring.
    pub(super) fn handle_samples(&mut self) {
        self.taking.handle_samples();
    }

    /// Moves a burst of a KEEP_LAST publisher into the queue while QUIC takes nothing: in the ring it would be
    /// overwritten. BEST_EFFORT samples stay there: only the newest will be sent. A KEEP_ALL publisher waits.
    pub(super) fn take_burst(&mut self, sources: &[Source], counters: &Counters, now: Duration) {
        // A flow that is behind takes the newest sample once it can be sent.
        let waits = self.blocked || !self.batch.is_empty();
        if !waits || !self.queue.keeps_bursts() || self.queue.is_behind(now) {
            return;
        }
        let Self { taking, queue, topic, .. } = self;
        self.undemanded += taking.take_burst(sources, queue, topic, counters, now);
    }

    /// Whether samples that were sent may not have arrived. Where the peer acknowledges none, nothing says that they did.
    pub(super) fn is_on_the_way(&self) -> bool {
        !self.acknowledged || self.queue.has_sent() || !self.best_effort.is_idle()
    }

    /// Whether a sample found no room.
    pub(super) fn is_held(&self) -> bool {
        self.taking.is_held()
    }

    /// Bytes that wait for QUIC, and the class of the sample that is next among them.
    pub(super) fn waiting(&self) -> Option<(Class, usize)> {
        let next = self.queue.peek()?;
        let reliable = self.queue.delivery() == Delivery::Reliable;
        let class = Class::of(self.route.kind != Kind::Topic, reliable, next.payload.len());
        Some((class, self.queue.waiting_bytes()))
    }

    /// When the oldest sample that waits was taken from its ring.
    pub(super) fn oldest(&self) -> Option<Duration> {
        self.queue.oldest()
    }

    pub(super) fn fill(&mut self, sources: &[Source], counters: &Counters, now: Duration) -> u32 {
        self.taking.fill(sources, &mut self.queue, &self.topic, counters, now)
    }

    /// Counts the samples that newer ones replaced in the ring.
    pub(super) fn count_overwritten(&mut self, sources: &[Source], counters: &Counters) {
        self.taking.count_overwritten(sources, &self.topic, counters);
    }

    /// Has a turn: hands samples to QUIC until its turn is over or QUIC takes no more.
    pub(super) fn write(
        &mut self,
        sources: &[Source],
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut Done,
        now: Duration,
    ) -> Pause {
        let mut left = if carrier.lender.is_some() { TOGETHER } else { TURN };
        loop {
            if self.batch.is_empty() && !self.best_effort.is_writing() {
                let queued =
                    self.fill(sources, counters, now) + std::mem::take(&mut self.undemanded);
                carrier.seal.demand(queued, now);
            }
            let before = carrier.taken;
            let pause = match self.queue.delivery() {
                // What is left of a batch goes first, however the next sample is delivered.
                Delivery::BestEffort if self.batch.is_empty() => {
                    self.finish_stream(carrier);
                    self.write_best_effort(carrier, counters, done, now)
                }
                _ => self.write_reliable(carrier, counters, done, now),
            };
            left = left.saturating_sub((carrier.taken - before) as usize);
            if pause == Some(Pause::Empty)
                && let Some(wait) = self.taking.take_retry()
            {
                // In a pass of its own, so that other flows and links have their turn.
                self.set_timer(Some(now + wait));
                return Pause::Empty;
            }
            match pause {
                None if left == 0 => return Pause::Turn,
                None => {}
                // All that it looked at in this turn was sent before.
                Some(Pause::Empty) if self.taking.goes_on() && self.queue.peek().is_none() => {
                    return Pause::Turn;
                }
                Some(Pause::Empty) if !self.taking.has_more() => {
                    self.queue.handle_empty_ring(now);
                    return Pause::Empty;
                }
                Some(pause) => return pause,
            }
        }
    }

    /// Writes the pending batch, or seals the next one. `None`: go on.
    fn write_reliable(
        &mut self,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut Done,
        now: Duration,
    ) -> Option<Pause> {
        if self.batch.is_empty() {
            if !self.has_credit(carrier) {
                return Some(Pause::NoCredit);
            }
            let sealed = self.seal(carrier, now);
            self.credit.set(self.queue.credit());
            match sealed {
                Ok(0) => return Some(Pause::Empty),
                Ok(_) => {}
                Err(NoKey::Detached) => return Some(Pause::Blocked),
                Err(_) => return Some(Pause::NoKey),
            }
        }
        let stream = match self.stream {
            Some(stream) => stream,
            None => {
                let Some(id) = carrier.quic.streams().open(Dir::Uni) else {
                    return Some(Pause::NoStream);
                };
                let header = StreamHeader {
                    reliable: true,
                    short: self.headers.is_some(),
                    acknowledged: self.acknowledged && self.route.kind != Kind::Topic,
                    route: self.route_number,
                    of: self.of,
                };
                self.batch.put_before(&header.encode());
                carrier.streams.insert(id, carrier.flow);
                self.stream_priority = 0;
                *self.stream.insert(id)
            }
        };
        let bulk = Rank { priority: self.priority, class: Class::Bulk };
        let rank = carrier.rank(self.rank().unwrap_or(bulk));
        if rank.of_stream() > self.stream_priority {
            self.set_priority(rank, stream, carrier);
        }
        carrier.limit(rank);
        match carrier.quic.send_stream(stream).write_chunks(self.batch.chunks()) {
            Ok(taken) => {
                // What the stream was lent leaves before its priority sinks.
                if rank.of_stream() < self.stream_priority {
                    self.set_priority(rank, stream, carrier);
                }
                self.batch.drop_chunks(taken.chunks);
                self.handle_taken(taken.bytes as u64, carrier, counters, done, now);
                None
            }
            Err(WriteError::Blocked) => Some(Pause::Blocked),
            Err(WriteError::Stopped(_)) => {
                self.stop(counters, done);
                None
            }
            Err(WriteError::ClosedStream) => {
                self.stream = None;
                self.rewind();
                None
            }
        }
    }

    /// Whether the peer takes in the next sample now. Some small ones are sent whatever the peer holds.
    fn has_credit(&self, carrier: &Carrier<'_>) -> bool {
        let Some(next) = self.queue.peek() else { return true };
        let credit = self.queue.credit_with(next);
        let length = next.payload.len();
        let is_small = length <= SMALL && credit.window <= ALWAYS;
        let class = Class::of(self.route.kind != Kind::Topic, true, length);
        let rank = Rank { priority: self.priority, class };
        is_small || (carrier.is_open_to(rank) && self.credit.may_use(credit))
    }

    fn set_priority(&mut self, rank: Rank, stream: StreamId, carrier: &mut Carrier<'_>) {
        self.stream_priority = rank.of_stream();
        let _ = carrier.quic.send_stream(stream).set_priority(self.stream_priority);
    }

    /// QUIC took so many bytes of the batch.
    fn handle_taken(
        &mut self,
        bytes: u64,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut Done,
        now: Duration,
    ) {
        carrier.taken += bytes;
        self.taken_bytes += bytes;
        self.active_at = now;
        let mut whole = 0;
        self.batch.handle_taken(bytes, |sealed| {
            counters.sent(sealed.payload);
            if !self.acknowledged {
                done.sequence = done.sequence.max(Some(sealed.sequence));
            }
            whole += 1;
        });
        if !self.acknowledged {
            self.queue.written(whole);
            self.credit.set(self.queue.credit());
        }
        if self.timer.is_none() {
            self.timer = Some(now + STREAM_IDLE);
        }
    }

    /// Seals a batch of waiting samples. Returns how many.
    fn seal(&mut self, carrier: &mut Carrier<'_>, now: Duration) -> Result<usize, NoKey> {
        let (mut bytes, mut samples, mut end) = (0, 0, 0);
        self.batch.clear();
        if self.stream.is_none() {
            self.headers = carrier.seal.short_headers().filter(|_| self.short_headers);
        }
        if self.queue.peek().is_some_and(|next| next.payload.len() <= COPIED) {
            // A sample takes more in the queue than its header does in the batch.
            self.frames.reserve(self.queue.waiting_bytes().min(TOGETHER + COPIED));
        }
        while bytes < TOGETHER {
            if samples > 0 && !self.has_credit(carrier) {
                break;
            }
            let Some(sample) = self.queue.send() else { break };
            let (sequence, payload) = (sample.info.sequence, sample.payload.len());
            let (delivery, headers) = (Delivery::Reliable, self.headers.as_mut());
            let frames = &mut self.frames;
            if let Err(why) = carrier.seal.write(sample, self.route, delivery, headers, frames, now)
            {
                self.queue.take_back();
                if samples == 0 {
                    return Err(why);
                }
                break;
            }
            end = self.frames.len() as u64;
            bytes += payload;
            samples += 1;
            self.batch.add(Sealed { sequence, payload, end });
        }
        debug_assert!(samples == 0 || end > 0, "a sealed message has bytes");
        self.batch.set_chunks(self.frames.take());
        Ok(samples)
    }

    /// The peer takes no more of this route: the samples that it was sent are given up.
    fn stop(&mut self, counters: &Counters, done: &mut Done) {
        self.stream = None;
        self.batch.clear();
        let (given_up, newest) = self.queue.give_up_sent();
        self.credit.set(self.queue.credit());
        counters.lost(&self.topic, "no_route", given_up);
        done.sequence = done.sequence.max(newest);
        done.given_up += given_up;
    }

    /// Sends all samples again that are not acknowledged, or not entirely with QUIC.
    fn rewind(&mut self) {
        self.batch.clear();
        self.queue.rewind();
        self.credit.set(self.queue.credit());
    }

    /// A new link carries the flow: what the old one did not deliver goes first.
    pub(super) fn succeed(
        &mut self,
        mut old: Option<&mut quinn_proto::Connection>,
        counters: &Counters,
    ) {
        if let (Some(stream), Some(old)) = (self.stream.take(), old.as_deref_mut()) {
            // A message that is cut off at the end of its stream is none.
            let _ = old.send_stream(stream).finish();
        }
        self.best_effort.leave(old, counters, &self.topic);
        self.stream = None;
        self.blocked = false;
        self.rewind();
    }

    /// The streams that carry it, which end with it, and whether a sample is cut off there.
    pub(super) fn take_streams(&mut self) -> impl Iterator<Item = (StreamId, bool)> + use<> {
        let cut = self.best_effort.take_cut().map(|stream| (stream, true));
        let is_cut = self.is_given_up;
        self.stream.take().map(|stream| (stream, is_cut)).into_iter().chain(cut)
    }

    /// Its samples that are not acknowledged are given up: its stream is cut off, so that what the peer has not read of it
    /// uses up no window any more.
    pub(super) fn give_up(&mut self) {
        self.is_given_up = self.queue.has_sent();
    }

    /// Whether samples of it are in flight for which others may have to wait.
    pub(super) fn uses_credit(&self) -> bool {
        self.credit.is_used()
    }

    /// Samples that the peer acknowledged, and how often QUIC took a quarter of a MiB.
    pub(super) fn progress(&self) -> (u64, u64) {
        (self.acknowledged_samples, self.taken_bytes / PART)
    }

    /// Whether it waits for other flows: none of its samples is in flight, and the peer takes in theirs first. Then it is
    /// no fault of its own that it makes no progress.
    pub(super) fn waits_for_others(&self) -> bool {
        self.waits_for_credit && !self.queue.has_sent() && self.best_effort.is_idle()
    }

    /// The peer has the samples up to this number, and dropped some of them.
    pub(super) fn acknowledge(&mut self, sequence: u64, dropped: u64) -> Option<Done> {
        let (samples, newest) = self.queue.acknowledge(sequence);
        self.credit.set(self.queue.credit());
        self.acknowledged_samples += samples;
        newest.map(|sequence| Done { sequence: Some(sequence), given_up: samples.min(dropped) })
    }

    /// The reliable stream carries nothing more.
    pub(super) fn finish_stream(&mut self, carrier: &mut Carrier<'_>) {
        if let Some(stream) = self.stream.take() {
            let _ = carrier.quic.send_stream(stream).finish();
        }
    }

    fn write_best_effort(
        &mut self,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut Done,
        now: Duration,
    ) -> Option<Pause> {
        let of = (self.route_number, self.of, self.route, self.priority);
        let before = carrier.taken;
        let pause = self.best_effort.write(
            (of, self.short_headers, &self.topic),
            self.credit.sibling(),
            &mut self.queue,
            &mut self.frames,
            carrier,
            counters,
            done,
            now,
        );
        if carrier.taken > before {
            self.active_at = now;
        }
        self.set_timer(self.best_effort.poll_timeout());
        pause
    }

    /// The peer's QUIC has all of this best-effort stream.
    pub(super) fn handle_finished(
        &mut self,
        stream: StreamId,
        carrier_quic: &mut quinn_proto::Connection,
        counters: &Counters,
        now: Duration,
    ) {
        self.best_effort.handle_finished(stream, carrier_quic, counters, now);
    }

    /// The peer stopped this stream.
    pub(super) fn handle_stopped(
        &mut self,
        stream: StreamId,
        quic: &mut quinn_proto::Connection,
        counters: &Counters,
        done: &mut Done,
    ) {
        if self.stream == Some(stream) {
            let _ = quic.send_stream(stream).reset(VarInt::from_u32(CloseCode::Goodbye.code()));
            self.stop(counters, done);
        } else {
            self.best_effort.handle_stopped(stream, quic, counters, &self.topic);
        }
    }

    fn set_timer(&mut self, due: Option<Duration>) {
        if let Some(due) = due {
            self.timer = Some(self.timer.map_or(due, |timer| timer.min(due)));
        }
    }

    /// Sets the timer for what is left when there is no stream any more.
    pub(super) fn restart_timer(&mut self) {
        self.timer = self.best_effort.poll_timeout();
    }

    /// Resets best-effort samples whose time is over, and finishes a stream that has been idle.
    pub(super) fn handle_timeout(
        &mut self,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        now: Duration,
    ) {
        self.timer = None;
        if self.best_effort.handle_timeout(carrier, counters, &self.topic, now) {
            // QUIC says nothing of a stream that was reset.
            self.blocked = false;
        }
        self.set_timer(self.best_effort.poll_timeout());
        let idle_at = self.active_at + STREAM_IDLE;
        if self.stream.is_some() {
            if now >= idle_at && self.queue.is_empty() && self.batch.is_empty() {
                self.finish_stream(carrier);
            } else {
                self.set_timer(Some(idle_at.max(now + Duration::from_secs(1))));
            }
        }
    }

    /// The link is over and no other carries the flow. Returns the samples that were taken and did not leave.
    pub(super) fn end(&mut self, counters: &Counters) -> u64 {
        self.best_effort.link_over(counters, &self.topic);
        let held = self.taking.end();
        self.rewind();
        held as u64 + self.queue.waiting()
    }
}
