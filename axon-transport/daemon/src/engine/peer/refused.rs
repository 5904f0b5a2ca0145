//! Routes that do not cross, by name: for status, for the log, and for the peer.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use axon_transport::{internal::log_limit::LogLimit, status::LinkStatus};

use super::Peer;
use crate::{
    engine::peer::routes::RouteKey,
    link::{Message, RouteRefused},
};

/// Names that status lists.
const LISTED: usize = 64;
/// Refused requests of the peer that are remembered.
const REMEMBERED: usize = 8192;
/// Characters of a peer's reason that are shown.
const REASON: usize = 200;

/// Why this side asks for no more routes.
pub(super) const TOO_MANY_ASKED: &str = "the peer serves no more routes than this host has asked \
     for already; fewer topics subscribed to here make room";
/// Why this side asks for no more publishers.
pub(super) const TOO_MANY_WRITERS: &str = "the peer has more publishers and clients for this host \
     than are shown; fewer topics subscribed to here make room";

/// The routes that are refused, and why.
#[derive(Default)]
pub(super) struct RefusedRoutes {
    /// Routes that this side does not ask for.
    unasked: BTreeMap<RouteKey, &'static str>,
    /// Routes that the peer does not serve, and when to ask again.
    unserved: BTreeMap<RouteKey, (String, Option<Duration>)>,
    /// Those of them that are asked for again, by that time.
    again: BTreeSet<(Duration, RouteKey)>,
    /// Routes that the peer asked for and does not get, by its number.
    theirs: BTreeMap<u32, (RouteKey, String)>,
    logged: LogLimit,
}

impl RefusedRoutes {
    /// This side does not ask for a route.
    pub(super) fn unasked(&mut self, key: &RouteKey, why: &'static str) {
        if self.unasked.insert(key.clone(), why).is_none() {
            self.log(key, why);
        }
    }

    /// Keeps the routes that are still wanted.
    pub(super) fn retain_unasked(&mut self, wanted: impl Fn(&RouteKey) -> bool) {
        self.unasked.retain(|key, _| wanted(key));
    }

    /// This side asks for the route after all.
    pub(super) fn asked(&mut self, key: &RouteKey) {
        self.unasked.remove(key);
    }

    fn log(&self, key: &RouteKey, why: &str) {
        if let Some(routes) = self.logged.count(Instant::now()) {
            let topic = &key.topic;
            tracing::warn!(topic, why, routes, "routes are refused; `axon status` names them");
        }
    }

    /// The route is no longer wanted, or the peer serves it.
    pub(super) fn settle(&mut self, key: &RouteKey) {
        self.unasked.remove(key);
        self.served(key);
    }

    /// The peer serves a route, or is not asked for it any more.
    fn served(&mut self, key: &RouteKey) {
        if let Some((_, Some(again))) = self.unserved.remove(key) {
            self.again.remove(&(again, key.clone()));
        }
    }

    /// The peer does not serve a route. It is asked again then, if at all.
    fn unserved(&mut self, key: RouteKey, reason: String, again: Option<Duration>) {
        self.served(&key);
        self.again.extend(again.map(|again| (again, key.clone())));
        self.unserved.insert(key, (reason, again));
    }

    /// The peer no longer wants the route, or gets it.
    pub(super) fn forget(&mut self, number: u32) {
        self.theirs.remove(&number);
    }

    /// When a refused route is asked for again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.again.first().map(|(again, _)| *again)
    }

    fn due(&mut self, now: Duration) -> Vec<RouteKey> {
        let mut due = Vec::new();
        while self.poll_timeout().is_some_and(|again| again <= now) {
            let Some((_, key)) = self.again.pop_first() else { break };
            if let Some((_, again)) = self.unserved.get_mut(&key) {
                *again = None;
            }
            due.push(key);
        }
        due
    }
}

impl Peer {
    /// Refuses a route that the peer asked for. The peer may ask again after `retry`.
    pub(super) fn refuse(
        &mut self,
        number: u32,
        key: &RouteKey,
        reason: String,
        retry: Option<Duration>,
    ) {
        self.say(Message::RouteRefused(RouteRefused {
            route: number,
            reason: reason.clone(),
            retry_s: retry.map(|retry| u32::try_from(retry.as_secs().max(1)).unwrap_or(u32::MAX)),
        }));
        self.refused.log(key, &reason);
        if self.refused.theirs.len() < REMEMBERED {
            self.refused.theirs.insert(number, (key.clone(), reason));
        }
    }

    /// The peer refuses a route.
    pub(super) fn handle_route_refused(&mut self, refused: RouteRefused, now: Duration) {
        let RouteRefused { route, reason, retry_s } = refused;
        let Some(key) = self.numbers.get(&route).cloned() else { return };
        let reason: String = reason.chars().filter(|c| !c.is_control()).take(REASON).collect();
        self.refused.log(&key, &reason);
        let again = retry_s.map(|seconds| now + Duration::from_secs(seconds.into()));
        self.refused.unserved(key, reason, again);
    }

    /// The peer serves a route.
    pub(super) fn handle_route_ready(&mut self, route: u32) {
        if let Some(key) = self.numbers.get(&route) {
            self.refused.served(key);
        }
    }

    /// Asks again for routes whose time has come.
    pub(super) fn ask_again(&mut self, now: Duration) {
        for key in self.refused.due(now) {
            if let Some(asked) = self.asked.get(&key) {
                self.say(asked.message(&key));
            }
        }
    }

    /// So many routes were given up: others that the peer refused may have their place.
    pub(super) fn ask_instead(&mut self, routes: usize) {
        let without = self.refused.unserved.iter().filter(|(_, (_, again))| again.is_none());
        let keys: Vec<_> = without.map(|(key, _)| key.clone()).take(routes).collect();
        for key in keys {
            if let Some(asked) = self.asked.get(&key) {
                self.say(asked.message(&key));
            }
        }
    }

    /// Names the refused routes in the link's status.
    pub(super) fn show_refused(&self, status: &mut LinkStatus) {
        let RefusedRoutes { unasked, unserved, theirs, .. } = &self.refused;
        let unasked = unasked.iter().map(|(key, why)| (key, "not asked for", *why));
        let unserved = unserved.iter().map(|(key, (why, _))| (key, "refused by the peer", &**why));
        let theirs = theirs.values().map(|(key, why)| (key, "refused here", &**why));
        let mut listed = BTreeSet::new();
        // Of thousands nothing but the number is shown.
        for (key, by, why) in unasked.chain(unserved).chain(theirs) {
            if listed.len() < LISTED {
                listed.insert(key);
                status.routes_refused.insert(key.to_string(), format!("{by}: {why}"));
            } else if !listed.contains(key) {
                status.more_routes_refused += 1;
            }
        }
    }
}
