//! The routes that this host serves a peer.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    time::Duration,
};

use axon_envelope::Kind;
use axon_shm::ids::Gid;

use super::{
    check_after,
    lanes::{self, LocalWriterCounts},
};
use crate::engine::route::RouteKey;
use crate::{
    engine::{account::Charge, outbound::Source},
    link::RouteReady,
};

/// Longest wait for a writer before a route is reported as ready.
const READY_TIMEOUT: Duration = Duration::from_secs(2);

/// A peer whose route access rules deny asks for it again after this time, unless DENIED reports the permission before.
pub(in crate::engine::peer) const DENIED_AGAIN: Duration = Duration::from_secs(30);
/// Most routes that a peer is served. HELLO states this number. The memory of the routes has its own limit.
pub(crate) const MAX_ROUTES: usize = 1 << 15;

/// A route that was given up because the peer does not read it.
pub(crate) struct StalledRoute {
    /// The topic's name.
    pub(crate) topic: String,
    /// The reason that both hosts show.
    pub(crate) reason: String,
    /// Samples that were lost.
    pub(crate) samples: u64,
}

/// A route that the peer asked for.
pub(in crate::engine::peer) struct ServedRoute {
    pub(in crate::engine::peer) key: RouteKey,
    pub(in crate::engine::peer) subscribers: Vec<Gid>,
    pub(in crate::engine::peer) sources: Vec<Source>,
    pub(in crate::engine::peer) _room: Charge,
    /// Charge of one per relay.
    pub(in crate::engine::peer) relays: Charge,
    /// Charge of one per relay and each publisher here that it may read.
    pub(in crate::engine::peer) lanes: Charge,
    /// The reason for which some of the subscribers get nothing, and the time until the peer may ask again.
    pub(in crate::engine::peer) without: Option<MissingRelay>,
    /// True if the peer asked for it over the link in use.
    pub(in crate::engine::peer) repeated: bool,
}

/// The reason for a missing relay, and the time until a retry.
pub(in crate::engine::peer) type MissingRelay = (String, Option<Duration>);

/// Routes by number and by key.
#[derive(Default)]
pub(in crate::engine::peer) struct ServedRoutes {
    routes: HashMap<u32, ServedRoute>,
    numbers: HashMap<RouteKey, u32>,
    /// The routes of services.
    services: BTreeSet<u32>,
    /// Routes whose readiness is not reported to the peer yet, each with the end of the wait for a writer.
    announcing: BTreeMap<u32, Duration>,
    look_at_announcing: Option<Duration>,
}

impl ServedRoutes {
    pub(in crate::engine::peer) fn len(&self) -> usize {
        self.routes.len()
    }

    pub(in crate::engine::peer) fn get(&self, number: u32) -> Option<&ServedRoute> {
        self.routes.get(&number)
    }

    pub(in crate::engine::peer) fn get_mut(&mut self, number: u32) -> Option<&mut ServedRoute> {
        self.routes.get_mut(&number)
    }

    /// Returns the number of the route with this key.
    pub(in crate::engine::peer) fn number_of(&self, key: &RouteKey) -> Option<u32> {
        self.numbers.get(key).copied()
    }

    pub(in crate::engine::peer) fn iter(&self) -> impl Iterator<Item = (u32, &ServedRoute)> {
        self.routes.iter().map(|(number, served)| (*number, served))
    }

    pub(in crate::engine::peer) fn iter_mut(
        &mut self,
    ) -> impl Iterator<Item = (u32, &mut ServedRoute)> {
        self.routes.iter_mut().map(|(number, served)| (*number, served))
    }

    /// Returns the routes of services, by number.
    pub(in crate::engine::peer) fn services(&self) -> impl Iterator<Item = (u32, &ServedRoute)> {
        self.services.iter().filter_map(|number| Some((*number, self.routes.get(number)?)))
    }

    /// Returns the number of routes of services.
    pub(in crate::engine::peer) fn service_count(&self) -> usize {
        self.services.len()
    }

    /// Returns whether a route belongs to a service.
    pub(in crate::engine::peer) fn is_service(&self, number: u32) -> bool {
        self.services.contains(&number)
    }

    /// Adds a route, in place of the one that [`take`](Self::take) removed.
    pub(in crate::engine::peer) fn insert(&mut self, number: u32, served: ServedRoute) {
        self.numbers.insert(served.key.clone(), number);
        if served.key.kind != Kind::Topic {
            self.services.insert(number);
        }
        self.routes.insert(number, served);
    }

    /// Removes a route so that it can be changed. Its report as ready may still be pending.
    pub(in crate::engine::peer) fn take(&mut self, number: u32) -> Option<ServedRoute> {
        self.services.remove(&number);
        let served = self.routes.remove(&number)?;
        self.numbers.remove(&served.key);
        Some(served)
    }

