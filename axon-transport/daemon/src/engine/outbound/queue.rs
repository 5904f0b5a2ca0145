//! The queue of one flow: samples that wait to be sent, and samples that were sent and are not acknowledged.
//!
//! KEEP_LAST never blocks its publisher. A [burst](Burst) is lossless: the flow holds as many samples as its bytes
//! allow. A flow whose samples waited for too long is behind: it holds its depth, and drops the oldest. Samples that do
//! not fit within the depth stay in the ring. KEEP_ALL drops nothing: samples that do not fit stay in the ring, and in
//! time hold the publisher back.

#[cfg(test)]
mod tests;

use std::{collections::VecDeque, rc::Rc, time::Duration};

use axon_envelope::Delivery;
use axon_shm::qos::{History, Qos, Reliability};
use bytes::Bytes;

use super::{budget::Budget, burst::Burst, flow::UsedCredit};
use crate::engine::rings::RingSample;

/// The result of offering a sample.
#[derive(Debug)]
pub(super) enum Offered {
    /// The sample waits, and older samples were dropped for it.
    Queued {
        /// Number of samples dropped.
        dropped: u64,
    },
    /// There is no space, and nothing may be dropped.
    Full(RingSample),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Policy {
    /// RELIABLE and KEEP_ALL.
    KeepAll,
    /// RELIABLE and KEEP_LAST, with its depth.
    KeepLast(usize),
    /// BEST_EFFORT, with its depth. Its bytes do not count against the budget.
    BestEffort(usize),
}

impl Policy {
    fn of(qos: &Qos) -> Self {
        let depth = (qos.depth as usize).max(1);
        match (qos.reliability, qos.history) {
            (Reliability::Reliable, History::KeepAll) => Self::KeepAll,
            (Reliability::Reliable, History::KeepLast) => Self::KeepLast(depth),
            (Reliability::BestEffort, _) => Self::BestEffort(depth),
        }
    }

    fn is_reliable(self) -> bool {
        !matches!(self, Self::BestEffort(_))
    }
}

/// The queue of one flow.
#[derive(Debug)]
pub(super) struct Queue {
    policy: Policy,
    budget: Rc<Budget>,
    waiting: VecDeque<RingSample>,
    /// RELIABLE samples that were sent and are not acknowledged, oldest first.
    sent: VecDeque<RingSample>,
    /// Bytes of all samples, waiting and sent.
    bytes: usize,
    sent_bytes: usize,
    /// An upper bound of the length of the longest sent sample.
    longest_sent: usize,
    /// The highest number that was ever sent.
    newest_sent: u64,
    burst: Burst,
}

impl Queue {
    /// Creates an empty queue. A RELIABLE sample keeps its place until it is acknowledged, or [written](Self::written).
    pub(super) fn new(qos: &Qos, budget: Rc<Budget>) -> Self {
        Self {
            policy: Policy::of(qos),
            budget,
            waiting: VecDeque::new(),
            sent: VecDeque::new(),
            bytes: 0,
            sent_bytes: 0,
            longest_sent: 0,
            newest_sent: 0,
            burst: Burst::default(),
        }
    }

    /// Takes over the QoS of another relay, because the peer's subscriptions changed.
    pub(super) fn set_qos(&mut self, qos: &Qos) {
        let before = self.policy.is_reliable();
        self.policy = Policy::of(qos);
        match (before, self.policy.is_reliable()) {
            (false, true) => self.budget.overtake(self.bytes),
            (true, false) => self.budget.release(self.bytes),
            _ => {}
        }
    }

    /// Returns the delivery of the samples.
    pub(super) fn delivery(&self) -> Delivery {
        if self.policy.is_reliable() { Delivery::Reliable } else { Delivery::BestEffort }
    }

    /// Returns whether samples waited for so long that this is no burst.
    pub(super) fn is_behind(&self, now: Duration) -> bool {
        self.burst.is_over(now)
    }

