//! Topics and services of a peer that do not cross, for a bound: by name, for status, log and the peer.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use axon_transport::{internal::log_limit::LogLimit, status::LinkStatus};

use super::{MAX_ROUTES, Peer};
use crate::{
    gateway::routes::RouteKey,
    link::{Message, RouteRefused},
};

/// Names that status lists.
const LISTED: usize = 64;
/// Refused requests of the peer's that are remembered.
const REMEMBERED: usize = 8192;
/// Characters of a peer's reason that are shown.
const REASON: usize = 200;

/// The refusing side and the reason.
#[derive(Default)]
pub(super) struct RefusedRoutes {
    /// What this side does not ask for.
    pub(super) unasked: BTreeMap<RouteKey, &'static str>,
    /// What the peer does not serve, and when to ask again.
    unserved: BTreeMap<RouteKey, (String, Option<Instant>)>,
    /// What the peer asked for and does not get, by its number.
    theirs: BTreeMap<u32, (RouteKey, String)>,
    logged: LogLimit,
}

/// Why this side asks for no more.
pub(super) const TOO_MANY_ASKED: &str = "this host asks a peer for no more routes than it has already; fewer topics subscribed to \
     here make room";
/// Why this side asks for no more publishers.
pub(super) const TOO_MANY_WRITERS: &str = "the peer has more publishers and clients for this host than are shown; fewer topics \
     subscribed to here make room";

impl RefusedRoutes {
    /// This side does not ask for a route.
    pub(super) fn unasked(&mut self, key: &RouteKey, why: &'static str) {
        if self.unasked.insert(key.clone(), why).is_none() {
            self.log(key, why);
        }
    }

    fn log(&self, key: &RouteKey, why: &str) {
        if let Some(routes) = self.logged.count(Instant::now()) {
            let topic = &key.topic;
            tracing::warn!(topic, why, routes, "routes are refused; `axon status` names them");
        }
    }

    /// The route is not wanted any more, or stands.
    pub(super) fn settle(&mut self, key: &RouteKey) {
        self.unasked.remove(key);
        self.unserved.remove(key);
    }

    /// The peer does not ask for this any more.
    pub(super) fn forget(&mut self, number: u32) {
        self.theirs.remove(&number);
    }

    /// Those that the peer refused and that may be asked for again.
    fn due(&mut self, now: Instant) -> Vec<RouteKey> {
        let due = self.unserved.iter_mut().filter_map(|(key, (_, again))| {
            (*again).filter(|again| *again <= now)?;
            *again = None;
            Some(key.clone())
        });
        due.collect()
    }
}

impl Peer {
    /// Refuses a route that the peer asked for: by name, and nothing else changes.
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

    /// The peer does not serve a route that this side asked for.
    pub(in crate::gateway) fn route_refused(&mut self, refused: RouteRefused) {
        let RouteRefused { route, reason, retry_s } = refused;
        let Some(key) = self.asked_as(route) else { return };
        let reason: String = reason.chars().filter(|c| !c.is_control()).take(REASON).collect();
        self.refused.log(&key, &reason);
        let again = retry_s.map(|seconds| Instant::now() + Duration::from_secs(seconds.into()));
        self.refused.unserved.insert(key, (reason, again));
    }

    /// The peer serves this route.
    pub(in crate::gateway) fn route_ready(&mut self, route: u32) {
        if let Some(key) = self.asked_as(route) {
            self.refused.unserved.remove(&key);
        }
    }

    /// Asks again for what the peer refused for a while.
    pub(in crate::gateway) fn ask_again(&mut self, now: Instant) {
        for key in self.refused.due(now) {
            if let Some(asked) = self.asked.get(&key) {
                self.say(asked.message(&key));
            }
        }
    }

    /// Some that the peer refused, as there may be room there: it serves fewer of the others now.
    pub(super) fn ask_instead(&mut self, routes: usize) {
        let without = self.refused.unserved.iter().filter(|(_, (_, again))| again.is_none());
        let keys: Vec<_> = without.map(|(key, _)| key.clone()).take(routes).collect();
        for key in keys {
            if let Some(asked) = self.asked.get(&key) {
                self.say(asked.message(&key));
            }
        }
    }

    /// Puts what is refused into `status`.
    pub(in crate::gateway) fn show_refused(&self, status: &mut LinkStatus) {
        let RefusedRoutes { unasked, unserved, theirs, .. } = &self.refused;
        let unasked = unasked.iter().map(|(key, why)| (key, format!("not asked for: {why}")));
        let unserved =
            unserved.iter().map(|(key, (why, _))| (key, format!("refused by the peer: {why}")));
        let theirs = theirs.values().map(|(key, why)| (key, format!("refused here: {why}")));
        for (key, why) in unasked.chain(unserved).chain(theirs) {
            if status.routes_refused.len() < LISTED {
                status.routes_refused.insert(key.to_string(), why);
            } else if !status.routes_refused.contains_key(&key.to_string()) {
                status.more_routes_refused += 1;
            }
        }
    }

    /// Why a further route of the peer's is refused, if so.
    pub(super) fn has_too_many_routes(&self) -> Option<String> {
        let full = self.served.len() >= MAX_ROUTES;
        full.then(|| format!("a peer is served {MAX_ROUTES} routes at most, and has them"))
    }

    fn asked_as(&self, route: u32) -> Option<RouteKey> {
        self.asked.iter().find(|(_, asked)| asked.number == route).map(|(key, _)| key.clone())
    }
}