    /// Removes a route that ends.
    pub(in crate::engine::peer) fn remove(&mut self, number: u32) -> Option<ServedRoute> {
        self.announcing.remove(&number);
        self.take(number)
    }

    /// Gives up the relays of topics for which there are not enough lanes any more, after the writers of this host
    /// changed. Returns the routes that lost some, each with the number of relays that it had.
    pub(in crate::engine::peer) fn fit_lanes(
        &mut self,
        writers: &LocalWriterCounts,
    ) -> Vec<(u32, usize)> {
        let mut shortened = Vec::new();
        for (number, served) in &mut self.routes {
            if served.key.kind != Kind::Topic {
                continue;
            }
            let (each, had) = (writers.of_route(&served.key), served.sources.len());
            let fitting = lanes::fit(&mut served.lanes, had, each);
            if fitting < had {
                served.sources.truncate(fitting);
                drop(served.relays.split(had - fitting));
                shortened.push((*number, had));
            }
        }
        shortened
    }

    /// Schedules the report that a route is ready.
    pub(in crate::engine::peer) fn announce(&mut self, number: u32, now: Duration) {
        self.announcing.insert(number, now + READY_TIMEOUT);
        self.look_at_announcing = Some(now);
    }

    /// Returns when [`take_ready`](Self::take_ready) is due.
    pub(in crate::engine::peer) fn poll_timeout(&self) -> Option<Duration> {
        self.look_at_announcing
    }

    /// Returns the ready routes that were not reported to the peer yet.
    pub(in crate::engine::peer) fn take_ready(&mut self, now: Duration) -> Vec<RouteReady> {
        if self.look_at_announcing.is_none_or(|due| due > now) {
            return Vec::new();
        }
        let mut ready = Vec::new();
        self.announcing.retain(|number, until| {
            let sources = self.routes.get(number).map_or(&[][..], |served| &served.sources);
            let publishers: Vec<Gid> = sources.iter().flat_map(Source::writers).collect();
            let waits = publishers.is_empty() && now < *until;
            if !waits {
                ready.push(RouteReady { route: *number, publishers });
            }
            waits
        });
        let waiting = self.announcing.len();
        self.look_at_announcing = (waiting > 0).then(|| now + check_after(waiting));
        ready
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::account::Accounts;

    fn served(kind: Kind, topic: &str) -> ServedRoute {
        let account = Accounts::new(1 << 20, 1 << 20).of_one("a");
        ServedRoute {
            key: RouteKey { kind, topic: topic.into(), type_name: "T".into() },
            subscribers: Vec::new(),
            sources: Vec::new(),
            _room: account.routes.nothing(),
            relays: account.relays.nothing(),
            lanes: account.lanes.nothing(),
            without: None,
            repeated: true,
        }
    }

    #[test]
    fn a_route_is_found_by_number_and_by_key_until_it_ends() {
        let mut routes = ServedRoutes::default();
        let all = [(1, Kind::Topic, "/t"), (7, Kind::Request, "/s"), (9, Kind::Response, "/s")];
        for (number, kind, topic) in all {
            routes.insert(number, served(kind, topic));
        }
        assert_eq!(routes.services().map(|(number, _)| number).collect::<Vec<_>>(), [7, 9]);
        for (left, (number, kind, topic)) in (0..3).rev().zip(all) {
            let key = served(kind, topic).key;
            assert_eq!(routes.number_of(&key), Some(number));
            assert_eq!(routes.is_service(number), kind != Kind::Topic);
            assert!(routes.remove(number).is_some_and(|served| served.key == key));
            assert!(routes.get(number).is_none() && routes.number_of(&key).is_none());
            assert!(!routes.is_service(number) && routes.remove(number).is_none());
            assert_eq!((routes.len(), routes.service_count()), (left, left.min(2)));
        }
    }

    #[test]
    fn a_route_without_a_writer_is_announced_once_after_its_time() {
        let mut routes = ServedRoutes::default();
        routes.insert(1, served(Kind::Topic, "/t"));
        routes.insert(2, served(Kind::Topic, "/u"));
        let start = Duration::from_secs(5);
        routes.announce(1, start);
        routes.announce(2, start);
        assert_eq!(routes.poll_timeout(), Some(start));
        assert!(routes.take_ready(start).is_empty());
        assert_eq!(routes.poll_timeout(), Some(start + check_after(2)));
        assert!(routes.take_ready(start).is_empty(), "it is not due");
        routes.remove(2);
        let ready = routes.take_ready(start + READY_TIMEOUT);
        assert_eq!(ready, [RouteReady { route: 1, publishers: Vec::new() }]);
        assert_eq!(routes.poll_timeout(), None);
        assert!(routes.take_ready(start + 2 * READY_TIMEOUT).is_empty());
    }
}