    /// Records that the ring holds no sample. If none waits here either, the flow has caught up.
    pub(super) fn handle_empty_ring(&mut self, now: Duration) {
        if self.waiting.is_empty() {
            self.burst.handle_caught_up(now);
        }
    }

    /// Returns whether the engine should move samples from the ring into the queue now. A KEEP_LAST flow with
    /// waiting samples leaves new ones in the ring, where newer samples replace them without a copy, if it is behind or
    /// has no bytes left for a sample like its last. Exception: a flow that is behind and still holds more of a burst
    /// than its depth takes new samples, and drops the surplus for them.
    pub(super) fn wants_more(&self, now: Duration) -> bool {
        match (self.policy, self.waiting.back()) {
            (Policy::KeepAll | Policy::BestEffort(_), _) | (_, None) => true,
            (Policy::KeepLast(depth), Some(_)) if self.is_behind(now) => self.waiting.len() > depth,
            (Policy::KeepLast(_), Some(last)) => last.size() <= self.room(),
        }
    }

    /// Returns the number of bytes, in memory, of the samples that would still fit.
    pub(super) fn room(&self) -> usize {
        let left = self.budget.of_flow().saturating_sub(self.bytes);
        if self.policy.is_reliable() { left.min(self.budget.free()) } else { left }
    }

    /// Returns the highest number that was ever sent; 0 if there is none.
    pub(super) fn newest_sent(&self) -> u64 {
        self.newest_sent
    }

    /// Returns whether RELIABLE samples were sent and are not acknowledged.
    pub(super) fn has_sent(&self) -> bool {
        !self.sent.is_empty()
    }

    /// Returns whether it is RELIABLE and KEEP_ALL.
    pub(super) fn keeps_all(&self) -> bool {
        self.policy == Policy::KeepAll
    }

    /// Returns the history's depth; `None` for RELIABLE and KEEP_ALL.
    pub(super) fn depth(&self) -> Option<usize> {
        match self.policy {
            Policy::KeepAll => None,
            Policy::KeepLast(depth) | Policy::BestEffort(depth) => Some(depth),
        }
    }

    /// Returns whether it takes bursts of which the ring alone would keep only the newest samples.
    pub(super) fn keeps_bursts(&self) -> bool {
        matches!(self.policy, Policy::KeepLast(_))
    }

    /// Adds a sample.
    pub(super) fn offer(&mut self, sample: RingSample, now: Duration) -> Offered {
        self.burst.handle_waiting(now);
        let most = match self.policy {
            Policy::KeepAll => usize::MAX,
            Policy::KeepLast(depth) if self.is_behind(now) => depth,
            Policy::KeepLast(_) => usize::MAX,
            Policy::BestEffort(depth) => depth,
        };
        // Samples that are never dropped for want of bytes: an acknowledgement means that the newest of the depth
        // arrived.
        let kept = match self.policy {
            Policy::KeepAll => usize::MAX,
            Policy::KeepLast(depth) => depth,
            Policy::BestEffort(_) => 0,
        };
        let mut dropped = 0;
        while self.waiting.len() >= most || !self.takes(sample.size()) {
            if self.waiting.len() < kept {
                return Offered::Full(sample);
            }
            dropped += u64::from(self.pop().is_some());
        }
        self.bytes += sample.size();
        self.waiting.push_back(sample);
        Offered::Queued { dropped }
    }

    /// Takes `size` bytes of the budget. Returns whether it did. The only sample of a queue always fits.
    fn takes(&self, size: usize) -> bool {
        let fits = self.bytes + size <= self.budget.of_flow();
        if !self.policy.is_reliable() {
            return fits || self.waiting.is_empty();
        }
        // The next sample is in flight while the peer acknowledges the previous one, whatever their lengths.
        let is_next = self.waiting.is_empty() && self.sent.len() == 1;
        if (fits || is_next) && self.budget.try_take(size) {
            return true;
        }
        // KEEP_LAST: a sample that is being sent does not keep a newer one out.
        let alone =
            self.waiting.is_empty() && (self.sent.is_empty() || self.policy != Policy::KeepAll);
        if alone {
            self.budget.overtake(size);
        }
        alone
    }

