//! The take-overs that peers may cause.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::DaemonId;

use super::budget::{Budget, Rate};

/// Take-overs that a peer may cause: eight at once, then one each second. After each of them this host sends its graph
/// and the unacknowledged samples again. Two take-overs of an honest peer are a second apart: a second link is looked
/// for during a second, and a path counts as cut after 300 ms.
const TAKE_OVERS: Rate = Rate { pause: Duration::from_secs(1), at_once: 8 };

/// The take-overs that each peer may cause. It outlives the peer's links.
#[derive(Debug, Default)]
pub(super) struct TakeOvers {
    budgets: HashMap<DaemonId, Budget>,
}

impl TakeOvers {
    /// Records a take-over that a peer causes.
    ///
    /// # Errors
    /// The time of the next one that is permitted.
    pub(super) fn begin(&mut self, daemon: DaemonId, now: Duration) -> Result<(), Duration> {
        self.budgets.retain(|_, budget| !budget.is_full(now));
        let budget = self.budgets.entry(daemon).or_default();
        let due = budget.due(TAKE_OVERS);
        if now < due {
            return Err(due);
        }
        budget.pay(TAKE_OVERS, now);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peer_that_switches_on_and_on_gets_one_take_over_each_second() {
        let (peer, other) = (DaemonId([1; 16]), DaemonId([2; 16]));
        let mut all = TakeOvers::default();
        let begun = |all: &mut TakeOvers, range: std::ops::Range<u64>| {
            range.filter(|at| all.begin(peer, Duration::from_millis(*at)).is_ok()).count()
        };
        assert_eq!(begun(&mut all, 0..1000), 8, "of a daemon that has just started");
        assert_eq!(begun(&mut all, 1000..11_000), 10);
        let now = Duration::from_millis(10_500);
        assert_eq!(all.begin(peer, now), Err(Duration::from_secs(11)));
        all.begin(other, now).unwrap();
        // What it did not use returns, and is forgotten.
        assert_eq!(begun(&mut all, 20_000..20_500), 8);
        all.begin(other, Duration::from_secs(60)).unwrap();
        assert_eq!(all.budgets.len(), 1);
    }

    #[test]
    fn peer_whose_paths_are_cut_each_second_never_waits() {
        let mut all = TakeOvers::default();
        for cut in 0..1000 {
            // Messages of two cuts may come together.
            let at = Duration::from_millis(cut / 2 * 2000);
            all.begin(DaemonId([1; 16]), at).unwrap();
        }
    }
}
