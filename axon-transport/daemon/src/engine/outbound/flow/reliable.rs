//! Sends the RELIABLE samples of one flow over one stream, in batches that are sealed together.

#[cfg(test)]
mod tests;

use std::time::Duration;

use axon_envelope::Delivery;
use quinn_proto::{Connection, Dir, StreamId, VarInt, WriteError};

use super::{
    FlowPause,
    batch::{Batch, Sealed},
    copying::CopyRule,
    credit::{ALWAYS, CreditShare},
    info::FlowInfo,
};
use crate::{
    engine::{
        counters::Counters,
        outbound::{progress::SentProgress, queue::Queue, source::FlowProgress},
        quic::connection::Carrier,
        rank::{Rank, SMALL},
        rings::RingSample,
        sample::{frames::Frames, short_header::ShortHeaders},
    },
    keys::NoKey,
    link::CloseCode,
};

/// Maximum bytes of samples that are sealed and written together.
pub(super) const TOGETHER: usize = 64 << 10;
/// Maximum length of a sample that is copied into one piece with its neighbours.
const COPIED: usize = 4096;
/// Bytes that count as progress of a long sample, if QUIC took them for the first time.
const PART: u64 = 256 << 10;
/// Time after which an idle stream is finished.
pub(super) const STREAM_IDLE: Duration = Duration::from_secs(30);

/// The stream of a flow's RELIABLE samples, and the batch that QUIC takes from. The samples themselves stay in the
/// flow's queue until they are acknowledged or, if the peer acknowledges none, with QUIC.
#[derive(Debug)]
pub(super) struct ReliableStream {
    stream: Option<StreamId>,
    /// The headers of the stream, or of the one that the pending batch will open, if they are short.
    headers: Option<ShortHeaders>,
    /// True if its streams have no short headers because there were compressed samples, which short headers cannot
    /// mark.
    compressed: bool,
    /// The stream's priority in QUIC.
    priority: i32,
    batch: Batch,
    /// The credit used by the samples that were sent over the stream.
    credit: CreditShare,
    /// The time at which the stream was opened, or last handed data to QUIC.
    active_at: Duration,
    /// Bytes that QUIC took for the first time; `sent_progress` has the position.
    new_bytes: u64,
    sent_progress: SentProgress,
    copying: CopyRule,
}

impl ReliableStream {
    /// Creates the state without an open stream.
    pub(super) fn new(credit: CreditShare) -> Self {
        Self {
            stream: None,
            headers: None,
            compressed: false,
            priority: 0,
            batch: Batch::default(),
            credit,
            active_at: Duration::ZERO,
            new_bytes: 0,
            sent_progress: SentProgress::default(),
            copying: CopyRule::default(),
        }
    }

    /// Returns whether the stream is open.
    pub(super) fn is_open(&self) -> bool {
        self.stream.is_some()
    }

    /// Returns whether this is its stream.
    pub(super) fn is(&self, stream: StreamId) -> bool {
        self.stream == Some(stream)
    }

    /// Returns whether QUIC has not taken all of a batch.
    pub(super) fn is_writing(&self) -> bool {
        !self.batch.is_empty()
    }

    /// Returns the bytes of the batch that QUIC has not taken.
    pub(super) fn left(&self) -> usize {
        self.batch.left()
    }

    /// Returns the credit that its samples use.
    pub(super) fn credit(&self) -> &CreditShare {
        &self.credit
    }

    /// Returns how often QUIC took a quarter of a MiB that it had never taken before.
    pub(super) fn parts(&self) -> u64 {
        self.new_bytes / PART
    }

    /// Returns how far QUIC took the samples.
    pub(super) fn sent_progress(&self) -> SentProgress {
        self.sent_progress
    }

    /// Continues from the position up to which QUIC took the samples over an earlier link.
    pub(super) fn go_on(&mut self, sent_progress: SentProgress) {
        self.sent_progress = self.sent_progress.max(sent_progress);
    }

