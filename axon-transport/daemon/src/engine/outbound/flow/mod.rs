//! One flow: the samples of a publisher, or of a client's service calls, to one peer. The flow moves them
//! from their rings into its queue, and from there into QUIC streams when the scheduler gives it a turn.

mod batch;
mod best_effort;
mod compressing;
mod copying;
mod credit;
mod info;
mod reliable;
mod taking;
#[cfg(test)]
mod tests;

use std::{rc::Rc, time::Duration};

use axon_envelope::{Delivery, Kind};
use axon_shm::{ids::Gid, qos::Qos};
use bytes::Bytes;
use quinn_proto::{Connection, StreamId};

pub(super) use self::credit::{CreditQueue, PeerCredit, UsedCredit};
use self::{
    best_effort::{BestEffort, DEFAULT_LIFESPAN},
    compressing::Compressing,
    info::FlowInfo,
    reliable::{ReliableStream, STREAM_IDLE, TOGETHER},
    taking::FlowRings,
};
use super::{
    budget::Budget,
    progress::SentProgress,
    queue::Queue,
    served::FlowRoute,
    source::{FlowProgress, Source},
};
use crate::engine::rank::{Class, Rank};
use crate::engine::{
    compression::PeerCompression, counters::Counters, quic::connection::Carrier, rings::RingSample,
    sample::frames::Frames,
};

/// Bytes that one turn writes before other flows have their turns.
const TURN: usize = 256 << 10;
/// Why a flow has nothing to write now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FlowPause {
    /// The turn is over. More samples wait.
    Turn,
    /// The flow has nothing to send.
    Empty,
    /// QUIC takes no more of this stream or connection until it signals room.
    Blocked,
    /// The peer currently allows no more streams.
    NoStream,
    /// There is no key for the next message.
    NoKey,
    /// The peer takes in samples of other flows first.
    NoCredit,
    /// The next sample is being compressed, or it is compressed and earlier samples must be acknowledged
    /// first.
    Compressing,
}

/// One flow.
pub(super) struct Flow {
    pub(super) info: FlowInfo,
    taking: FlowRings,
    /// Samples for which no message keys were requested from the key sender yet.
    undemanded: u32,
    queue: Queue,
    frames: Frames,
    reliable: ReliableStream,
    best_effort: BestEffort,
    compressing: Compressing,
    /// True if QUIC takes no more until it signals room.
    pub(super) blocked: bool,
    /// True if the peer did not take in the next sample in the flow's last turn.
    pub(super) waits_for_credit: bool,
    /// True if the flow's samples were given up.
    is_given_up: bool,
    /// When [`handle_timeout`](Self::handle_timeout) is due; `None` if it is not.
    pub(super) timer: Option<Duration>,
    acknowledged_samples: u64,
}

impl Flow {
    /// Creates a flow without sources.
    pub(super) fn new(of: Gid, route: &FlowRoute, qos: &Qos, budget: &Rc<Budget>) -> Self {
        let info = FlowInfo::new(of, route);
        let kind = info.route.kind;
        // Each response gets a rising number, so that the peer can acknowledge it and drop a duplicate.
        let is_numbered = info.acknowledged && kind == Kind::Response;
        Self {
            taking: FlowRings::new(
                of,
                kind,
                is_numbered.then(|| route.responses.clone()),
                route.limit.clone(),
            ),
            info,
            undemanded: 0,
            queue: Queue::new(qos, Rc::clone(budget)),
            frames: Frames::default(),
            reliable: ReliableStream::new(route.credit.share()),
            best_effort: BestEffort::default(),
            compressing: Compressing::default(),
            blocked: false,
            waits_for_credit: false,
            is_given_up: false,
            timer: None,
            acknowledged_samples: 0,
        }
    }

    /// Replaces the sources. The peer has the samples up to number `seen`.
    pub(super) fn set_sources(&mut self, sources: &[Source], seen: Option<u64>) {
        self.taking.set_sources(sources, seen);
    }

    /// Returns whether no taken sample waits or is unacknowledged. The rings may still hold samples.
    fn has_none(&self) -> bool {
        self.taking.is_idle()
            && self.queue.is_empty()
            && !self.reliable.is_writing()
            && self.best_effort.is_idle()
    }

    /// Returns whether no taken sample waits or is unacknowledged, and no stream is open.
    pub(super) fn is_idle(&self) -> bool {
        self.has_none() && !self.reliable.is_open()
    }

