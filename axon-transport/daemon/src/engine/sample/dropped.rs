//! Numbers of one publisher's samples that were dropped here. After a link breaks, the peer sends the
//! unacknowledged samples again. A sample that was dropped before is then neither delivered nor counted
//! again, and the publisher learns that it was lost.

use std::collections::VecDeque;

/// The most runs that are remembered. For joined runs only the number of dropped samples is known, not which.
const RUNS: usize = 64;

/// A range of numbers, some of which were dropped.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: u64,
    last: u64,
    /// The number of dropped samples in the range.
    dropped: u64,
}

/// The result of a sample's first arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EarlierFate {
    /// The sample was dropped, as far as is known.
    Dropped,
    /// The sample was handled and is not reported as dropped.
    Passed,
    /// The sample did not arrive, or was delivered.
    Unknown,
}

/// Dropped numbers in runs, oldest first.
///
/// The number of runs is bounded. Beyond the bound two neighbours are joined, and the numbers between them
/// belong to the joined run. Those numbers were delivered or never come, because numbers rise.
///
/// A publisher sends again all samples from some number on. If a run is repeated as a whole, the reported
/// count is exact. If only a part is repeated, the reported count is at least the number of dropped samples
/// in it. Therefore old runs are joined into longer ones than new runs: a broken link repeats the newest
/// numbers, so the part is a bounded share of the repeated numbers.
#[derive(Debug, Default)]
pub(in crate::engine) struct DroppedRuns(VecDeque<Run>);

impl DroppedRuns {
    /// Records a dropped sample. A sample whose number does not rise is not recorded.
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

    /// Joins the two neighbours that are shortest together in relation to their age.
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

    /// Returns the result of the first arrival of a sample that arrives again.
    pub(in crate::engine) fn find(&self, sequence: u64) -> EarlierFate {
        let at = self.0.partition_point(|run| run.last < sequence);
        match self.0.get(at) {
            // The last numbers of a run count as dropped, even if earlier numbers were dropped in fact. So any repeated
            // end of a run reports at least as many as were dropped in it.
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

    /// Drops the numbers up to `newest` that `is` selects. Checks that, when all numbers from any one on are
    /// repeated, the reported count is no less than the true one, and at most a third of the numbers more.
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
        // No dropped sample is delivered when it comes again.
        let mut delivered =
            (1..=newest).filter(|n| is(*n) && dropped.find(*n) == EarlierFate::Unknown);
        assert_eq!(delivered.next(), None);
    }

    #[test]
    fn report_of_drops_never_undercounts() {
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
