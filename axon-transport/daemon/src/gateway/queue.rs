//! The queue of samples from one publisher to one peer: plain data in, data out.
//!
//! KEEP_LAST never blocks its publisher: it is lossless up to the bound, then drops the oldest and
//! counts it. Only KEEP_ALL makes the relay wait, which leaves its samples in the ring and so in
//! time holds its publisher back.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use axon_envelope::Delivery;
use axon_shm::{
    ids::Gid,
    qos::{History, Qos, Reliability},
};
use axon_transport::MessageInfo;
use bytes::Bytes;

use super::queue_budget::QueueBudget;

/// So many bytes a single sample always has.
const ONE: usize = 1;

/// One sample on its way to a peer.
#[derive(Clone, Debug)]
pub(crate) struct Sample {
    /// Publisher, sequence number and timestamps.
    pub(super) info: MessageInfo,
    /// Whose call it is, where it is a request or a response.
    pub(super) client: Option<Gid>,
    /// The payload.
    pub(super) payload: Bytes,
    /// When it was copied out of the ring, on the monotonic clock.
    pub(super) since: std::time::Instant,
}

/// What became of a sample that was offered.
#[derive(Debug)]
pub(super) enum Offered {
    /// It waits; so many older ones were dropped for it.
    Queued {
        /// Samples dropped.
        dropped: u64,
    },
    /// There is no room and nothing may be dropped: offer it again later.
    Full(Sample),
    /// Nobody takes from this queue any more: offer it to another one.
    Over(Sample),
}

/// The queue of one (route, publisher).
#[derive(Debug)]
pub(super) struct Queue {
    samples: VecDeque<Sample>,
    bytes: usize,
    room: Arc<QueueBudget>,
    policy: Policy,
    /// RELIABLE samples that were taken and that the peer has not acknowledged, where it does so.
    sent: Option<Sent>,
    /// Nobody takes from it any more.
    over: bool,
}

/// What was taken and is not acknowledged, in the order of its numbers.
#[derive(Debug, Default)]
struct Sent {
    samples: VecDeque<Sample>,
    bytes: usize,
    /// The number of the newest sample that was ever taken.
    newest: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Policy {
    /// RELIABLE and KEEP_ALL: never drops.
    Wait,
    /// RELIABLE and KEEP_LAST: drops the oldest beyond the bytes.
    Bytes,
    /// BEST_EFFORT: drops the oldest beyond the history's depth too. It takes no other's room.
    Depth(usize),
}

impl Policy {
    fn of(qos: &Qos) -> Self {
        match (qos.reliability, qos.history) {
            (Reliability::Reliable, History::KeepAll) => Self::Wait,
            (Reliability::Reliable, History::KeepLast) => Self::Bytes,
            (Reliability::BestEffort, _) => Self::Depth(qos.depth as usize),
        }
    }
}

impl Sample {
    /// Its age: as far as is known, since it was published.
    pub(super) fn age(&self) -> Duration {
        let then = self.info.lifetime.map_or(Duration::ZERO, |lifetime| lifetime.age);
        then.saturating_add(self.since.elapsed())
    }

    /// How much of its lifespan is left, where that is finite.
    pub(super) fn left(&self) -> Option<Duration> {
        Some(self.info.lifetime?.lifespan.saturating_sub(self.age()))
    }

    /// What it takes of a queue's room: an empty one, too, is somewhere.
    fn size(&self) -> usize {
        self.payload.len() + size_of::<Self>()
    }
}

impl Queue {
    /// The queue for a relay with `qos`, in the room of a peer. One sample may always wait.
    /// Where the peer `acknowledges`, a RELIABLE sample keeps its room until then.
    pub(super) fn new(qos: &Qos, room: Arc<QueueBudget>, acknowledges: bool) -> Self {
        let (samples, sent) = (VecDeque::new(), acknowledges.then(Sent::default));
        Self { samples, bytes: 0, room, policy: Policy::of(qos), sent, over: false }
    }

    /// From now on it is for a relay with `qos`: one that asks for more, or less, has taken over. What
    /// waits already may be more than there is room for.
    pub(super) fn serve(&mut self, qos: &Qos) {
        let before = self.delivery();
        self.policy = Policy::of(qos);
        match (before, self.delivery()) {
            (Delivery::BestEffort, Delivery::Reliable) => self.room.overtake(self.bytes),
            (Delivery::Reliable, Delivery::BestEffort) => self.room.give_back(self.bytes),
            _ => {}
        }
    }

    /// How what is in it is to be delivered.
    pub(super) fn delivery(&self) -> Delivery {
        match self.policy {
            Policy::Wait | Policy::Bytes => Delivery::Reliable,
            Policy::Depth(_) => Delivery::BestEffort,
        }
    }

    /// Whoever takes from it wants to end: it may, unless there is something in it.
    pub(super) fn end(&mut self) -> bool {
        self.over = self.samples.is_empty() && !self.has_sent();
        self.over
    }

    /// Samples that nobody took.
    pub(super) fn waiting(&self) -> u64 {
        self.samples.len() as u64
    }