    /// Returns whether no sample waits, including in the rings, or is unacknowledged.
    pub(super) fn is_quiet(&self) -> bool {
        self.has_none() && !self.taking.has_more()
    }

    /// Returns whether the flow's stream is idle and its rings need no check, so that its timer is free.
    pub(super) fn has_idle_stream(&self) -> bool {
        self.reliable.is_open()
            && self.queue.is_empty()
            && !self.reliable.is_writing()
            && !self.taking.has_more()
    }

    /// Returns the rank of the next sample; `None` if there is nothing to send.
    pub(super) fn rank(&self) -> Option<Rank> {
        let length = match self.queue.peek() {
            _ if self.reliable.is_writing() => self.reliable.left(),
            Some(next) => next.payload.len(),
            None if self.best_effort.is_writing() => usize::MAX,
            None if self.taking.has_more() => 0,
            None => return None,
        };
        Some(self.info.rank(self.is_reliable(), length))
    }

    fn is_reliable(&self) -> bool {
        self.queue.delivery() == Delivery::Reliable
    }

    /// Records that samples wait in a ring.
    pub(super) fn handle_samples(&mut self) {
        self.taking.handle_samples();
    }

    /// Handles a change of the limits: waiting samples may pass now.
    pub(super) fn handle_limits(&mut self) {
        self.taking.handle_limits();
    }

    /// Moves a burst of a KEEP_LAST publisher into the queue while QUIC takes nothing, because it would be
    /// overwritten in the ring. BEST_EFFORT samples stay in the ring, because only the newest will be sent. A
    /// KEEP_ALL publisher waits.
    pub(super) fn take_burst(&mut self, sources: &[Source], counters: &Counters, now: Duration) {
        // A flow that is behind takes the newest sample once it can be sent.
        let waits = self.blocked || self.reliable.is_writing();
        if !waits || !self.queue.keeps_bursts() || self.queue.is_behind(now) {
            return;
        }
        let Self { taking, queue, info, .. } = self;
        self.undemanded += taking.take_burst(sources, queue, &info.topic, counters, now);
    }

    /// Returns whether sent samples may not have arrived. That is always so if the peer acknowledges none.
    pub(super) fn is_on_the_way(&self) -> bool {
        !self.info.acknowledged || self.queue.has_sent() || !self.best_effort.is_idle()
    }

    /// Returns whether a sample found no room in the queue.
    pub(super) fn is_held(&self) -> bool {
        self.taking.is_held()
    }

    /// Returns the class of the next sample in the queue, and the bytes that wait there for QUIC.
    pub(super) fn waiting(&self) -> Option<(Class, usize)> {
        let next = self.queue.peek()?;
        let rank = self.info.rank(self.is_reliable(), next.payload.len());
        Some((rank.class, self.queue.waiting_bytes()))
    }

    /// Returns when the oldest waiting sample was taken from its ring.
    pub(super) fn oldest(&self) -> Option<Duration> {
        self.queue.oldest()
    }

    pub(super) fn fill(&mut self, sources: &[Source], counters: &Counters, now: Duration) -> u32 {
        self.taking.fill(sources, &mut self.queue, &self.info.topic, counters, now)
    }

    /// Counts the samples that newer ones replaced in the ring.
    pub(super) fn count_overwritten(&mut self, sources: &[Source], counters: &Counters) {
        self.taking.count_overwritten(sources, &self.info.topic, counters);
    }

    /// Uses a turn: passes samples to QUIC until the turn is over or QUIC takes no more.
    pub(super) fn write(
        &mut self,
        sources: &[Source],
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        compression: &PeerCompression,
        done: &mut FlowProgress,
        now: Duration,
    ) -> FlowPause {
        let mut left = if carrier.lender.is_some() { TOGETHER } else { TURN };
        loop {
            if !self.reliable.is_writing() && !self.best_effort.is_writing() {
                if !self.queue.holds_next(DEFAULT_LIFESPAN, now) {
                    self.undemanded += self.fill(sources, counters, now);
                }
                carrier.seal.demand(std::mem::take(&mut self.undemanded), now);
                self.finish_dropped(done);
            }
            let before = carrier.taken;
            let pause = match self.queue.delivery() {
                // The rest of a batch goes first, whatever the delivery of the next sample.
                Delivery::BestEffort if !self.reliable.is_writing() => {
                    self.reliable.finish(carrier);
                    self.write_best_effort(carrier, counters, compression, done, now)
                }
                _ => self.write_reliable(carrier, counters, compression, done, now),
            };
            left = left.saturating_sub((carrier.taken - before) as usize);
            if pause == Some(FlowPause::Empty)
                && let Some(wait) = self.taking.take_retry()
            {
                // The retry gets a pass of its own, so that other flows and links have their turn.
                self.set_timer(Some(now + wait));
                return FlowPause::Empty;
            }
            match pause {
                None if left == 0 => return FlowPause::Turn,
                None => {}
                // All samples that this turn examined were sent before.
                Some(FlowPause::Empty) if self.taking.goes_on() && self.queue.peek().is_none() => {
                    return FlowPause::Turn;
                }
                Some(FlowPause::Empty) if !self.taking.has_more() => {
                    self.queue.handle_empty_ring(now);
                    return FlowPause::Empty;
                }
                Some(pause) => return pause,
            }
        }
    }

