//! The lanes that a peer's relays and stand-ins take: one for each writer of this host that each of them reads.
//!
//! All lanes of all peers are of one session, which has a fixed number of them.

use std::{collections::HashMap, time::Duration};

use axon_envelope::Kind;

use super::{
    LocalEndpoints, Peer, PeerContext,
    refused::TOO_MANY_LANES,
    routes::RouteKey,
    serving::{ASK_AGAIN, missing},
};
use crate::engine::account::Charge;

/// How many writers of this host there are for each route.
#[derive(Debug, Default)]
pub(crate) struct WritersHere(HashMap<RouteKey, usize>);

impl WritersHere {
    /// Counts those among the endpoints of this host.
    pub(crate) fn of(local: &LocalEndpoints) -> Self {
        let mut writers = HashMap::new();
        for key in local.values().filter_map(|(endpoint, _)| RouteKey::of(endpoint)) {
            *writers.entry(key).or_default() += 1;
        }
        Self(writers)
    }

    /// Those that a relay of this route reads. Not all need match with it.
    pub(super) fn of_route(&self, key: &RouteKey) -> usize {
        self.0.get(key).copied().unwrap_or(0)
    }

    /// Those that a stand-in which writes for this route reads: of a topic none, of a service those in the other
    /// direction.
    pub(super) fn read_by_stand_in(&self, key: &RouteKey) -> usize {
        if key.kind == Kind::Topic { 0 } else { self.of_route(&key.other_way()) }
    }
}

/// Has `charge` count `readers` that take `each` lanes. Returns how many of the readers there is room for.
fn fit(charge: &mut Charge, readers: usize, each: usize) -> usize {
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

impl Peer {
    /// The writers of this host changed: relays and stand-ins for which there are not enough lanes any more are given
    /// up.
    pub(super) fn fit_lanes(&mut self, with: &PeerContext<'_>, now: Duration) {
        let mut without = Vec::new();
        for (number, served) in self.served.iter_mut() {
            if served.key.kind != Kind::Topic {
                continue;
            }
            let (each, had) = (with.writers.of_route(&served.key), served.sources.len());
            let fitting = fit(&mut served.lanes, had, each);
            if fitting < had {
                served.sources.truncate(fitting);
                drop(served.relays.split(had - fitting));
                without.push((number, had, served.key.clone(), served.sources.clone()));
            }
        }
        for (number, had, key, sources) in without {
            let why = missing(had - sources.len(), had, TOO_MANY_LANES);
            self.outbound.set_sources(number, sources, now);
            self.refuse(number, &key, why, Some(ASK_AGAIN), now);
        }
        self.fit_stand_ins(with, now);
    }

    fn fit_stand_ins(&mut self, with: &PeerContext<'_>, now: Duration) {
        let mut without = Vec::new();
        for (key, asked) in &mut self.asked {
            let (each, had) = (with.writers.read_by_stand_in(key), asked.stand_ins.len());
            let fitting = fit(&mut asked.lanes, had, each);
            if fitting < had {
                asked.leave(fitting);
                without.push((key.clone(), asked.number));
            }
        }
        for (key, number) in without {
            if let (Some(route), Some(asked)) =
                (self.inbound.routes().get_mut(&number), self.asked.get(&key))
            {
                route.writers.retain(|gid, _| asked.stand_ins.contains_key(gid));
            }
            self.does_not_ask(&key, TOO_MANY_LANES, now);
            self.inbound.handle_routes();
        }
    }
}