    fn release(&self, size: usize) {
        if self.policy.is_reliable() {
            self.budget.release(size);
        }
    }

    /// Removes the oldest waiting sample.
    fn pop(&mut self) -> Option<RingSample> {
        let sample = self.waiting.pop_front()?;
        self.bytes -= sample.size();
        self.release(sample.size());
        Some(sample)
    }

    /// Returns the next sample to send.
    pub(super) fn peek(&self) -> Option<&RingSample> {
        self.waiting.front()
    }

    /// Returns the first waiting samples, up to `bytes` bytes, so that the caller can ask whether they become shorter;
    /// only the first sample if only the newest samples are kept.
    pub(super) fn next_ones(
        &mut self,
        bytes: usize,
        now: Duration,
    ) -> impl Iterator<Item = &mut RingSample> {
        let one = match self.policy {
            Policy::KeepAll => false,
            Policy::KeepLast(_) => self.is_behind(now),
            Policy::BestEffort(_) => true,
        };
        let most = if one { 1 } else { usize::MAX };
        let mut left = bytes;
        self.waiting.iter_mut().take(most).take_while(move |sample| {
            let fits = left > 0;
            left = left.saturating_sub(sample.payload.len());
            fits
        })
    }

    /// Returns whether the next sample is compressed, or is about to be, and a newer one would replace it. Within its
    /// `life` it is sent before that; otherwise none of the samples of a fast publisher would be sent. A KEEP_LAST flow
    /// leaves newer samples in the ring.
    pub(super) fn holds_next(&self, life: Duration, now: Duration) -> bool {
        let is_held = |next: &RingSample| {
            (next.is_asked() || next.is_compressed()) && now.saturating_sub(next.taken) < life
        };
        matches!(self.policy, Policy::BestEffort(_)) && self.peek().is_some_and(is_held)
    }

    /// Handles the answer to a compression order: its sample is sent as this frame, or uncompressed. Returns the
    /// sample's length, if it waits here.
    pub(super) fn set_compressed(&mut self, order: u64, frame: Option<Bytes>) -> Option<usize> {
        let sample = self.waiting.iter_mut().find(|sample| sample.is_asked_by(order))?;
        sample.set_compressed(frame);
        Some(sample.length())
    }

    /// Takes the next RELIABLE sample to send. It stays in the queue until it is acknowledged or written. Returns
    /// `None` while several such samples fill the flow's share.
    pub(super) fn send(&mut self) -> Option<&RingSample> {
        let size = self.waiting.front()?.size();
        if self.sent.len() > 1 && self.sent_bytes + size > self.budget.of_flow() {
            return None;
        }
        let sample = self.waiting.pop_front()?;
        self.newest_sent = self.newest_sent.max(sample.info.sequence);
        self.longest_sent = self.longest_sent().max(size);
        self.sent_bytes += size;
        self.sent.push_back(sample);
        self.sent.back()
    }

    /// Returns the credit used by the samples that were sent and are not acknowledged.
    pub(super) fn credit(&self) -> UsedCredit {
        UsedCredit::of(self.sent_bytes, self.longest_sent())
    }

    /// Returns the credit that they will use if this sample is sent, too.
    pub(super) fn credit_with(&self, next: &RingSample) -> UsedCredit {
        UsedCredit::of(self.sent_bytes + next.size(), self.longest_sent().max(next.size()))
    }

    fn longest_sent(&self) -> usize {
        if self.sent.is_empty() { 0 } else { self.longest_sent }
    }

