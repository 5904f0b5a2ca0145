//! Merges the samples that several readers took of one writer's ring into one sequence: each message once, in the
//! order of its number. The readers ask for different QoS, or attached at different times.
//!
//! The gateway and the relays need this order. They carry messages to another host, or to or from a process that
//! shares no memory.

use std::collections::{BTreeMap, BTreeSet};

use crate::ids::Gid;

/// Messages of one reader that are passed over before others have their turn.
const BATCH: usize = 64;

/// A message that was taken.
#[derive(Debug)]
pub struct MergedSample<T> {
    /// Its number.
    pub number: u64,
    /// Of the writer's messages, those that the reader has lost by then. Of what is given on, those that
    /// all have lost since the one before.
    pub lost: u64,
    /// What was taken.
    pub content: T,
}

/// A writer's messages, by way of all readers of it that there are. What one of them has, and has not
/// been given on, is not lost when another has gone further or comes to an end.
#[derive(Debug)]
pub struct Merge<T> {
    /// The number of the newest one that was given on.
    given: Option<u64>,
    ways: BTreeMap<Gid, MergeSource<T>>,
    /// Whether a reader had more to be dropped than was looked at.
    behind: bool,
    /// Whether a reader that may lose nothing had messages that it could not give.
    held_up: bool,
}

#[derive(Debug)]
struct MergeSource<T> {
    /// Taken, and newer than what was given on.
    next: Option<MergedSample<T>>,
    /// Messages that its reader has lost, as far as is known.
    lost: u64,
    /// Those among them that come after what was given on.
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
    /// These are the readers from now on.
    pub fn set(&mut self, readers: impl IntoIterator<Item = Gid>) {
        let mut before = std::mem::take(&mut self.ways);
        let ways = readers.into_iter().map(|gid| (gid, before.remove(&gid).unwrap_or_default()));
        self.ways = ways.collect();
    }

    /// The readers.
    pub fn readers(&self) -> impl Iterator<Item = &Gid> {
        self.ways.keys()
    }

    /// Whatever the readers have is given on once more: one of them has what came before.
    pub fn rewind(&mut self) {
        self.given = None;
    }

    /// Those up to this number need not be given on.
    pub fn pass(&mut self, number: u64) {
        self.given = self.given.max(Some(number));
    }

    /// Whether there is one reader, whose messages may go [past it](Self::give).
    pub fn is_of_one(&self) -> bool {
        self.ways.len() == 1 && !self.behind && !self.holds_any()
    }

    /// Gives on the message of this number, which its caller has taken from the only reader. False: it was given on
    /// before.
    pub fn give(&mut self, number: u64) -> bool {
        let is_new = Some(number) > self.given;
        self.given = self.given.max(Some(number));
        is_new
    }

    /// Whether there is a message that a reader has given up to it.
    pub fn holds(&self, reader: &Gid) -> bool {
        self.ways.get(reader).is_some_and(|way| way.next.is_some())
    }

    /// Whether there is one of any reader.
    pub fn holds_any(&self) -> bool {
        self.ways.values().any(|way| way.next.is_some())
    }

    /// How many messages there are that readers have given up to it.
    pub fn held(&self) -> usize {
        let numbers = self.ways.values().filter_map(|way| Some(way.next.as_ref()?.number));
        numbers.collect::<BTreeSet<_>>().len()
    }

    /// Whether readers have more that another had than could be dropped in one go: there is no next one
    /// until that is gone.
    pub fn is_behind(&self) -> bool {
        self.behind
    }

    /// Whether a reader that may lose nothing has messages that it cannot give yet: there is no next one until it can.
    pub fn is_held_up(&self) -> bool {
        self.held_up
    }

    /// The next message. `take` has that of one reader. `waits` says of a reader that has none whether there are some that
    /// it cannot give yet, for want of memory, and may not lose: what others have meanwhile may be newer.
    pub fn next(
        &mut self,
        take: impl Fn(&Gid) -> Option<MergedSample<T>>,
        waits: impl Fn(&Gid) -> bool,
    ) -> Option<MergedSample<T>> {
        self.look(&take);
        if self.ways.len() > 1 && self.holds_any() {
            // Where there was nothing there may be by now what was written before that one.
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
        // What one has lost another may have had.
        let missing = self.given.map_or(u64::MAX, |given| next.number.saturating_sub(given + 1));
        next.lost = std::mem::take(&mut way.missed).min(missing);
        self.given = Some(next.number);
        Some(next)
    }

    /// Drops what one reader has and another had; whether it [is behind](Self::is_behind).
    pub fn pass_over(&mut self, take: impl Fn(&Gid) -> Option<MergedSample<T>>) -> bool {
        if self.ways.len() > 1 || self.behind {
            self.look(&take);
        }
        self.behind
    }

    /// Has the next message of each reader at hand, if it has one that was not given on.
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
                // A writer that was attached anew counts from 0.
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

    /// What readers have: numbers, each with that of the samples lost by then.
    #[derive(Default)]
    struct Readers(RefCell<HashMap<Gid, VecDeque<(u64, u64)>>>);

    /// No reader waits for memory.
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

    /// Whatever there is: the number of each, and that of those lost before it.
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
        // It is written after the first reader was asked, which has all of it.
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
        // 7 and 8 are of the one's three and the other's two.
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
        // The memory of 2 to 8 has not come; the other one keeps the newest alone.
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