    /// Whether nobody takes from it any more.
    pub(super) fn is_over(&self) -> bool {
        self.over
    }

    /// Puts `sample` at the end, as the policy says.
    pub(super) fn offer(&mut self, sample: Sample) -> Offered {
        if self.over {
            return Offered::Over(sample);
        }
        let mut dropped = 0;
        while !self.takes(sample.size()) {
            if self.policy == Policy::Wait {
                return Offered::Full(sample);
            }
            dropped += u64::from(self.pop().is_some());
        }
        self.bytes += sample.size();
        self.samples.push_back(sample);
        Offered::Queued { dropped }
    }

    /// Whether there is room for a sample of this size, which is taken then.
    fn takes(&self, size: usize) -> bool {
        let fits = self.bytes + size <= self.room.of_queue();
        match self.policy {
            Policy::Depth(depth) => {
                self.samples.is_empty() || fits && self.samples.len() < depth.max(1)
            }
            Policy::Wait | Policy::Bytes if fits && self.room.take(size) => true,
            Policy::Wait | Policy::Bytes => {
                let first = self.samples.is_empty();
                if first {
                    self.room.overtake(size);
                }
                first
            }
        }
    }

    fn give_back(&self, size: usize) {
        if !matches!(self.policy, Policy::Depth(_)) {
            self.room.give_back(size);
        }
    }

    /// The oldest sample.
    pub(super) fn pop(&mut self) -> Option<Sample> {
        let sample = self.samples.pop_front()?;
        self.bytes -= sample.size();
        self.give_back(sample.size());
        Some(sample)
    }

    /// The oldest samples, until they have `bytes` together or none is left; of BEST_EFFORT one. What
    /// awaits its acknowledgement may take the room of one queue: then there are none.
    pub(super) fn pop_together(&mut self, bytes: usize, into: &mut VecDeque<Sample>) {
        let reliable = self.delivery() == Delivery::Reliable;
        let (bytes, most) = (if reliable { bytes } else { ONE }, self.room.of_queue());
        let mut together = 0;
        while together < bytes {
            if reliable && let Some(sent) = &mut self.sent {
                let Some(size) = self.samples.front().map(Sample::size) else { return };
                if !sent.samples.is_empty() && sent.bytes + size > most {
                    return;
                }
                let Some(sample) = self.samples.pop_front() else { return };
                // After a rewind it begins anew with the oldest.
                sent.newest = sent.newest.max(sample.info.sequence);
                into.push_back(sample.clone());
                sent.samples.push_back(sample);
                sent.bytes += size;
                together += size;
            } else {
                let Some(sample) = self.pop() else { return };
                together += sample.size();
                into.push_back(sample);
            }
        }
    }

    /// Drops those of BEST_EFFORT that cannot arrive in time while a newer one waits: within `life`, or
    /// within their lifespan, if the way takes as long as `transit`. Drops any whose lifespan is over.
    /// Returns how many.
    pub(super) fn drop_late(&mut self, life: Duration, transit: Duration) -> u64 {
        let mut dropped = 0;
        while let Some(oldest) = self.samples.front() {
            // The newest is always tried: what the last one took may not hold any more.
            let transit = if self.samples.len() > 1 { transit } else { Duration::ZERO };
            let late = self.samples.len() > 1 && oldest.since.elapsed() + transit > life;
            if !late && oldest.left().is_none_or(|left| left > transit) {
                break;
            }
            dropped += u64::from(self.pop().is_some());
        }
        dropped
    }

    /// The peer has samples up to this number. How many of them were awaited, and the newest of these.
    /// Samples that were taken once and wait to be sent again are among them.
    pub(super) fn acknowledge(&mut self, sequence: u64) -> (u64, Option<u64>) {
        let (mut samples, mut newest) = (0, None);
        while let Some(sample) = self.pop_taken(sequence) {
            (samples, newest) = (samples + 1, Some(sample.info.sequence));
        }
        (samples, newest)
    }

    /// The oldest sample that was taken and is not acknowledged, unless its number is above `most`.
    fn pop_taken(&mut self, most: u64) -> Option<Sample> {
        let sent = self.sent.as_mut()?;
        let most = most.min(sent.newest);
        let is_up_to = |sample: &&Sample| sample.info.sequence <= most;
        if sent.samples.is_empty() {
            // What was rewound comes first of all.
            self.samples.front().filter(is_up_to)?;
            return self.pop();
        }
        sent.samples.front().filter(is_up_to)?;
        let sample = sent.samples.pop_front()?;
        let size = sample.size();
        sent.bytes -= size;
        self.bytes -= size;
        self.give_back(size);
        Some(sample)
    }

    /// What is not acknowledged is to be sent again, first of all.
    pub(super) fn rewind(&mut self) {
        let Some(sent) = &mut self.sent else { return };
        while let Some(sample) = sent.samples.pop_back() {
            self.samples.push_front(sample);
        }
        sent.bytes = 0;
    }

    fn has_sent(&self) -> bool {
        self.sent.as_ref().is_some_and(|sent| !sent.samples.is_empty())
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        self.give_back(self.bytes);
    }
}

#[cfg(test)]
mod tests;