    fn write_reliable(
        &mut self,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        compression: &PeerCompression,
        done: &mut FlowProgress,
        now: Duration,
    ) -> Option<FlowPause> {
        let Self { info, queue, frames, compressing, .. } = self;
        if !self.reliable.is_writing() {
            compressing.ask(info, queue, carrier, compression, counters, now);
            if queue.peek().is_some_and(RingSample::is_asked) {
                return Some(FlowPause::Compressing);
            }
        }
        let before = carrier.taken;
        let pause = self.reliable.write(info, queue, frames, carrier, counters, done, now);
        if carrier.taken > before {
            self.timer.get_or_insert(now + STREAM_IDLE);
        }
        pause
    }

    /// Moves the flow to a new link. Samples that the old link did not deliver go first.
    pub(super) fn succeed(&mut self, mut old: Option<&mut Connection>, counters: &Counters) {
        self.reliable.leave(old.as_deref_mut(), &mut self.queue);
        self.best_effort.leave(old, counters, &self.info.topic);
        // The flow has not asked the new link for credit.
        (self.blocked, self.waits_for_credit) = (false, false);
    }

    /// Takes the streams of a flow that ends, each with whether a sample is cut off on it.
    pub(super) fn take_streams(&mut self) -> impl Iterator<Item = (StreamId, bool)> + use<> {
        let cut = self.best_effort.take_cut().map(|stream| (stream, true));
        let is_cut = self.is_given_up;
        self.reliable.take().map(|stream| (stream, is_cut)).into_iter().chain(cut)
    }

    /// Gives up the unacknowledged samples: the stream is cut off, so that its unread data uses no window any
    /// more.
    pub(super) fn give_up(&mut self) {
        self.is_given_up = self.queue.has_sent();
    }

    /// Returns whether the flow has samples in flight that others may have to wait for.
    pub(super) fn uses_credit(&self) -> bool {
        self.reliable.credit().is_used()
    }

    /// Returns the number of acknowledged samples, and how often QUIC took another quarter of a MiB for the
    /// first time.
    pub(super) fn progress(&self) -> (u64, u64) {
        (self.acknowledged_samples, self.reliable.parts())
    }

    /// Returns how far QUIC took the flow's samples.
    pub(super) fn sent_progress(&self) -> SentProgress {
        self.reliable.sent_progress()
    }

    /// Continues with the samples of a flow that ended.
    pub(super) fn go_on(&mut self, sent_progress: SentProgress) {
        self.reliable.go_on(sent_progress);
    }

    /// Returns whether the flow waits for other flows: none of its samples is in flight, and the peer takes
    /// in theirs first. Then its lack of progress is not its own fault.
    pub(super) fn waits_for_others(&self) -> bool {
        self.waits_for_credit && !self.queue.has_sent() && self.best_effort.is_idle()
    }

    /// Returns whether BEST_EFFORT samples of the flow wait for a limit.
    pub(super) fn holds_best_effort(&self) -> bool {
        self.taking.is_limited() && !self.is_reliable()
    }

    /// Returns the BEST_EFFORT samples of an ended publisher that are still to be sent: how many were taken
    /// from its rings, and how many arrived so far. Returns `None` if none are left, in its rings either.
    pub(super) fn best_effort_left(&self) -> Option<(u64, u64)> {
        let is_left = !self.is_reliable() && !self.is_quiet();
        is_left.then(|| {
            (self.taking.waiting() as u64 + self.queue.waiting(), self.best_effort.arrived())
        })
    }

    /// Returns whether the flow waits for a limit and the peer has all samples that passed it.
    pub(super) fn waits_for_limit(&self) -> bool {
        self.taking.is_limited() && self.queue.is_empty()
    }

