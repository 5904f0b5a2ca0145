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
    /// them reaches them. The wait is short, and there is none on the control thread, without a daemon, or while many
    /// endpoints are created ([`PairWaits`](super::pair_waits::PairWaits)).
    pub(in crate::session) fn await_pairs(&self, own: &Endpoint, matched: impl Fn(&Gid) -> bool) {
        if self.control.get() == Some(&std::thread::current().id()) {
            return;
        }
        if self.core.link.daemon().is_none() {
            return;
        }
        let begun = Instant::now();
        let (due, far) = {
            let waits = self.pair_waits();
            (waits.are_due(begun), waits.are_due_far(begun))
        };
        if !due {
            return;
        }
        let goes = |other: &Endpoint| {
            pairing(own, other) == Pairing::Match || pairing(other, own) == Pairing::Match
        };
        let (mut others, mut waits_far) = (Vec::new(), false);
        for entry in self.state().graph.indexed.counterparts(own) {
            let other = &entry.endpoint;
            let is_far = entry.daemon.is_some();
            if (far || !is_far) && !other.gid.is_of_session_of(&own.gid) && goes(other) {
                others.push(other.gid);
                waits_far |= is_far;
            }
        }
        if others.is_empty() {
            return;
        }
        let there = |other: &Gid| self.state().graph.indexed.contains(other);
        self.wait_changed(PAIRS, || others.iter().all(|other| matched(other) || !there(other)));
        let now = Instant::now();
        self.pair_waits().waited(now - begun, waits_far, now);
    }
}
