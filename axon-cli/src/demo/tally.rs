//! Counts the messages that a subscriber receives, and compares each with the log byte for byte.

use serde::{Deserialize, Serialize};

/// The result of one subscriber's run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunTally {
    /// Messages of the log that should arrive.
    pub(crate) expected: u64,
    /// Messages of the log that arrived, each counted once.
    pub(crate) messages: u64,
    /// Payload bytes of these messages.
    pub(crate) bytes: u64,
    /// Messages of the log that did not arrive.
    pub(crate) lost: u64,
    /// Messages that arrived after a later message of the same publisher.
    pub(crate) out_of_order: u64,
    /// Messages that arrived more than once.
    pub(crate) duplicates: u64,
    /// Messages whose bytes differ from the log, or that the log does not hold.
    pub(crate) different: u64,
    /// Median of the time from publish to receipt, in nanoseconds.
    pub(crate) latency_p50_ns: u64,
    /// The 99th percentile of the same time.
    pub(crate) latency_p99_ns: u64,
    /// The maximum of the same time.
    pub(crate) latency_max_ns: u64,
    /// Time from the first publish to the last receipt, in nanoseconds.
    pub(crate) elapsed_ns: u64,
}

impl RunTally {
    /// Returns whether the whole log arrived once, in order and unchanged.
    pub(crate) fn is_whole(&self) -> bool {
        let faults = [self.lost, self.out_of_order, self.duplicates, self.different];
        self.expected > 0 && self.messages == self.expected && faults == [0; 4]
    }

    /// Returns the payload bytes per second of the run.
    pub(crate) fn bytes_per_second(&self) -> f64 {
        if self.elapsed_ns == 0 { 0.0 } else { self.bytes as f64 * 1e9 / self.elapsed_ns as f64 }
    }
}

/// One message that a subscription received.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Arrival<'a> {
    /// The index of the topic in the log.
    pub(crate) topic: usize,
    /// The publication sequence number, from 1.
    pub(crate) sequence: u64,
    /// The time of publication, in nanoseconds since the Unix epoch.
    pub(crate) published: i64,
    /// The time at which it was taken, in nanoseconds since the Unix epoch.
    pub(crate) received: i64,
    /// The payload.
    pub(crate) payload: &'a [u8],
}

/// Compares messages with the log as they arrive.
#[derive(Debug)]
pub(crate) struct Tally {
    topics: Vec<TopicTally>,
    latencies: Vec<u64>,
    first_published: Option<i64>,
    last_received: Option<i64>,
    outcome: RunTally,
}

#[derive(Debug)]
struct TopicTally {
    payloads: Vec<Vec<u8>>,
    seen: Vec<bool>,
    highest: u64,
}

impl Tally {
    /// Creates a tally for the payloads of each topic.
    pub(crate) fn new(payloads: Vec<Vec<Vec<u8>>>) -> Self {
        let expected = payloads.iter().map(Vec::len).sum();
        let topic = |payloads: Vec<Vec<u8>>| TopicTally {
            seen: vec![false; payloads.len()],
            payloads,
            highest: 0,
        };
        Self {
            topics: payloads.into_iter().map(topic).collect(),
            latencies: Vec::with_capacity(expected),
            first_published: None,
            last_received: None,
            outcome: RunTally { expected: expected as u64, ..RunTally::default() },
        }
    }

    /// Counts one message.
    pub(crate) fn arrived(&mut self, arrival: Arrival<'_>) {
        let index = usize::try_from(arrival.sequence.wrapping_sub(1)).unwrap_or(usize::MAX);
        let Some(topic) = self.topics.get_mut(arrival.topic) else {
            self.outcome.different += 1;
            return;
        };
        let (Some(seen), Some(recorded)) = (topic.seen.get_mut(index), topic.payloads.get(index))
        else {
            self.outcome.different += 1;
            return;
        };
        if std::mem::replace(seen, true) {
            self.outcome.duplicates += 1;
            return;
        }
        if arrival.sequence < topic.highest {
            self.outcome.out_of_order += 1;
        }
        topic.highest = topic.highest.max(arrival.sequence);
        if recorded.as_slice() != arrival.payload {
            self.outcome.different += 1;
        }
        self.outcome.messages += 1;
        self.outcome.bytes += arrival.payload.len() as u64;
        let latency = arrival.received.saturating_sub(arrival.published);
        self.latencies.push(u64::try_from(latency).unwrap_or(0));
        let first = self.first_published.get_or_insert(arrival.published);
        *first = (*first).min(arrival.published);
        let last = self.last_received.get_or_insert(arrival.received);
        *last = (*last).max(arrival.received);
    }

