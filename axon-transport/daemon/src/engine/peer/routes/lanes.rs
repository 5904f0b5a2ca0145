//! The lanes of a peer's relays and stand-ins: one for each writer of this host that each of them reads.
//!
//! All lanes of all peers belong to one session, which has a fixed number of them.

use std::collections::HashMap;

use axon_envelope::Kind;

use axon_transport::graph::Endpoint;

use crate::engine::account::Charge;
use crate::engine::route::RouteKey;

/// The number of this host's writers for each route.
#[derive(Debug, Default)]
pub(crate) struct LocalWriterCounts(HashMap<RouteKey, usize>);

impl LocalWriterCounts {
    /// Counts the writers among the endpoints of this host.
    pub(crate) fn of<'a>(local: impl IntoIterator<Item = &'a Endpoint>) -> Self {
        let mut writers = HashMap::new();
        for key in local.into_iter().filter_map(RouteKey::of) {
            *writers.entry(key).or_default() += 1;
        }
        Self(writers)
    }

    /// Returns the number of writers that a relay of this route reads. Some of them may not match it.
    pub(in crate::engine::peer) fn of_route(&self, key: &RouteKey) -> usize {
        self.0.get(key).copied().unwrap_or(0)
    }

    /// Returns the number of writers that a stand-in of this route reads: for a topic none, for a service the writers
    /// in the other direction.
    pub(in crate::engine::peer) fn read_by_stand_in(&self, key: &RouteKey) -> usize {
        if key.kind == Kind::Topic { 0 } else { self.of_route(&key.other_way()) }
    }
}

/// Sets `charge` to the lanes of `readers` that take `each` lanes. Returns the number of readers that fit.
pub(in crate::engine::peer) fn fit(charge: &mut Charge, readers: usize, each: usize) -> usize {
    let mut fitting = readers;
    while let Some(more @ 1..) = (fitting * each).checked_sub(charge.amount()) {
        match charge.more(more) {
            Some(more) => charge.add(more),
            None => fitting -= 1,
        }
    }
    drop(charge.split(charge.amount().saturating_sub(fitting * each)));
    fitting
}