    /// Writes the pending batch, or seals the next one. Returns `None` if the flow can continue.
    #[expect(clippy::too_many_arguments, reason = "the parts of a flow, borrowed one by one")]
    pub(super) fn write(
        &mut self,
        info: &FlowInfo,
        queue: &mut Queue,
        frames: &mut Frames,
        carrier: &mut Carrier<'_>,
        counters: &Counters,
        done: &mut FlowProgress,
        now: Duration,
    ) -> Option<FlowPause> {
        if self.batch.is_empty() {
            if !self.has_credit(info, queue, carrier) {
                return Some(FlowPause::NoCredit);
            }
            if !self.compressed && queue.peek().is_some_and(RingSample::is_compressed) {
                if self.stream.is_some() && self.headers.is_some() {
                    // The peer reads streams in the order in which it learns of them: it must have learned of this one.
                    if queue.has_sent() {
                        return Some(FlowPause::Compressing);
                    }
                    self.finish(carrier);
                }
                self.compressed = true;
            }
            let sealed = self.seal(info, queue, frames, carrier, now);
            self.note_sent(queue);
            match sealed {
                Ok(0) => return Some(FlowPause::Empty),
                Ok(_) => {}
                Err(NoKey::Detached) => return Some(FlowPause::Blocked),
                Err(_) => return Some(FlowPause::NoKey),
            }
        }
        let stream = match self.stream {
            Some(stream) => stream,
            None => {
                let Some(id) = carrier.quic.streams().open(Dir::Uni) else {
                    return Some(FlowPause::NoStream);
                };
                self.batch.put_before(&info.reliable_header(self.headers.is_some()).encode());
                carrier.streams.insert(id, carrier.flow);
                (self.priority, self.active_at) = (0, now);
                *self.stream.insert(id)
            }
        };
        let reliable = queue.delivery() == Delivery::Reliable;
        let rank = carrier.rank(info.rank(reliable, self.batch.left()));
        if rank.of_stream() > self.priority {
            self.set_priority(rank, stream, carrier);
        }
        carrier.limit(rank);
        match carrier.quic.send_stream(stream).write_chunks(self.batch.chunks()) {
            Ok(taken) => {
                // Data sent on a lent priority is passed to QUIC before the priority falls.
                if rank.of_stream() < self.priority {
                    self.set_priority(rank, stream, carrier);
                }
                self.batch.drop_chunks(taken.chunks);
                carrier.taken += taken.bytes as u64;
                self.handle_taken(now, taken.bytes as u64, info, queue, counters, done);
                None
            }
            Err(WriteError::Blocked) => Some(FlowPause::Blocked),
            Err(WriteError::Stopped(_)) => {
                self.stop(info, queue, counters, done);
                None
            }
            Err(WriteError::ClosedStream) => {
                self.stream = None;
                self.rewind(queue);
                None
            }
        }
    }

    /// Returns whether the peer takes in the next sample now. Some small samples are sent whatever the peer holds.
    fn has_credit(&self, info: &FlowInfo, queue: &Queue, carrier: &Carrier<'_>) -> bool {
        let Some(next) = queue.peek() else { return true };
        let credit = queue.credit_with(next);
        let is_small = next.length() <= SMALL && credit.window <= ALWAYS;
        is_small
            || (carrier.is_open_to(info.rank(true, next.payload.len()))
                && self.credit.may_use(credit))
    }

    fn set_priority(&mut self, rank: Rank, stream: StreamId, carrier: &mut Carrier<'_>) {
        self.priority = rank.of_stream();
        let _ = carrier.quic.send_stream(stream).set_priority(self.priority);
    }

    /// Handles that QUIC took `bytes` bytes of the batch.
    fn handle_taken(
        &mut self,
        now: Duration,
        bytes: u64,
        info: &FlowInfo,
        queue: &mut Queue,
        counters: &Counters,
        done: &mut FlowProgress,
    ) {
        self.active_at = now;
        // Only these numbers rise.
        let is_ordered = info.acknowledged || !info.is_service();
        if !is_ordered {
            self.new_bytes += bytes;
        }
        let mut whole = 0;
        self.batch.handle_taken(bytes, |sealed, taken, is_whole| {
            if is_ordered {
                self.new_bytes += self.sent_progress.advance(sealed.sequence, taken);
            }
            if !is_whole {
                return;
            }
            counters.sent(sealed.length);
            if !info.acknowledged {
                done.sequence = done.sequence.max(Some(sealed.sequence));
            }
            whole += 1;
        });
        if !info.acknowledged {
            queue.written(whole);
            self.note_sent(queue);
        }
    }

