//! The queue of samples from one publisher to one peer: plain data in, data out.
//!
//! KEEP_LAST never blocks its publisher: it is lossless up to the bound, then drops the oldest and
//! counts it. Only KEEP_ALL makes the relay wait, which leaves its samples in the ring and so in
//! time holds its publisher back.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use axon_envelope::Delivery;
use bytes::Bytes;

use super::queue_budget::QueueBudget;
use crate::{
    ids::Gid,
    qos::{History, Qos, Reliability},
    session::MessageInfo,
};

/// So many bytes a single sample always has.
const ONE: usize = 1;

/// One sample on its way to a peer.
#[derive(Clone, Debug)]
pub(super) struct Sample {
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
mod tests {
    use super::*;
    use crate::session::Lifetime;

    fn sample(sequence: u64, size: usize) -> Sample {
        let info = MessageInfo {
            publisher: Gid::default(),
            sequence,
            source_timestamp: 0,
            received_timestamp: 0,
            reception: sequence,
            lifetime: None,
        };
        Sample {
            info,
            client: None,
            payload: vec![0; size].into(),
            since: std::time::Instant::now(),
        }
    }

    /// Room in which each queue has some for so many samples of so many bytes.
    fn room(samples: usize, size: usize) -> Arc<QueueBudget> {
        QueueBudget::new(32 * (samples * sample(0, size).size()) as u64)
    }

    /// A queue with room for so many samples of so many bytes.
    fn queue(qos: &Qos, samples: usize, size: usize) -> Queue {
        Queue::new(qos, room(samples, size).of_peer(), false)
    }

    fn offer(queue: &mut Queue, sequence: u64, size: usize) -> Result<u64, u64> {
        match queue.offer(sample(sequence, size)) {
            Offered::Queued { dropped } => Ok(dropped),
            Offered::Full(s) | Offered::Over(s) => Err(s.info.sequence),
        }
    }

    #[test]
    fn keep_all_hands_the_sample_back_and_loses_nothing() {
        let mut queue = queue(&Qos::keep_all(), 1, 60);
        assert_eq!(offer(&mut queue, 1, 60), Ok(0));
        assert_eq!(offer(&mut queue, 2, 60), Err(2));
        assert_eq!(queue.pop().unwrap().info.sequence, 1);
        assert_eq!(offer(&mut queue, 2, 60), Ok(0));
        assert_eq!(queue.pop().unwrap().info.sequence, 2);
        assert!(queue.pop().is_none());
    }

    #[test]
    fn one_sample_over_the_bound_still_passes() {
        let mut queue = queue(&Qos::keep_all(), 1, 60);
        assert_eq!(offer(&mut queue, 1, 1000), Ok(0));
    }

    #[test]
    fn keep_last_drops_the_oldest_and_says_how_many() {
        let mut queue = queue(&Qos::default(), 5, 20);
        for sequence in 1..=5 {
            assert_eq!(offer(&mut queue, sequence, 20), Ok(0));
        }
        let of_three = 2 * sample(0, 20).size() + 20;
        assert_eq!(offer(&mut queue, 6, of_three), Ok(3));
        assert_eq!(queue.pop().unwrap().info.sequence, 4);
    }

    #[test]
    fn samples_without_bytes_take_room_too() {
        let mut queue = queue(&Qos::default(), 3, 0);
        let dropped: Vec<_> = (1..=5).map(|sequence| offer(&mut queue, sequence, 0)).collect();
        assert_eq!(dropped, [Ok(0), Ok(0), Ok(0), Ok(1), Ok(1)]);
    }

    #[test]
    fn together_go_as_many_as_have_the_bytes_and_at_least_one() {
        let mut queue = queue(&Qos::keep_all(), 9, 1000);
        for sequence in 1..=4 {
            assert_eq!(offer(&mut queue, sequence, 1000), Ok(0));
        }
        let mut together = |bytes| {
            let mut into = VecDeque::new();
            queue.pop_together(bytes, &mut into);
            into.iter().map(|sample| sample.info.sequence).collect::<Vec<_>>()
        };
        assert_eq!(together(1), [1]);
        assert_eq!(together(1500), [2, 3]);
        assert_eq!(together(1 << 20), [4]);
        assert!(together(1).is_empty());
    }

