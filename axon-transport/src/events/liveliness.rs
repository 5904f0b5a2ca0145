//! Liveliness: leases that are asserted, expire, and are asserted again.

use std::collections::HashMap;

use crate::ids::Gid;

/// A lease and its last assertion.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lease {
    /// Duration in nanoseconds. `None` never expires.
    duration: Option<u64>,
    asserted: u64,
    alive: bool,
}

impl Lease {
    /// Creates a lease of `duration` nanoseconds that is asserted at `now`.
    pub(crate) fn new(duration: Option<u64>, now: u64) -> Self {
        Self { duration: duration.map(|d| d.max(1)), asserted: now, alive: true }
    }

    /// Asserts the lease at `at`. Returns whether it was expired before. An assertion that is already known
    /// changes nothing.
    pub(crate) fn assert(&mut self, at: u64) -> bool {
        if at <= self.asserted {
            return false;
        }
        self.asserted = at;
        !std::mem::replace(&mut self.alive, true)
    }

    /// Returns whether the lease expired by `now`, once per expiry.
    pub(crate) fn ran_out(&mut self, now: u64) -> bool {
        let over = self.due().is_some_and(|due| due <= now);
        if over {
            self.alive = false;
        }
        over
    }

    /// Returns the time of the expiry, or `None` if the lease never expires or has already expired.
    pub(crate) fn due(&self) -> Option<u64> {
        let due = self.asserted.saturating_add(self.duration?);
        self.alive.then_some(due)
    }
}

/// The leases of a subscription's publishers. Each change returns what it adds to the number of alive
/// publishers and to the number of publishers that are not alive.
#[derive(Clone, Debug, Default)]
pub(crate) struct Liveness {
    leases: HashMap<Gid, Lease>,
}

impl Liveness {
    /// Adds a matched publisher, with the lease that it offers.
    pub(crate) fn matched(&mut self, publisher: Gid, lease: Option<u64>, now: u64) -> (i64, i64) {
        match self.leases.insert(publisher, Lease::new(lease, now)) {
            None => (1, 0),
            Some(before) if before.alive => (0, 0),
            Some(_) => (1, -1),
        }
    }

    /// Removes a publisher.
    pub(crate) fn unmatched(&mut self, publisher: &Gid) -> (i64, i64) {
        match self.leases.remove(publisher) {
            None => (0, 0),
            Some(lease) if lease.alive => (-1, 0),
            Some(_) => (0, -1),
        }
    }

    /// Asserts the liveliness of a publisher at `at`.
    pub(crate) fn assert(&mut self, publisher: &Gid, at: u64) -> (i64, i64) {
        let revived = self.leases.get_mut(publisher).is_some_and(|lease| lease.assert(at));
        if revived { (1, -1) } else { (0, 0) }
    }

    /// Expires the leases that end by `now`.
    pub(crate) fn ran_out(&mut self, now: u64) -> (i64, i64) {
        let over = self.leases.values_mut().map(|lease| i64::from(lease.ran_out(now))).sum::<i64>();
        (-over, over)
    }

    /// Returns whether a lease has expired and was not asserted again.
    pub(crate) fn any_dead(&self) -> bool {
        self.leases.values().any(|lease| !lease.alive)
    }

    /// Returns the time of the next expiry.
    pub(crate) fn due(&self) -> Option<u64> {
        self.leases.values().filter_map(Lease::due).min()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_lease_runs_out_once_until_it_is_asserted_again() {
        let mut lease = Lease::new(Some(10), 100);
        assert_eq!(lease.due(), Some(110));
        assert!(!lease.ran_out(109));
        assert!(lease.ran_out(110));
        assert!(!lease.ran_out(200), "not alive stays not alive");
        assert_eq!(lease.due(), None);
        assert!(!lease.assert(100), "the assertion that ran out is none");
        assert!(!lease.ran_out(201));
        assert!(lease.assert(205));
        assert!(!lease.assert(206));
        assert_eq!(lease.due(), Some(216));
    }

    #[test]
    fn an_infinite_lease_never_runs_out() {
        let mut lease = Lease::new(None, 0);
        assert!(!lease.ran_out(u64::MAX));
        assert_eq!(lease.due(), None);
        assert!(!lease.assert(3), "it was alive all along");
    }

    #[derive(Clone, Debug)]
    enum Step {
        Matched(u8, Option<u64>),
        Unmatched(u8),
        Assert(u8),
        Pass(u64),
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            (0u8..4, prop_oneof![Just(None), (1u64..20).prop_map(Some)])
                .prop_map(|(p, lease)| Step::Matched(p, lease)),
            (0u8..4).prop_map(Step::Unmatched),
            (0u8..4).prop_map(Step::Assert),
            (0u64..30).prop_map(Step::Pass),
        ]
    }

    proptest! {
        /// The changes add up to the number of publishers whose last assertion is within their lease, and the number of
        /// the others.
        #[test]
        fn the_changes_add_up(steps in prop::collection::vec(step(), 1..60)) {
            let mut liveness = Liveness::default();
            // Publisher: lease, last assertion.
            let mut model: HashMap<u8, (Option<u64>, u64)> = HashMap::new();
            let (mut now, mut alive, mut not_alive) = (0, 0i64, 0i64);
            for step in steps {
                let gid = |p: u8| Gid([p; 16]);
                let change = match step {
                    Step::Matched(p, lease) => {
                        model.insert(p, (lease, now));
                        liveness.matched(gid(p), lease, now)
                    }
                    Step::Unmatched(p) => {
                        model.remove(&p);
                        liveness.unmatched(&gid(p))
                    }
                    Step::Assert(p) => {
                        model.entry(p).and_modify(|(_, asserted)| *asserted = now);
                        liveness.assert(&gid(p), now)
                    }
                    Step::Pass(time) => {
                        now += time;
                        liveness.ran_out(now)
                    }
                };
                alive += change.0;
                not_alive += change.1;
                let is_alive = |(lease, asserted): &(Option<u64>, u64)| {
                    lease.is_none_or(|lease| asserted + lease > now)
                };
                let expected = model.values().filter(|m| is_alive(m)).count() as i64;
                prop_assert_eq!(alive, expected);
                prop_assert_eq!(not_alive, model.len() as i64 - expected);
                let due = model.values().filter(|m| is_alive(m)).filter_map(|(l, a)| l.map(|l| a + l)).min();
                prop_assert_eq!(liveness.due(), due);
                prop_assert_eq!(liveness.any_dead(), not_alive > 0);
            }
        }
    }
}