    /// Seals a batch of waiting samples. Returns their number.
    fn seal(
        &mut self,
        info: &FlowInfo,
        queue: &mut Queue,
        frames: &mut Frames,
        carrier: &mut Carrier<'_>,
        now: Duration,
    ) -> Result<usize, NoKey> {
        let (mut bytes, mut samples, mut end) = (0, 0, 0);
        self.batch.clear();
        if self.stream.is_none() {
            let short = info.short_headers && !self.compressed;
            self.headers = carrier.seal.short_headers().filter(|_| short);
        }
        if queue.peek().is_some_and(|next| next.payload.len() <= COPIED) {
            // A sample takes more in the queue than its header does in the batch.
            frames.reserve(queue.waiting_bytes().min(TOGETHER + COPIED));
        }
        let is_copied = carrier.copies.has_room() && self.copying.takes(queue.waiting(), now);
        while bytes < TOGETHER {
            if samples > 0 && !self.has_credit(info, queue, carrier) {
                break;
            }
            let is_next = |next: &RingSample| {
                !(next.is_asked() || next.is_compressed() && self.headers.is_some())
            };
            if !queue.peek().is_some_and(is_next) {
                break;
            }
            let after = queue.newest_sent();
            let Some(sample) = queue.send() else { break };
            let (sequence, length) = (sample.info.sequence, sample.length());
            let payload = sample.payload.len();
            let (delivery, headers) = (Delivery::Reliable, self.headers.as_mut());
            if let Err(why) = carrier.seal.write(sample, info.route, delivery, headers, frames, now)
            {
                queue.take_back();
                if samples == 0 {
                    return Err(why);
                }
                break;
            }
            // A sample that is sent again follows others that were sent again.
            let is_first_time = after < sequence;
            if is_copied && is_first_time && carrier.copies.has_room() && info.is_copied(sample) {
                carrier.copy(info.copy_header(), info.route, sample, after, now);
            }
            end = frames.len() as u64;
            bytes += payload;
            samples += 1;
            self.batch.add(Sealed { sequence, length, end });
        }
        debug_assert!(samples == 0 || end > 0, "a sealed message has bytes");
        self.batch.set_chunks(frames.take());
        Ok(samples)
    }

    /// Updates the credit that the unacknowledged samples use.
    pub(super) fn note_sent(&mut self, queue: &Queue) {
        self.credit.set(queue.credit());
    }

    /// Handles that the peer stopped the stream.
    pub(super) fn handle_stopped(
        &mut self,
        quic: &mut Connection,
        info: &FlowInfo,
        queue: &mut Queue,
        counters: &Counters,
        done: &mut FlowProgress,
    ) {
        if let Some(stream) = self.stream {
            let code = VarInt::from_u32(CloseCode::Goodbye.code());
            let _ = quic.send_stream(stream).reset(code);
        }
        self.stop(info, queue, counters, done);
    }

    /// Handles that the peer takes no more of this route: the samples that were sent to it are given up.
    fn stop(
        &mut self,
        info: &FlowInfo,
        queue: &mut Queue,
        counters: &Counters,
        done: &mut FlowProgress,
    ) {
        self.stream = None;
        self.batch.clear();
        let (given_up, newest) = queue.give_up_sent();
        self.note_sent(queue);
        counters.lost(&info.topic, "no_route", given_up);
        done.sequence = done.sequence.max(newest);
        done.given_up += given_up;
    }

    /// Sends all samples again that are not acknowledged, or not entirely with QUIC.
    pub(super) fn rewind(&mut self, queue: &mut Queue) {
        self.batch.clear();
        queue.rewind();
        self.note_sent(queue);
    }

    /// Moves to a new link: the samples that the old link did not deliver go first.
    pub(super) fn leave(&mut self, old: Option<&mut Connection>, queue: &mut Queue) {
        if let (Some(stream), Some(old)) = (self.stream.take(), old) {
            // A message that is cut off at the end of its stream does not count.
            let _ = old.send_stream(stream).finish();
        }
        self.rewind(queue);
    }

    /// Takes the stream, which ends with the flow.
    pub(super) fn take(&mut self) -> Option<StreamId> {
        self.stream.take()
    }

    /// Finishes the stream.
    pub(super) fn finish(&mut self, carrier: &mut Carrier<'_>) {
        if let Some(stream) = self.stream.take() {
            let _ = carrier.quic.send_stream(stream).finish();
        }
    }

    /// Finishes a stream that has been idle. Returns when to look again at a stream that is open.
    pub(super) fn handle_timeout(
        &mut self,
        now: Duration,
        queue: &Queue,
        carrier: &mut Carrier<'_>,
    ) -> Option<Duration> {
        self.stream?;
        let idle_at = self.active_at + STREAM_IDLE;
        if now >= idle_at && queue.is_empty() && self.batch.is_empty() {
            self.finish(carrier);
            self.compressed = false;
            return None;
        }
        Some(idle_at.max(now + Duration::from_secs(1)))
    }
}
