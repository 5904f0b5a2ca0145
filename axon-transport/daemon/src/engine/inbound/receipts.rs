//! Acknowledges the RELIABLE samples of topics that are in a stand-in's ring: up to which number of each publisher.
//! At the latest 10 ms, 64 samples or 256 KiB after the first, whichever comes first.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::Gid;

use crate::link::{ReceivedOf, ReceivedUpTo};

const DELAY: Duration = Duration::from_millis(10);
const SAMPLES: u64 = 64;
const BYTES: u64 = 256 << 10;
/// Maximum number of flows in one message.
const FLOWS: usize = 4096;

#[derive(Debug, Default)]
struct DueReceipt {
    /// The number of the first sample that was noted.
    first: Option<u64>,
    sequence: u64,
    dropped: u64,
}

impl DueReceipt {
    /// Records a sample of this number.
    fn note(&mut self, sequence: u64) {
        self.first.get_or_insert(sequence);
        self.sequence = self.sequence.max(sequence);
    }
}

/// The samples to be acknowledged.
#[derive(Debug, Default)]
pub(super) struct Receipts {
    due: HashMap<(u32, Gid), DueReceipt>,
    samples: u64,
    bytes: u64,
    /// The time at which the next message is sent.
    at: Option<Duration>,
}

impl Receipts {
    /// Records a sample that is in the ring, or was before.
    pub(super) fn came(&mut self, flow: (u32, Gid), sequence: u64, bytes: usize, now: Duration) {
        self.came_all(flow, sequence, 1, bytes, now);
    }

    /// Like [`came`](Self::came), for `samples` samples, the newest of which has this number.
    pub(super) fn came_all(
        &mut self,
        flow: (u32, Gid),
        sequence: u64,
        samples: u64,
        bytes: usize,
        now: Duration,
    ) {
        self.due.entry(flow).or_default().note(sequence);
        self.note(samples, bytes, now);
    }

    /// Records a sample that was dropped here.
    pub(super) fn dropped(&mut self, flow: (u32, Gid), sequence: u64, now: Duration) {
        let due = self.due.entry(flow).or_default();
        due.note(sequence);
        due.dropped += 1;
        self.note(1, 0, now);
    }

    /// Records that a sample which was dropped here comes again, over a new link. Its publisher may not know of the
    /// drop.
    pub(super) fn dropped_again(&mut self, flow: (u32, Gid), sequence: u64, now: Duration) {
        let due = self.due.entry(flow).or_default();
        let is_due = due.first.is_some_and(|first| (first..=due.sequence).contains(&sequence));
        due.note(sequence);
        due.dropped += u64::from(!is_due);
        self.note(1, 0, now);
    }

    fn note(&mut self, samples: u64, bytes: usize, now: Duration) {
        self.samples += samples;
        self.bytes += bytes as u64;
        let many = self.samples >= SAMPLES || self.bytes >= BYTES;
        let at = if many { now } else { now + DELAY };
        self.at = Some(self.at.map_or(at, |other| other.min(at)));
    }

    /// Returns when [`poll_message`](Self::poll_message) has a message.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.at
    }

    /// Returns the next message that is due.
    pub(super) fn poll_message(&mut self, now: Duration) -> Option<ReceivedUpTo> {
        if self.at.is_none_or(|at| at > now) {
            return None;
        }
        let of = |(route, publisher): (u32, Gid), due: DueReceipt| ReceivedOf {
            route,
            publisher,
            sequence: due.sequence,
            dropped: due.dropped,
        };
        let flows: Vec<_> = if self.due.len() <= FLOWS {
            self.due.drain().map(|(flow, due)| of(flow, due)).collect()
        } else {
            let some: Vec<_> = self.due.keys().take(FLOWS).copied().collect();
            some.into_iter().filter_map(|flow| Some(of(flow, self.due.remove(&flow)?))).collect()
        };
        if self.due.is_empty() {
            (self.at, self.samples, self.bytes) = (None, 0, 0);
        }
        Some(ReceivedUpTo { flows })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLOW: (u32, Gid) = (1, Gid([7; 16]));

    fn at(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    #[test]
    fn a_single_sample_is_acknowledged_after_ten_milliseconds() {
        let mut receipts = Receipts::default();
        receipts.came(FLOW, 3, 8, at(0));
        receipts.dropped(FLOW, 4, at(9));
        assert_eq!(receipts.poll_timeout(), Some(at(10)));
        assert_eq!(receipts.poll_message(at(9)), None);
        let of = ReceivedOf { route: 1, publisher: FLOW.1, sequence: 4, dropped: 1 };
        assert_eq!(receipts.poll_message(at(10)), Some(ReceivedUpTo { flows: vec![of] }));
        assert_eq!((receipts.poll_message(at(20)), receipts.poll_timeout()), (None, None));
    }

    #[test]
    fn a_dropped_sample_that_comes_again_is_told_once() {
        let mut receipts = Receipts::default();
        let told = |receipts: &mut Receipts, ms| {
            let message = receipts.poll_message(at(ms))?;
            Some((message.flows[0].sequence, message.flows[0].dropped))
        };
        [2, 3].into_iter().for_each(|number| receipts.dropped(FLOW, number, at(0)));
        // The message with the first two is lost.
        assert_eq!(told(&mut receipts, 10), Some((3, 2)));
        receipts.dropped(FLOW, 4, at(20));
        [2, 3, 4].into_iter().for_each(|number| receipts.dropped_again(FLOW, number, at(21)));
        receipts.dropped(FLOW, 5, at(22));
        assert_eq!(told(&mut receipts, 30), Some((5, 4)));
        receipts.dropped_again(FLOW, 5, at(40));
        assert_eq!(told(&mut receipts, 50), Some((5, 1)));
    }

    #[test]
    fn many_samples_or_bytes_are_acknowledged_at_once() {
        let mut receipts = Receipts::default();
        (1..=64).for_each(|sequence| receipts.came(FLOW, sequence, 8, at(0)));
        assert_eq!(receipts.poll_message(at(0)).unwrap().flows[0].sequence, 64);
        receipts.came(FLOW, 65, 256 << 10, at(1));
        assert_eq!(receipts.poll_timeout(), Some(at(1)));
    }

    #[test]
    fn more_flows_than_a_message_holds_are_split() {
        let mut receipts = Receipts::default();
        for route in 0..5000 {
            receipts.came((route, FLOW.1), 1, 8, at(0));
        }
        let first = receipts.poll_message(at(10)).unwrap().flows.len();
        let second = receipts.poll_message(at(10)).unwrap().flows.len();
        assert_eq!((first, second, receipts.poll_message(at(10))), (4096, 904, None));
    }
}
