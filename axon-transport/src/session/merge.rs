//! Merges the samples that several readers took of one writer's ring into one sequence: each message once, in the
//! order of its number. The readers ask for different QoS, or attached at different times.
//!
//! The gateway and the relays need this order. They carry messages to another host, or to or from a process that
//! shares no memory.

use std::collections::{BTreeMap, BTreeSet};

use crate::ids::Gid;

/// Maximum number of messages of one reader that are passed over in one go.
const BATCH: usize = 64;

/// A message that was taken.
#[derive(Debug)]
pub struct MergedSample<T> {
    /// The number of the message.
    pub number: u64,
    /// The number of the writer's messages that the reader has lost by then. For a merged message: the number of
    /// messages that all readers have lost since the merged message before.
    pub lost: u64,
    /// The content of the message.
    pub content: T,
}

/// The messages of one writer, taken through all of its readers. A message that one reader has is not lost while it is
/// not merged yet, even if another reader is ahead or ends.
#[derive(Debug)]
pub struct Merge<T> {
    /// The number of the newest merged message.
    given: Option<u64>,
    ways: BTreeMap<Gid, MergeSource<T>>,
    /// Whether a reader had more messages to be dropped than one pass examines.
    behind: bool,
    /// Whether a reader that may lose no message has messages that it cannot give yet.
    held_up: bool,
}

#[derive(Debug)]
struct MergeSource<T> {
    /// The next message of the reader: taken, and newer than the last merged one.
    next: Option<MergedSample<T>>,
    /// The number of messages that the reader has lost, as far as is known.
    lost: u64,
    /// The number of lost messages that come after the last merged one.
    missed: u64,
}

impl<T> Default for Merge<T> {
    fn default() -> Self {
        Self { given: None, ways: BTreeMap::new(), behind: false, held_up: false }
    }
}

impl<T> Default for MergeSource<T> {
    fn default() -> Self {
        Self { next: None, lost: 0, missed: 0 }
    }
}

impl<T> Merge<T> {
    /// Replaces the readers.
    pub fn set(&mut self, readers: impl IntoIterator<Item = Gid>) {
        let mut before = std::mem::take(&mut self.ways);
        let ways = readers.into_iter().map(|gid| (gid, before.remove(&gid).unwrap_or_default()));
        self.ways = ways.collect();
    }

    /// Returns the readers.
    pub fn readers(&self) -> impl Iterator<Item = &Gid> {
        self.ways.keys()
    }

    /// Starts again: all messages of the readers are merged once more, because one reader has earlier messages again.
    pub fn rewind(&mut self) {
        self.given = None;
    }

    /// Marks the messages up to this number as merged.
    pub fn pass(&mut self, number: u64) {
        self.given = self.given.max(Some(number));
    }

    /// Returns whether there is only one reader, whose messages may bypass the merge ([`give`](Self::give)).
    pub fn is_of_one(&self) -> bool {
        self.ways.len() == 1 && !self.behind && !self.holds_any()
    }

    /// Merges the message of this number, which the caller has taken from the only reader. Returns false if it was
    /// merged before.
    pub fn give(&mut self, number: u64) -> bool {
        let is_new = Some(number) > self.given;
        self.given = self.given.max(Some(number));
        is_new
    }

    /// Returns whether the merge holds a message of this reader.
    pub fn holds(&self, reader: &Gid) -> bool {
        self.ways.get(reader).is_some_and(|way| way.next.is_some())
    }

    /// Returns whether the merge holds a message of any reader.
    pub fn holds_any(&self) -> bool {
        self.ways.values().any(|way| way.next.is_some())
    }

    /// Returns the number of different messages that the merge holds.
    pub fn held(&self) -> usize {
        let numbers = self.ways.values().filter_map(|way| Some(way.next.as_ref()?.number));
        numbers.collect::<BTreeSet<_>>().len()
    }

    /// Returns whether a reader has more repeated messages than one pass drops. Until they are dropped there is no next
    /// message.
    pub fn is_behind(&self) -> bool {
        self.behind
    }

    /// Returns whether a reader that may lose no message has messages that it cannot give yet. Until it can, there is
    /// no next message.
    pub fn is_held_up(&self) -> bool {
        self.held_up
    }