    /// Handles an acknowledgement: the peer has the samples up to this number, except the dropped ones.
    pub(super) fn acknowledge(&mut self, sequence: u64, dropped: u64) -> Option<FlowProgress> {
        let (samples, newest) = self.queue.acknowledge(sequence);
        self.reliable.note_sent(&self.queue);
        self.acknowledged_samples += samples;
        let given_up = samples.min(dropped);
        let mut done =
            newest.map(|sequence| FlowProgress { sequence: Some(sequence), given_up })?;
        self.finish_dropped(&mut done);
        Some(done)
    }

    /// Reports samples that a limit dropped to the sources. The sources learn at once that the samples will
    /// not arrive. They may forget the samples once the peer has all earlier ones.
    fn finish_dropped(&mut self, done: &mut FlowProgress) {
        done.given_up += self.taking.take_given_up();
        if self.queue.is_empty() {
            done.sequence = done.sequence.max(self.taking.take_dropped());
        }
    }

    /// Finishes the reliable stream.
    pub(super) fn finish_stream(&mut self, carrier: &mut Carrier<'_>) {
        self.reliable.finish(carrier);
    }

    fn write_best_effort(
        &mut self,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        compression: &PeerCompression,
        done: &mut FlowProgress,
        now: Duration,
    ) -> Option<FlowPause> {
        let Self { info, queue, frames, compressing, .. } = self;
        if let Some(pause) = self.best_effort.look_at_next(info, queue, carrier, counters, now) {
            return Some(pause);
        }
        if !self.best_effort.is_writing() {
            // Asked only once QUIC may take the sample: before, a newer sample could have replaced it.
            compressing.ask(info, queue, carrier, compression, counters, now);
            if queue.peek().is_some_and(RingSample::is_asked) {
                return Some(FlowPause::Compressing);
            }
        }
        let credit = self.reliable.credit().sibling();
        let pause =
            self.best_effort.write(info, credit, queue, frames, carrier, counters, done, now);
        self.set_timer(self.best_effort.poll_timeout());
        pause
    }

    /// Handles the answer to a compression order: the sample is sent as this frame, or uncompressed. The sample may be
    /// gone, and the order may be an earlier flow's.
    pub(super) fn handle_compressed(
        &mut self,
        order: u64,
        frame: Option<Bytes>,
        counters: &Counters,
    ) {
        if let Some(length) = self.queue.set_compressed(order, frame.clone()) {
            self.compressing.handle_answer(frame.as_ref(), length, counters);
        }
    }

    /// Handles that the peer's QUIC has all of this best-effort stream.
    pub(super) fn handle_finished(
        &mut self,
        now: Duration,
        stream: StreamId,
        quic: &mut Connection,
        counters: &Counters,
    ) {
        self.best_effort.handle_finished(now, stream, quic, counters);
    }

    /// Handles that the peer stopped this stream.
    pub(super) fn handle_stopped(
        &mut self,
        stream: StreamId,
        quic: &mut Connection,
        counters: &Counters,
        done: &mut FlowProgress,
    ) {
        if self.reliable.is(stream) {
            self.reliable.handle_stopped(quic, &self.info, &mut self.queue, counters, done);
        } else {
            self.best_effort.handle_stopped(stream, quic, counters, &self.info.topic);
        }
        self.finish_dropped(done);
    }

    fn set_timer(&mut self, due: Option<Duration>) {
        if let Some(due) = due {
            self.timer = Some(self.timer.map_or(due, |timer| timer.min(due)));
        }
    }

    /// Sets the timer for the remaining work of a flow without a stream.
    pub(super) fn restart_timer(&mut self) {
        self.timer = self.best_effort.poll_timeout();
    }

    /// Resets best-effort samples whose time is over, and finishes a stream that has been idle.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
    ) {
        self.timer = None;
        if self.best_effort.handle_timeout(now, carrier, counters, &self.info.topic) {
            // QUIC signals no room for a stream that was reset.
            self.blocked = false;
        }
        self.set_timer(self.best_effort.poll_timeout());
        let idle = self.reliable.handle_timeout(now, &self.queue, carrier);
        self.set_timer(idle);
    }

    /// Ends the flow with its link. Returns the samples that were taken and not sent.
    pub(super) fn end(&mut self, counters: &Counters) -> u64 {
        self.best_effort.link_over(counters, &self.info.topic);
        let held = self.taking.end();
        self.reliable.rewind(&mut self.queue);
        held as u64 + self.queue.waiting()
    }
}
