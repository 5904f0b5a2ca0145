//! Judges the numbers of a remote publisher's samples against the number of samples that it can have published. A peer
//! may send any number, and a gap between two numbers counts as lost for good.

use std::{cell::Cell, time::Duration};

/// Maximum number of samples that a publisher may have published before the first one that arrives here.
const MAX_FIRST: u64 = 1 << 48;
/// Minimum time, in nanoseconds, that any publisher needs for a sample.
const NANOS: u64 = 125;
/// The same limit as a rate: samples a second.
const RATE: u64 = 1_000_000_000 / NANOS;
/// Maximum number of samples that a ring may hold between the last taken sample and the next one that is still valid.
const SLACK: u64 = 1 << 20;
/// Maximum time for which a sample is on its way before a later one comes with it: the lifetime of a silent link.
const ON_THE_WAY: Duration = Duration::from_secs(120);
/// After this time no gap is refused that a reader would count, because readers ignore larger gaps.
pub(in crate::engine) const FORGOTTEN: Duration = Duration::from_secs((1 << 32) / RATE + 1);

/// Returns how many samples a publisher can publish in this time.
fn samples_in(time: Duration) -> u64 {
    time.as_secs().saturating_mul(RATE).saturating_add(u64::from(time.subsec_nanos()) / NANOS)
}

/// The numbers of one publisher.
#[derive(Debug)]
pub(in crate::engine) struct PublisherNumbers {
    /// The highest number that was written; 0 is none.
    last: Cell<u64>,
    /// Maximum distance of the next number from `last`, as of the time `at`.
    ahead: Cell<u64>,
    at: Cell<Duration>,
}

impl PublisherNumbers {
    /// Creates the state of a publisher without a sample.
    pub(in crate::engine) fn new(now: Duration) -> Self {
        Self { last: Cell::new(0), ahead: Cell::new(SLACK), at: Cell::new(now) }
    }

    /// Returns the highest number that was written; 0 is none.
    pub(in crate::engine) fn last(&self) -> u64 {
        self.last.get()
    }

    /// Returns the highest number that the publisher can have reached.
    fn most(&self, now: Duration) -> u64 {
        match self.last.get() {
            0 => MAX_FIRST,
            last => last.saturating_add(self.ahead(now)),
        }
    }

    fn ahead(&self, now: Duration) -> u64 {
        self.ahead.get().saturating_add(samples_in(now.saturating_sub(self.at.get())))
    }

    /// Checks that a sample may have this number.
    ///
    /// # Errors
    /// The publisher cannot have reached it; the text says so.
    pub(in crate::engine) fn judge(&self, sequence: u64, now: Duration) -> Result<(), String> {
        let most = self.most(now);
        if sequence <= most {
            return Ok(());
        }
        Err(format!(
            "its number is {sequence}, and the one before it was {}: the publisher can have reached {most} at most",
            self.last.get()
        ))
    }

    /// Records that a sample of this number was written.
    pub(in crate::engine) fn pass(&self, sequence: u64, now: Duration) {
        let last = self.last.replace(sequence.max(self.last.get()));
        // This sample may have been on its way for this long, and a later one may come right after it.
        let most = SLACK + samples_in(ON_THE_WAY);
        let used = if last == 0 { 0 } else { sequence.saturating_sub(last) };
        self.ahead.set(self.ahead(now).saturating_sub(used).min(most));
        self.at.set(now);
    }

    /// Returns when the last number came, or else when the state was created.
    pub(in crate::engine) fn at(&self) -> Duration {
        self.at.get()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn the_lead_of_a_sequence_number_is_bounded_by_the_publish_rate() {
        let numbers = PublisherNumbers::new(at(0));
        numbers.judge(MAX_FIRST, at(0)).unwrap();
        numbers.judge(MAX_FIRST + 1, at(0)).unwrap_err();
        numbers.pass(7, at(0));
        numbers.judge(7 + SLACK, at(0)).unwrap();
        numbers.judge(8 + SLACK, at(0)).unwrap_err();
        numbers.judge(7 + SLACK + RATE, at(1)).unwrap();
        numbers.judge(8 + SLACK + RATE, at(1)).unwrap_err();
        // After days a gap may be as large as the number of samples that can have been lost.
        numbers.judge(7 + SLACK + 200_000 * RATE, at(200_000)).unwrap();
    }

    #[test]
    fn many_numbers_are_together_no_further_ahead_than_one() {
        let numbers = PublisherNumbers::new(at(0));
        numbers.pass(1, at(0));
        for step in 1..=4 {
            let sequence = 1 + step * SLACK / 4;
            numbers.judge(sequence, at(0)).unwrap();
            numbers.pass(sequence, at(0));
        }
        numbers.judge(2 + SLACK, at(0)).unwrap_err();
    }

    #[test]
    fn late_sample_does_not_take_the_number_of_the_next_one() {
        let numbers = PublisherNumbers::new(at(0));
        // A link was cut for 100 s: the sample from before comes with the newest one.
        numbers.pass(1, at(0));
        numbers.pass(2, at(100));
        numbers.judge(2 + 99 * RATE, at(100)).unwrap();
        // The lead is not the sum of all these times.
        numbers.pass(3, at(10_000));
        numbers.judge(3 + SLACK + 121 * RATE, at(10_000)).unwrap_err();
    }

    #[test]
    fn an_older_number_changes_nothing() {
        let numbers = PublisherNumbers::new(at(0));
        numbers.pass(10, at(0));
        numbers.judge(3, at(0)).unwrap();
        numbers.pass(3, at(0));
        assert_eq!(numbers.last(), 10);
        numbers.judge(11 + SLACK, at(0)).unwrap_err();
    }
}