    /// Takes back the sample that was sent last, because it could not be sealed.
    pub(super) fn take_back(&mut self) {
        if let Some(sample) = self.sent.pop_back() {
            self.sent_bytes -= sample.size();
            self.waiting.push_front(sample);
        }
    }

    /// Takes the next best-effort sample to send.
    pub(super) fn pop_best_effort(&mut self) -> Option<RingSample> {
        self.pop()
    }

    /// Removes the oldest sent samples, this many, which are with QUIC and which the peer does not acknowledge.
    pub(super) fn written(&mut self, samples: usize) {
        for _ in 0..samples {
            self.pop_sent();
        }
    }

    /// Drops waiting samples that would arrive too late, the oldest first: at the end of their lifespan or, if that is
    /// infinite, older than `life` once they have crossed the link, which takes `transit`. The newest sample is dropped
    /// for its lifespan alone.
    pub(super) fn drop_late(&mut self, life: Duration, transit: Duration, now: Duration) -> u64 {
        let mut dropped = 0;
        while let Some(oldest) = self.waiting.front() {
            let newest = self.waiting.len() == 1;
            let transit = if newest { Duration::ZERO } else { transit };
            let is_late = match oldest.lifespan_left(now) {
                Some(left) => left <= transit,
                None => !newest && now.saturating_sub(oldest.taken) + transit > life,
            };
            if !is_late {
                break;
            }
            dropped += u64::from(self.pop().is_some());
        }
        dropped
    }

    /// Handles an acknowledgement: the peer has the samples up to this number. Returns how many samples that were, and
    /// the newest of them. A number that was never sent acknowledges nothing.
    pub(super) fn acknowledge(&mut self, sequence: u64) -> (u64, Option<u64>) {
        let most = sequence.min(self.newest_sent);
        let is_taken = |sample: &&RingSample| sample.info.sequence <= most;
        let (mut samples, mut newest) = (0, None);
        loop {
            let taken = if self.sent.is_empty() {
                // The sample was sent over a link that ended, and waits to be sent again.
                self.waiting.front().filter(is_taken).is_some().then(|| self.pop()).flatten()
            } else {
                self.sent.front().filter(is_taken).is_some().then(|| self.pop_sent()).flatten()
            };
            let Some(sample) = taken else { return (samples, newest) };
            (samples, newest) = (samples + 1, Some(sample.info.sequence));
        }
    }

    fn pop_sent(&mut self) -> Option<RingSample> {
        let sample = self.sent.pop_front()?;
        self.sent_bytes -= sample.size();
        self.bytes -= sample.size();
        self.release(sample.size());
        Some(sample)
    }

    /// Removes all samples that were sent and are not acknowledged. Returns their number, and the highest sequence
    /// number.
    pub(super) fn give_up_sent(&mut self) -> (u64, Option<u64>) {
        let (mut samples, mut newest) = (0, None);
        while let Some(sample) = self.pop_sent() {
            (samples, newest) = (samples + 1, newest.max(Some(sample.info.sequence)));
        }
        (samples, newest)
    }

    /// Queues unacknowledged samples again, before all others, because the link ended.
    pub(super) fn rewind(&mut self) {
        while let Some(sample) = self.sent.pop_back() {
            self.waiting.push_front(sample);
        }
        self.sent_bytes = 0;
    }

    /// Returns the number of samples that wait to be sent.
    pub(super) fn waiting(&self) -> u64 {
        self.waiting.len() as u64
    }

    /// Returns the number of bytes that wait to be sent.
    pub(super) fn waiting_bytes(&self) -> usize {
        self.bytes - self.sent_bytes
    }

    /// Returns when the oldest waiting sample was taken from its ring.
    pub(super) fn oldest(&self) -> Option<Duration> {
        self.waiting.front().map(|sample| sample.taken)
    }

    /// Returns whether it holds no sample at all.
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty() && self.sent.is_empty()
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        self.release(self.bytes);
    }
}
