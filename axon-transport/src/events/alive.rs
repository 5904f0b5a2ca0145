//! Collects the publishers that asserted their liveliness. The collection is sent to processes and hosts that cannot
//! see the assertions themselves, in time for the shortest lease.

use std::{collections::BTreeMap, time::Duration};

use crate::ids::Gid;

/// The shortest time between two reports.
const SHORTEST: Duration = Duration::from_millis(5);
/// Maximum number of publishers in one message.
const PART: usize = 1024;

/// The state of the liveliness reports from one end to another.
#[derive(Default)]
pub struct Alive {
    every: Option<Duration>,
    looked: Option<Duration>,
    told: BTreeMap<Gid, u64>,
}

impl Alive {
    /// Sets the leases of the publishers to report.
    pub fn watch(&mut self, leases: impl Iterator<Item = Duration>) {
        self.every = leases.min().map(|least| (least / 4).max(SHORTEST));
    }

    /// Returns the time until the next report, or `None` without leases.
    pub fn left(&self, now: Duration) -> Option<Duration> {
        let every = self.every?;
        let since = self.looked.map(|looked| now.saturating_sub(looked));
        Some(since.map_or(Duration::ZERO, |since| every.saturating_sub(since)))
    }

    /// Returns the publishers asserted since the last report, in groups of at most one message, if the report is due.
    /// `asserted` contains the times of assertions; a publisher may occur several times.
    pub fn due_assertions(
        &mut self,
        now: Duration,
        asserted: impl Iterator<Item = (Gid, u64)>,
    ) -> Vec<Vec<Gid>> {
        if self.left(now) != Some(Duration::ZERO) {
            return Vec::new();
        }
        self.looked = Some(now);
        let mut alive: BTreeMap<Gid, u64> = BTreeMap::new();
        for (gid, at) in asserted {
            let last = alive.entry(gid).or_default();
            *last = at.max(*last);
        }
        let asserted = alive.iter().filter(|(gid, at)| self.told.get(gid) != Some(at));
        let asserted: Vec<Gid> = asserted.map(|(gid, _)| *gid).collect();
        self.told = alive;
        asserted.chunks(PART).map(<[_]>::to_vec).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEASE: Duration = Duration::from_millis(400);

    fn gid(number: u8) -> Gid {
        Gid([number; 16])
    }

    #[test]
    fn alive_reports_within_the_shortest_lease() {
        let (mut alive, start) = (Alive::default(), Duration::from_secs(1000));
        assert_eq!(alive.left(start), None);
        assert!(
            alive.due_assertions(start, [(gid(1), 1)].into_iter()).is_empty(),
            "nobody has a lease"
        );
        alive.watch([2 * LEASE, LEASE].into_iter());
        assert_eq!(alive.left(start), Some(Duration::ZERO));
        let both = [(gid(1), 1), (gid(2), 1), (gid(1), 3)];
        assert_eq!(alive.due_assertions(start, both.into_iter()), [[gid(1), gid(2)]]);
        let quarter = LEASE / 4;
        assert_eq!(alive.left(start), Some(quarter));
        let early = start + quarter / 2;
        assert!(alive.due_assertions(early, [(gid(2), 2)].into_iter()).is_empty(), "not yet");
        // A known assertion is not reported again, in any order. A newer assertion or a new publisher is reported.
        let next = start + quarter;
        let now = [(gid(1), 3), (gid(1), 1), (gid(2), 2), (gid(3), 1)];
        assert_eq!(alive.due_assertions(next, now.into_iter()), [[gid(2), gid(3)]]);
        alive.watch([Duration::from_nanos(1)].into_iter());
        assert_eq!(alive.left(next), Some(SHORTEST));
        alive.watch(std::iter::empty());
        assert_eq!(alive.left(next + quarter), None);
    }

    #[test]
    fn however_many_are_alive_all_are_named() {
        let mut alive = Alive::default();
        alive.watch([LEASE].into_iter());
        let many = (0..2500).map(|number: u64| {
            let mut gid = [0; 16];
            gid[..8].copy_from_slice(&number.to_be_bytes());
            (Gid(gid), 1)
        });
        let parts = alive.due_assertions(Duration::from_secs(1000), many);
        assert!(parts.iter().map(Vec::len).eq([1024, 1024, 452]));
    }
}