    /// Returns the next message. `take` takes a message of one reader. For a reader without a message, `waits` returns
    /// whether it has messages that it may not lose and cannot give yet, for lack of memory. The messages of other
    /// readers may be newer than those.
    pub fn next(
        &mut self,
        take: impl Fn(&Gid) -> Option<MergedSample<T>>,
        waits: impl Fn(&Gid) -> bool,
    ) -> Option<MergedSample<T>> {
        self.look(&take);
        if self.ways.len() > 1 && self.holds_any() {
            // A reader that had no message may by now have one that was written before the others' messages.
            self.look(&take);
        }
        let without = |(reader, way): (&Gid, &MergeSource<T>)| way.next.is_none() && waits(reader);
        self.held_up = self.ways.iter().any(without);
        if self.behind || self.held_up {
            return None;
        }
        let there = self.ways.values_mut().filter(|way| way.next.is_some());
        let way = there.min_by_key(|way| way.next.as_ref().map(|next| next.number))?;
        let mut next = way.next.take()?;
        // Another reader may have had the messages that this reader has lost.
        let missing = self.given.map_or(u64::MAX, |given| next.number.saturating_sub(given + 1));
        next.lost = std::mem::take(&mut way.missed).min(missing);
        self.given = Some(next.number);
        Some(next)
    }

    /// Drops messages of readers that are merged already. Returns whether the merge [is behind](Self::is_behind).
    pub fn pass_over(&mut self, take: impl Fn(&Gid) -> Option<MergedSample<T>>) -> bool {
        if self.ways.len() > 1 || self.behind {
            self.look(&take);
        }
        self.behind
    }