    #[test]
    fn queues_towards_a_peer_share_its_room_and_give_it_back() {
        let peer = room(4, 20).of_peer();
        let [keeping, dropping] = [Qos::keep_all(), Qos::default()];
        // A quarter of 32 times as much as one has: that of eight.
        let mut full: Vec<_> = (0..8).map(|_| Queue::new(&keeping, peer.clone(), false)).collect();
        for queue in &mut full {
            (1..=4).for_each(|sequence| assert_eq!(offer(queue, sequence, 20), Ok(0)));
        }
        let mut waits = Queue::new(&keeping, peer.clone(), false);
        assert_eq!(offer(&mut waits, 1, 20), Ok(0), "one may always wait");
        assert_eq!(offer(&mut waits, 2, 20), Err(2));
        let mut drops = Queue::new(&dropping, peer.clone(), false);
        assert_eq!(offer(&mut drops, 1, 20), Ok(0));
        assert_eq!(offer(&mut drops, 2, 20), Ok(1));
        // Best effort takes none of it.
        let mut lossy = Queue::new(&Qos::sensor_data(), peer.clone(), false);
        (1..=4).for_each(|sequence| assert_eq!(offer(&mut lossy, sequence, 20), Ok(0)));
        full[0].pop().unwrap();
        drop(full.pop());
        for sequence in 2..=4 {
            assert_eq!(offer(&mut waits, sequence, 20), Ok(0));
        }
        assert_eq!(offer(&mut waits, 5, 20), Err(5), "it has as much as a queue may");
        assert_eq!(offer(&mut drops, 3, 20), Ok(1), "no room is left");
    }

    #[test]
    fn who_takes_over_is_served_as_it_asks_from_the_next_sample_on() {
        let mut queue = queue(&Qos { depth: 1, ..Qos::sensor_data() }, 2, 10);
        assert_eq!((offer(&mut queue, 1, 10), offer(&mut queue, 2, 10)), (Ok(0), Ok(1)));
        queue.serve(&Qos::keep_all());
        assert_eq!(queue.delivery(), Delivery::Reliable);
        assert_eq!((offer(&mut queue, 3, 10), offer(&mut queue, 4, 10)), (Ok(0), Err(4)));
        queue.serve(&Qos::default());
        assert_eq!(offer(&mut queue, 4, 10), Ok(1));
        queue.serve(&Qos { depth: 1, ..Qos::sensor_data() });
        assert_eq!((offer(&mut queue, 5, 10), queue.delivery()), (Ok(2), Delivery::BestEffort));
    }

    #[test]
    fn who_takes_over_takes_the_room_and_gives_it_back() {
        let daemon = room(2, 10);
        let peer = daemon.of_peer();
        let all = peer.of_queue() * 8;
        for (qos, next) in
            [(Qos::sensor_data(), Qos::keep_all()), (Qos::keep_all(), Qos::sensor_data())]
        {
            let mut queue = Queue::new(&qos, peer.clone(), false);
            (1..=2).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
            queue.serve(&next);
            assert_eq!(peer.take(all), next.reliability == Reliability::BestEffort);
            if next.reliability == Reliability::BestEffort {
                peer.give_back(all);
            }
            drop(queue);
            assert!(peer.take(all), "nothing is left of it");
            peer.give_back(all);
        }
    }

    #[test]
    fn it_does_not_end_with_something_in_it() {
        let mut queue = queue(&Qos::keep_all(), 2, 10);
        assert_eq!(offer(&mut queue, 1, 10), Ok(0));
        assert!(!queue.end() && !queue.is_over());
        queue.pop().unwrap();
        assert!(queue.end() && queue.is_over());
    }

    fn taken(queue: &mut Queue) -> Vec<u64> {
        let mut into = VecDeque::new();
        queue.pop_together(1 << 20, &mut into);
        into.iter().map(|sample| sample.info.sequence).collect()
    }

