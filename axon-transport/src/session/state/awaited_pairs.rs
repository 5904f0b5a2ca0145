//! Makes new endpoints wait for the endpoints that they are matched with.

use std::time::{Duration, Instant};

use super::SessionShared;
use crate::{
    graph::{Endpoint, Pairing, pairing},
    ids::Gid,
};

/// Maximum time that a new endpoint waits.
const PAIRS: Duration = Duration::from_millis(50);

impl SessionShared {
    /// Waits until a new endpoint is matched with all compatible endpoints that the graph shows: a caller that counts
    /// them reaches them. The wait is short, and there is none on the control thread or without a daemon. Endpoints of
    /// other hosts are not awaited while many endpoints are created ([`PairWaits`](super::pair_waits::PairWaits)).
    pub(in crate::session) fn await_pairs(&self, own: &Endpoint, matched: impl Fn(&Gid) -> bool) {
        if self.control.get() == Some(&std::thread::current().id()) {
            return;
        }
        let goes = |other: &Endpoint| {
            pairing(own, other) == Pairing::Match || pairing(other, own) == Pairing::Match
        };
        if self.core.link.daemon().is_none() {
            return;
        }
        let graph = self.state().graph.view.clone();
        let begun = Instant::now();
        let far = self.pair_waits().are_due(begun);
        let foreign = graph.endpoints.values().filter(|entry| {
            let other = &entry.endpoint;
            (far || entry.daemon.is_none()) && !other.gid.is_of_session_of(&own.gid) && goes(other)
        });
        let (mut others, mut waits_far) = (Vec::new(), false);
        for entry in foreign {
            others.push(entry.endpoint.gid);
            waits_far |= entry.daemon.is_some();
        }
        drop(graph);
        let there = |other: &Gid| self.state().graph.view.endpoints.contains_key(other);
        self.wait_changed(PAIRS, || others.iter().all(|other| matched(other) || !there(other)));
        if waits_far {
            let now = Instant::now();
            self.pair_waits().waited(now - begun, now);
        }
    }
}
