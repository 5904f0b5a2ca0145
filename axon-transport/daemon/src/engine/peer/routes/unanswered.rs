//! Services whose responses a peer does not take. The peer's requests are then not taken for a while either:
//! each would be answered, and servers on this host would wait for room in the ring of its client.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use axon_envelope::Kind;

use super::{WantedRoute, asked::AskedRoutes};
use crate::engine::outbound::UnfinishedFlows;
use crate::engine::route::RouteKey;

/// Time between two checks for responses that the peer does not ask for.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The most services with ended routes and unfinished flows that are remembered for a peer. Further ones are
/// not.
const MAX_UNFINISHED_SERVICES: usize = 256;

/// The services whose requests or responses a peer does not take.
#[derive(Default)]
pub(in crate::engine::peer) struct UnansweredServices {
    /// Request routes that the peer is not asked for, each with the end of that time.
    closed: BTreeMap<RouteKey, Duration>,
    /// Routes of services that were given up because the peer did not take their samples.
    stalled: BTreeSet<RouteKey>,
    /// Request routes whose responses wait for the peer to ask for them.
    awaited: BTreeMap<RouteKey, AwaitedResponses>,
    /// Unfinished flows of ended routes, until the peer asks for the routes again.
    left: BTreeMap<RouteKey, UnfinishedFlows>,
    /// The time of the next check for responses that the peer does not ask for.
    look: Option<Duration>,
}

/// Responses that wait for the peer to ask for them.
#[derive(Clone, Copy, Debug)]
struct AwaitedResponses {
    /// Responses that had found no room at the first check.
    refused: u64,
    /// The time that the responses have waited since, added up at each check.
    waited: Duration,
}

impl UnansweredServices {
    /// Returns the time of the next check, or of the next request route to ask for again.
    pub(in crate::engine::peer) fn poll_timeout(&self) -> Option<Duration> {
        self.closed.values().copied().chain(self.look).min()
    }

    /// Records that a route of a service was given up.
    pub(in crate::engine::peer) fn handle_stalled(&mut self, route: RouteKey) {
        self.stalled.insert(route);
    }

    /// Stores the unfinished flows of a service's route that ends.
    pub(in crate::engine::peer) fn leave(&mut self, route: &RouteKey, unfinished: UnfinishedFlows) {
        if !unfinished.is_empty() && self.left.len() < MAX_UNFINISHED_SERVICES {
            self.left.insert(route.clone(), unfinished);
        }
        if route.kind == Kind::Response {
            self.look = Some(Duration::ZERO);
        }
    }

    /// Returns the unfinished flows of a service's route that the peer asks for again.
    pub(in crate::engine::peer) fn go_on(&mut self, route: &RouteKey) -> UnfinishedFlows {
        self.left.remove(route).unwrap_or_default()
    }

    /// Removes from the wanted routes the requests whose responses the peer has not taken lately, and returns
    /// them. `blocked` returns for how long responses are not to be asked for. Requests that the peer is already
    /// asked for stay if another daemon of its host failed to take the responses.
    pub(in crate::engine::peer) fn leave_out(
        &mut self,
        wanted: &mut BTreeMap<RouteKey, WantedRoute>,
        asked: &AskedRoutes,
        blocked: impl Fn(&RouteKey) -> Option<Duration>,
        now: Duration,
    ) -> BTreeSet<RouteKey> {
        let stalled = std::mem::take(&mut self.stalled);
        let left = |key: &RouteKey| {
            let responses = key.other_way();
            if asked.get(key).is_some() && !stalled.contains(&responses) {
                return None;
            }
            blocked(&responses).map(|left| now + left)
        };
        let requests = wanted.keys().filter(|key| key.kind == Kind::Request);
        let closed: BTreeMap<_, _> =
            requests.filter_map(|key| Some((key.clone(), left(key)?))).collect();
        wanted.retain(|key, _| !closed.contains_key(key));
        let keys = closed.keys().cloned().collect();
        self.closed = closed;
        self.look.get_or_insert(now + CHECK_INTERVAL);
        keys
    }

    /// Forgets the request routes whose time is over. Returns whether there were any.
    pub(in crate::engine::peer) fn reopen(&mut self, now: Duration) -> bool {
        let closed = self.closed.len();
        self.closed.retain(|_, until| *until > now);
        self.closed.len() < closed
    }

    /// Returns whether [`check`](Self::check) is due.
    pub(in crate::engine::peer) fn is_due(&self, now: Duration) -> bool {
        self.look.is_some_and(|look| look <= now)
    }

    /// Finds services whose responses have waited for the limit, and left no room for further ones, without
    /// being asked for: `unasked` are the requests of such services. The peer then counts as not reading them. A
    /// peer that asks for the responses for a while and takes none continues where it was. Returns the routes of
    /// the responses, each with the number of responses that wait.
    pub(in crate::engine::peer) fn check(
        &mut self,
        asked: &AskedRoutes,
        unasked: &BTreeSet<RouteKey>,
        is_silent: bool,
        limit: Duration,
        now: Duration,
    ) -> Vec<(RouteKey, u64)> {
        self.look = (!unasked.is_empty()).then(|| now + CHECK_INTERVAL);
        let before = std::mem::take(&mut self.awaited);
        let mut found = Vec::new();
        for (key, route) in asked.iter() {
            let known = before.get(key).copied();
            if key.kind != Kind::Request || known.is_none() && !unasked.contains(key) {
                continue;
            }
            let (waiting, refused) = route.responses();
            if waiting == 0 {
                continue;
            }
            let mut awaited = known.unwrap_or(AwaitedResponses { refused, waited: Duration::ZERO });
            if refused != awaited.refused && unasked.contains(key) && !is_silent {
                awaited.waited += CHECK_INTERVAL;
            }
            if awaited.waited < limit {
                self.awaited.insert(key.clone(), awaited);
                continue;
            }
            let responses = key.other_way();
            self.stalled.insert(responses.clone());
            found.push((responses, waiting));
        }
        found
    }
}