    #[test]
    fn a_sample_keeps_its_room_until_it_is_acknowledged() {
        let mut queue = Queue::new(&Qos::keep_all(), room(3, 10).of_peer(), true);
        (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
        assert_eq!(taken(&mut queue), [1, 2, 3]);
        // One may always wait, but is not taken.
        assert_eq!((offer(&mut queue, 4, 10), offer(&mut queue, 5, 10)), (Ok(0), Err(5)));
        assert!(taken(&mut queue).is_empty());
        assert_eq!(queue.acknowledge(2), (2, Some(2)));
        assert_eq!(queue.acknowledge(2), (0, None), "said again");
        assert_eq!(taken(&mut queue), [4]);
        assert!(!queue.end());
        // A peer may claim what it likes.
        assert_eq!(queue.acknowledge(u64::MAX), (2, Some(4)));
        assert!(queue.end());
        assert_eq!(queue.bytes, 0);
    }

    #[test]
    fn what_is_not_acknowledged_is_sent_again_in_order() {
        let peer = room(9, 10).of_peer();
        let mut queue = Queue::new(&Qos::default(), peer.clone(), true);
        (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
        assert_eq!(taken(&mut queue), [1, 2, 3]);
        assert_eq!((queue.acknowledge(1), offer(&mut queue, 4, 10)), ((1, Some(1)), Ok(0)));
        queue.rewind();
        assert_eq!(queue.acknowledge(2), (1, Some(2)), "the peer had it before the link broke");
        assert_eq!(taken(&mut queue), [3, 4]);
        queue.rewind();
        assert_eq!((queue.acknowledge(u64::MAX), offer(&mut queue, 5, 10)), ((2, Some(4)), Ok(0)));
        assert_eq!(queue.acknowledge(u64::MAX), (0, None), "the fifth was never sent");
        drop(queue);
        assert!(peer.take(8 * peer.of_queue()), "nothing is left of it");
    }

    #[test]
    fn what_was_taken_once_is_acknowledged_though_a_part_alone_is_taken_again() {
        let mut queue = Queue::new(&Qos::keep_all(), room(9, 10).of_peer(), true);
        (1..=4).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 10), Ok(0)));
        let mut into = VecDeque::new();
        (0..3).for_each(|_| queue.pop_together(1, &mut into));
        assert_eq!(into.len(), 3);
        queue.rewind();
        queue.pop_together(1, &mut into);
        assert_eq!(queue.acknowledge(3), (3, Some(3)), "the peer had them over the last link");
        assert_eq!(queue.acknowledge(4), (0, None), "the fourth was never sent");
    }

    #[test]
    fn best_effort_that_waited_too_long_gives_way_to_newer_samples() {
        let mut queue = queue(&Qos { depth: 5, ..Qos::sensor_data() }, 9, 1);
        (1..=3).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 1), Ok(0)));
        assert_eq!(queue.drop_late(Duration::from_secs(1000), Duration::ZERO), 0);
        std::thread::sleep(Duration::from_millis(2));
        // The newest stays, however old, and however long the way seems.
        assert_eq!(queue.drop_late(Duration::from_millis(1), Duration::from_secs(9)), 2);
        assert_eq!(taken(&mut queue), [3]);
    }

    #[test]
    fn best_effort_ages_by_its_publishers_lifespan_from_publication_on() {
        let [life, age] = [1000, 900].map(Duration::from_secs);
        let transit = Duration::from_secs(200);
        let mortal = |sequence, age| {
            let lifetime = Some(Lifetime { age, lifespan: Duration::from_secs(1000) });
            let sample = sample(sequence, 1);
            Sample { info: MessageInfo { lifetime, ..sample.info }, ..sample }
        };
        assert!(mortal(1, age).age() >= age, "it was as old when it was copied out");
        assert!(mortal(1, age).left().unwrap() <= Duration::from_secs(100));
        let mut queue = queue(&Qos { depth: 5, ..Qos::sensor_data() }, 9, 1);
        for (sequence, age) in [(1, age), (2, Duration::ZERO), (3, age)] {
            assert!(matches!(queue.offer(mortal(sequence, age)), Offered::Queued { dropped: 0 }));
        }
        assert_eq!(queue.drop_late(life, Duration::ZERO), 0);
        // The first would arrive too late. The last might, too, but nothing newer is there.
        assert_eq!(queue.drop_late(life, transit), 1);
        assert_eq!(queue.pop().unwrap().info.sequence, 2);
        assert_eq!(queue.drop_late(life, transit), 0);
        assert_eq!(taken(&mut queue), [3]);
        // One whose lifespan is over goes, with nothing newer.
        assert!(matches!(queue.offer(mortal(4, life)), Offered::Queued { dropped: 0 }));
        assert_eq!(queue.drop_late(life, Duration::ZERO), 1);
    }

    #[test]
    fn best_effort_goes_one_by_one() {
        let mut queue = queue(&Qos::sensor_data(), 9, 1);
        (1..=2).for_each(|sequence| assert_eq!(offer(&mut queue, sequence, 1), Ok(0)));
        let mut into = VecDeque::new();
        queue.pop_together(1 << 20, &mut into);
        assert_eq!(into.len(), 1);
    }

    #[test]
    fn best_effort_keeps_no_more_than_its_depth() {
        let mut queue = queue(&Qos { depth: 2, ..Qos::sensor_data() }, 10, 1);
        assert_eq!(offer(&mut queue, 1, 1), Ok(0));
        assert_eq!(offer(&mut queue, 2, 1), Ok(0));
        assert_eq!(offer(&mut queue, 3, 1), Ok(1));
        assert_eq!(queue.pop().unwrap().info.sequence, 2);
    }
}
