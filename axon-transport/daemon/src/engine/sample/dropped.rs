//! Numbers of the samples of one publisher that were dropped here. A link that breaks has what was not acknowledged sent
//! again: what was dropped once is neither counted a second time nor delivered, and the publisher is told that it was lost.

use std::collections::VecDeque;

/// As many runs are remembered. Of those that are joined it is known how many samples were dropped, and not which.
const RUNS: usize = 64;

/// Consecutive numbers of which some were dropped.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: u64,
    last: u64,
    /// How many of them were dropped.
    dropped: u64,
}

/// What became of a sample when it came before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EarlierFate {
    /// It was dropped, as far as is known.
    Dropped,
    /// It was handled, and is not reported as dropped.
    Passed,
    /// It did not come, or was delivered.
    Unknown,
}

/// Numbers that were dropped, in runs, oldest first.
///
/// There is room for few. When more come, two neighbours are joined, and the numbers between them belong to the joined run.
/// These came and were delivered, or never come: numbers rise. A publisher sends again all from some number on. So of a run
/// that comes again as a whole it is told the true count. Of one that comes in part it is told at least what was dropped
/// of that part. Therefore runs that are long ago are joined to longer ones than new runs: a link that breaks has the
/// newest numbers sent again, and the part is a share of what is sent that does not grow.
#[derive(Debug, Default)]
pub(in crate::engine) struct DroppedRuns(VecDeque<Run>);

impl DroppedRuns {
    /// A sample was dropped. One whose number does not rise is not remembered.
    pub(in crate::engine) fn add(&mut self, sequence: u64) {
        match self.0.back_mut() {
            Some(newest) if newest.last >= sequence => return,
            Some(newest) if newest.last + 1 == sequence => {
                (newest.last, newest.dropped) = (sequence, newest.dropped + 1);
                return;
            }
            _ => {}
        }
        self.0.push_back(Run { first: sequence, last: sequence, dropped: 1 });
        if self.0.len() > RUNS {
            self.join();
        }
    }

    /// Joins the two neighbours that are shortest together, measured by how long ago they are.
    fn join(&mut self) {
        let Some(newest) = self.0.back().map(|run| run.last) else { return };
        let lengths = self.0.iter().zip(self.0.iter().skip(1)).map(|(one, next)| {
            (u128::from(next.last - one.first), u128::from(newest - next.last) + 1)
        });
        let shortest = lengths
            .enumerate()
            .min_by(|(_, one), (_, other)| (one.0 * other.1).cmp(&(other.0 * one.1)));
        let Some((at, _)) = shortest else { return };
        if let Some(next) = self.0.remove(at + 1) {
            let run = &mut self.0[at];
            (run.last, run.dropped) = (next.last, run.dropped + next.dropped);
        }
    }

    /// What became of a sample that comes again.
    pub(in crate::engine) fn find(&self, sequence: u64) -> EarlierFate {
        let at = self.0.partition_point(|run| run.last < sequence);
        match self.0.get(at) {
            // The last ones of a run are told as dropped, whichever were: so a part of it tells no fewer than there were.
            Some(run) if run.last - sequence < run.dropped => EarlierFate::Dropped,
            Some(run) if sequence >= run.first => EarlierFate::Passed,
            _ => EarlierFate::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_numbers_are_one_run() {
        let mut dropped = DroppedRuns::default();
        [3, 4, 5, 9].into_iter().for_each(|number| dropped.add(number));
        let has: Vec<_> =
            (0..12).filter(|number| dropped.find(*number) == EarlierFate::Dropped).collect();
        assert_eq!((has, dropped.0.len()), (vec![3, 4, 5, 9], 2));
        assert!((0..12).all(|number| dropped.find(number) != EarlierFate::Passed));
    }

    #[test]
    fn numbers_that_do_not_rise_are_not_remembered_and_none_overflows() {
        let mut dropped = DroppedRuns::default();
        [u64::MAX - 1, u64::MAX, u64::MAX, 0].into_iter().for_each(|number| dropped.add(number));
        assert_eq!((dropped.0.len(), dropped.find(0)), (1, EarlierFate::Unknown));
        assert_eq!(dropped.find(u64::MAX), EarlierFate::Dropped);
        let mut first = DroppedRuns::default();
        [0, 1].into_iter().for_each(|number| first.add(number));
        assert_eq!(
            [0, 1, 2].map(|n| first.find(n)),
            [EarlierFate::Dropped, EarlierFate::Dropped, EarlierFate::Unknown]
        );
    }

    /// Of numbers up to `newest` those were dropped of which `is` says so. What is told when all from any number on come
    /// again is no less than what was dropped among them, and at most a third of them more.
    fn tells_enough(newest: u64, is: impl Fn(u64) -> bool) {
        let mut dropped = DroppedRuns::default();
        (1..=newest).filter(|number| is(*number)).for_each(|number| dropped.add(number));
        assert!(dropped.0.len() <= RUNS);
        let (mut truth, mut told) = (0, 0);
        for number in (1..=newest).rev() {
            truth += u64::from(is(number));
            told += u64::from(dropped.find(number) == EarlierFate::Dropped);
            let all = newest - number + 1;
            assert!(told >= truth, "from {number} of {newest}: {told} of {truth}");
            assert!(told <= truth + all / 3 + 2, "from {number} of {newest}: {told} of {truth}");
        }
        assert_eq!(told, truth, "all");
        // None that was dropped is delivered when it comes again.
        let mut delivered =
            (1..=newest).filter(|n| is(*n) && dropped.find(*n) == EarlierFate::Unknown);
        assert_eq!(delivered.next(), None);
    }

    #[test]
    fn a_publisher_is_told_of_no_fewer_than_were_dropped_however_many_runs_there_were() {
        for newest in [100, 1_000, 100_000] {
            tells_enough(newest, |number| number % 2 == 0);
            tells_enough(newest, |number| number % 7 == 3);
            tells_enough(newest, |number| number % 7 != 3);
            // Long and short runs by chance.
            tells_enough(newest, |number| number.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 62 == 0);
            tells_enough(newest, |number| (number / 50) % 3 == 0 && number % 5 > 0);
        }
    }
}