    /// Returns how many messages of the log have arrived so far.
    pub(crate) fn messages(&self) -> u64 {
        self.outcome.messages
    }

    /// Returns whether every message of the log has arrived.
    pub(crate) fn is_complete(&self) -> bool {
        self.outcome.messages == self.outcome.expected
    }

    /// Returns the result. Messages that have not arrived count as lost.
    pub(crate) fn finish(mut self) -> RunTally {
        self.latencies.sort_unstable();
        self.outcome.lost = self.outcome.expected - self.outcome.messages;
        self.outcome.latency_p50_ns = percentile(&self.latencies, 50);
        self.outcome.latency_p99_ns = percentile(&self.latencies, 99);
        self.outcome.latency_max_ns = self.latencies.last().copied().unwrap_or(0);
        let span = self.first_published.zip(self.last_received);
        let elapsed = span.map_or(0, |(first, last)| last.saturating_sub(first));
        self.outcome.elapsed_ns = u64::try_from(elapsed).unwrap_or(0);
        self.outcome
    }
}

/// Returns the smallest of the sorted values that at least `percent` of them do not exceed (nearest
/// rank). Returns 0 if there are no values.
fn percentile(sorted: &[u64], percent: usize) -> u64 {
    let rank = (sorted.len() * percent).div_ceil(100);
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log() -> Vec<Vec<Vec<u8>>> {
        vec![vec![b"a1".to_vec(), b"a2".to_vec(), b"a3".to_vec()], vec![b"b1".to_vec()]]
    }

    fn run(arrivals: &[(usize, u64, &[u8])]) -> RunTally {
        let mut tally = Tally::new(log());
        for (time, &(topic, sequence, payload)) in (0..).zip(arrivals) {
            let (published, received) = (1_000 * time, 1_000 * time + 10 * (time + 1));
            tally.arrived(Arrival { topic, sequence, published, received, payload });
        }
        tally.finish()
    }

    #[test]
    fn each_fault_is_counted_under_its_name_and_spoils_the_run() {
        let lost = run(&[(0, 1, b"a1"), (0, 3, b"a3"), (1, 1, b"b1")]);
        assert_eq!((lost.lost, lost.messages), (1, 3));
        let swapped = run(&[(0, 2, b"a2"), (0, 1, b"a1"), (0, 3, b"a3"), (1, 1, b"b1")]);
        assert_eq!((swapped.out_of_order, swapped.lost), (1, 0));
        let twice =
            run(&[(0, 1, b"a1"), (0, 1, b"a1"), (0, 2, b"a2"), (0, 3, b"a3"), (1, 1, b"b1")]);
        assert_eq!((twice.duplicates, twice.out_of_order, twice.lost), (1, 0, 0));
        let changed = run(&[(0, 1, b"a1"), (0, 2, b"a!"), (0, 3, b"a3"), (1, 1, b"b1")]);
        assert_eq!((changed.different, changed.lost), (1, 0));
        for outcome in [lost, swapped, twice, changed, run(&[])] {
            assert!(!outcome.is_whole(), "{outcome:?}");
        }
    }

    #[test]
    fn messages_absent_from_the_log_count_as_different() {
        let outcome = run(&[(0, 0, b""), (0, 4, b"a4"), (0, u64::MAX, b""), (9, 1, b"")]);
        assert_eq!((outcome.different, outcome.messages, outcome.lost), (4, 0, 4));
    }

    #[test]
    fn an_empty_log_is_no_success() {
        assert!(!Tally::new(Vec::new()).finish().is_whole());
    }

    #[test]
    fn a_whole_run_is_whole_and_timed() {
        let outcome = run(&[(0, 1, b"a1"), (1, 1, b"b1"), (0, 2, b"a2"), (0, 3, b"a3")]);
        assert!(outcome.is_whole(), "{outcome:?}");
        assert_eq!((outcome.latency_p50_ns, outcome.latency_p99_ns), (20, 40));
        assert_eq!((outcome.latency_max_ns, outcome.elapsed_ns, outcome.bytes), (40, 3_040, 8));
        assert!((outcome.bytes_per_second() - 8e9 / 3_040.0).abs() < 1.0);
    }

    #[test]
    fn a_clock_that_steps_back_counts_as_no_time() {
        let mut tally = Tally::new(vec![vec![Vec::new()]]);
        let (published, received) = (i64::MAX, i64::MIN);
        tally.arrived(Arrival { topic: 0, sequence: 1, published, received, payload: b"" });
        let outcome = tally.finish();
        assert_eq!((outcome.latency_max_ns, outcome.elapsed_ns), (0, 0));
    }
}