    /// Takes the next message of each reader, if the reader has one that is not merged yet.
    fn look(&mut self, take: &impl Fn(&Gid) -> Option<MergedSample<T>>) {
        let given = self.given;
        let is_new = |next: &MergedSample<T>| Some(next.number) > given;
        self.behind = false;
        for (reader, way) in &mut self.ways {
            let mut left = BATCH;
            if way.next.as_ref().is_some_and(|next| !is_new(next)) {
                (way.next, way.missed) = (None, 0);
            }
            while way.next.is_none() {
                if left == 0 {
                    self.behind = true;
                    break;
                }
                left -= 1;
                let Some(next) = take(reader) else { break };
                // The count of a writer that was attached again starts from 0.
                let lost = next.lost.checked_sub(way.lost).unwrap_or(next.lost);
                way.lost = next.lost;
                if is_new(&next) {
                    way.missed = lost;
                    way.next = Some(next);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        cell::RefCell,
        collections::{HashMap, VecDeque},
    };

    use super::*;

    const ONE: Gid = Gid([1; 16]);
    const OTHER: Gid = Gid([2; 16]);

    /// The messages of the readers: numbers, each with the number of samples lost by then.
    #[derive(Default)]
    struct Readers(RefCell<HashMap<Gid, VecDeque<(u64, u64)>>>);

    /// Returns false: no reader waits for memory.
    fn never(_: &Gid) -> bool {
        false
    }

    impl Readers {
        fn have(&self, reader: Gid, samples: impl IntoIterator<Item = (u64, u64)>) {
            self.0.borrow_mut().entry(reader).or_default().extend(samples);
        }

        fn take(&self, reader: &Gid) -> Option<MergedSample<()>> {
            let (number, lost) = self.0.borrow_mut().get_mut(reader)?.pop_front()?;
            Some(MergedSample { number, lost, content: () })
        }
    }

    fn merge() -> Merge<()> {
        let mut merge = Merge::default();
        merge.set([ONE, OTHER]);
        merge
    }

    /// Merges all messages. Returns the number of each, and how many were lost before it.
    fn all(merge: &mut Merge<()>, readers: &Readers) -> Vec<(u64, u64)> {
        let mut all = Vec::new();
        loop {
            let next = merge.next(|reader| readers.take(reader), never);
            all.extend(next.as_ref().map(|next| (next.number, next.lost)));
            if next.is_none() && !merge.pass_over(|reader| readers.take(reader)) {
                return all;
            }
        }
    }

    fn whole(numbers: std::ops::RangeInclusive<u64>) -> impl Iterator<Item = (u64, u64)> {
        numbers.map(|number| (number, 0))
    }

    #[test]
    fn each_is_given_on_once_and_in_order() {
        let (mut merge, readers) = (merge(), Readers::default());
        readers.have(ONE, whole(5..=5));
        readers.have(OTHER, whole(1..=5));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(1..=5)));
        readers.have(ONE, whole(6..=200));
        readers.have(OTHER, whole(7..=201));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(6..=201)));
    }

    #[test]
    fn samples_of_an_ended_reader_come_through_another() {
        let (mut merge, readers) = (merge(), Readers::default());
        readers.have(ONE, whole(1..=300));
        readers.have(OTHER, whole(1..=300));
        let next = merge.next(|reader| readers.take(reader), never).unwrap();
        assert_eq!(next.number, 1);
        while merge.pass_over(|reader| readers.take(reader)) {}
        assert!(merge.holds(&ONE) && merge.holds(&OTHER));
        merge.set([OTHER]);
        assert!(!merge.holds(&ONE));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(2..=300)));
    }

    #[test]
    fn merge_keeps_the_order_of_concurrent_samples() {
        let (mut merge, readers) = (merge(), Readers::default());
        let asked = RefCell::new(0);
        // The message is written after the first reader was asked; that reader has all messages.
        let take = |reader: &Gid| {
            if asked.replace_with(|asked| *asked + 1) == 1 {
                readers.have(ONE, whole(1..=5));
                readers.have(OTHER, whole(5..=5));
            }
            readers.take(reader)
        };
        assert_eq!(merge.next(take, never).unwrap().number, 1);
        assert!(all(&mut merge, &readers).into_iter().eq(whole(2..=5)));
    }

    #[test]
    fn lost_counts_samples_missing_from_every_reader() {
        let (mut merge, readers) = (merge(), Readers::default());
        readers.have(ONE, [(3, 2)]);
        assert_eq!(all(&mut merge, &readers), [(3, 2)], "before the first");
        readers.have(ONE, [(4, 2), (5, 2), (9, 5)]);
        readers.have(OTHER, [(5, 4), (6, 4), (9, 6), (10, 6), (20, 11)]);
        // 7 and 8 are among the three losses of the one reader and the two of the other.
        let found = all(&mut merge, &readers);
        assert_eq!(found, [(4, 0), (5, 0), (6, 0), (9, 2), (10, 0), (20, 5)]);
        // A gap that no reader reports as lost was never a sample. A reader that attaches again counts from 0.
        readers.have(OTHER, [(30, 0), (40, 3)]);
        assert_eq!(all(&mut merge, &readers), [(30, 0), (40, 3)]);
    }

    #[test]
    fn a_backlog_that_was_given_on_long_ago_hides_nothing_new() {
        let (mut merge, readers) = (merge(), Readers::default());
        readers.have(ONE, whole(1..=1000));
        assert_eq!(all(&mut merge, &readers).len(), 1000);
        readers.have(ONE, whole(1003..=1003));
        readers.have(OTHER, whole(1..=1003));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(1001..=1003)));
    }

    #[test]
    fn merge_drops_samples_below_the_passed_number() {
        let (mut merge, readers) = (merge(), Readers::default());
        merge.pass(4);
        merge.pass(2);
        readers.have(ONE, whole(3..=5));
        readers.have(OTHER, whole(4..=4));
        readers.have(OTHER, whole(7..=7));
        assert_eq!(all(&mut merge, &readers), [(5, 0), (7, 0)]);
    }

    #[test]
    fn messages_of_one_reader_that_go_past_it_are_not_given_on_again() {
        let (mut merge, readers) = (merge(), Readers::default());
        assert!(!merge.is_of_one());
        merge.set([ONE]);
        merge.pass(3);
        assert!(merge.is_of_one());
        let given: Vec<_> = (1..=6).filter(|number| merge.give(*number)).collect();
        assert_eq!(given, [4, 5, 6]);
        merge.set([ONE, OTHER]);
        readers.have(OTHER, whole(1..=7));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(7..=7)));
    }

    #[test]
    fn history_is_given_on_when_it_is_wanted() {
        let (mut merge, readers) = (merge(), Readers::default());
        readers.have(ONE, whole(8..=9));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(8..=9)));
        readers.have(OTHER, whole(1..=9));
        merge.rewind();
        readers.have(ONE, whole(10..=10));
        assert!(all(&mut merge, &readers).into_iter().eq(whole(1..=10)));
    }

    #[test]
    fn merge_waits_for_a_lossless_reader_that_awaits_memory() {
        let mut merge = Merge::default();
        merge.set([ONE, OTHER]);
        let readers = Readers::default();
        readers.have(ONE, [(1, 0)]);
        readers.have(OTHER, [(1, 0)]);
        let take = |reader: &Gid| readers.take(reader);
        assert_eq!(merge.next(take, never).unwrap().number, 1);
        // The memory of 2 to 8 has not come; the other reader keeps only the newest messages.
        readers.have(OTHER, [(9, 7), (10, 7)]);
        let waits = |reader: &Gid| *reader == ONE;
        assert!(merge.next(take, waits).is_none() && merge.is_held_up());
        assert!(merge.next(take, waits).is_none(), "however often it is asked");
        readers.have(ONE, (2..=10).map(|number| (number, 0)));
        let numbers: Vec<_> =
            std::iter::from_fn(|| merge.next(take, never)).map(|next| next.number).collect();
        assert_eq!(numbers, (2..=10).collect::<Vec<_>>());
        assert!(!merge.is_held_up());
    }
}
