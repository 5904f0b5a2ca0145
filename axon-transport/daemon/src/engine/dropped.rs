//! Numbers of the samples of one publisher that were dropped here. A link that breaks has what was not acknowledged sent
//! again: what was dropped once is neither counted a second time nor delivered.

use std::collections::VecDeque;

/// As many runs are remembered. What was dropped before them and comes again is judged as if it were new.
const RUNS: usize = 64;

/// The newest numbers that were dropped, in runs of consecutive ones.
#[derive(Debug, Default)]
pub(super) struct DroppedRuns(VecDeque<(u64, u64)>);

impl DroppedRuns {
    /// A sample was dropped. Numbers rise.
    pub(super) fn add(&mut self, sequence: u64) {
        if let Some((_, last)) = self.0.back_mut()
            && last.checked_add(1) == Some(sequence)
        {
            *last = sequence;
            return;
        }
        if self.0.len() == RUNS {
            self.0.pop_front();
        }
        self.0.push_back((sequence, sequence));
    }

    /// Whether this one was dropped.
    pub(super) fn has(&self, sequence: u64) -> bool {
        self.0.iter().rev().any(|(first, last)| (*first..=*last).contains(&sequence))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn consecutive_numbers_are_one_run() {
        let mut dropped = DroppedRuns::default();
        [3, 4, 5, 9].into_iter().for_each(|number| dropped.add(number));
        let has: Vec<_> = (0..12).filter(|number| dropped.has(*number)).collect();
        assert_eq!((has, dropped.0.len()), (vec![3, 4, 5, 9], 2));
    }

    #[test]
    fn the_oldest_runs_are_forgotten() {
        let mut dropped = DroppedRuns::default();
        (0..=RUNS as u64).for_each(|run| dropped.add(10 * run));
        assert_eq!(dropped.0.len(), RUNS);
        assert!(!dropped.has(0) && dropped.has(10) && dropped.has(10 * RUNS as u64));
        dropped.add(u64::MAX);
        dropped.add(0);
        assert!(dropped.has(u64::MAX) && dropped.has(0), "no number overflows");
    }
}
