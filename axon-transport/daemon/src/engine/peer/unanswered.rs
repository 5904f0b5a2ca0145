//! Services whose responses a peer does not take. The peer's requests are then not taken for a while either:
//! each would be answered, and servers on this host would wait for room in the ring of its client.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use axon_envelope::Kind;

use super::{
    Peer, PeerContext,
    asking::AskedRoute,
    routes::{RouteKey, WantedRoute},
};
use crate::engine::outbound::UnfinishedFlows;

/// Time between two checks for responses that the peer does not ask for.
const LOOK: Duration = Duration::from_secs(1);
/// The most services with ended routes and unfinished flows that are remembered for a peer. Further ones are
/// not.
const LEFT: usize = 256;

/// The services whose requests or responses a peer does not take.
#[derive(Default)]
pub(super) struct UnansweredServices {
    /// Request routes that the peer is not asked for, each with the end of that time.
    closed: BTreeMap<RouteKey, Duration>,
    /// Routes of services that were given up because the peer did not take their samples.
    stalled: BTreeSet<RouteKey>,
    /// Request routes whose responses wait for the peer to ask for them.
    awaited: BTreeMap<RouteKey, AwaitedResponses>,
    /// Unfinished flows of ended routes, until the peer asks for the routes again.
    left: BTreeMap<RouteKey, UnfinishedFlows>,
    /// When to check for responses that the peer does not ask for.
    look: Option<Duration>,
}

/// Responses that wait for the peer to ask for them.
#[derive(Clone, Copy, Debug)]
struct AwaitedResponses {
    /// Responses that had found no room at the first check.
    refused: u64,
    /// How long the responses have waited since, added up at each check.
    waited: Duration,
}

impl UnansweredServices {
    /// Returns the time of the next check, or of the next request route to ask for again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.closed.values().copied().chain(self.look).min()
    }

    /// Records that a route of a service was given up.
    pub(super) fn handle_stalled(&mut self, route: RouteKey) {
        self.stalled.insert(route);
    }

    /// Stores the unfinished flows of a service's route that ends.
    pub(super) fn leave(&mut self, route: &RouteKey, unfinished: UnfinishedFlows) {
        if !unfinished.is_empty() && self.left.len() < LEFT {
            self.left.insert(route.clone(), unfinished);
        }
        if route.kind == Kind::Response {
            self.look = Some(Duration::ZERO);
        }
    }

    /// Returns the unfinished flows of a service's route that the peer asks for again.
    pub(super) fn go_on(&mut self, route: &RouteKey) -> UnfinishedFlows {
        self.left.remove(route).unwrap_or_default()
    }
}

impl AskedRoute {
    /// Returns how many responses its clients have not taken, and how many more found no room.
    fn responses(&self) -> (u64, u64) {
        let clients = self.stand_ins.values();
        clients.fold((0, 0), |(waiting, refused), client| {
            let (ring, of) = (client.ring(), client.gid());
            (
                waiting + ring.calls_of(&of),
                refused.saturating_add(ring.refused_of(&of).unwrap_or(0)),
            )
        })
    }
}

impl Peer {
    /// Removes from the wanted routes the requests whose responses the peer has not taken lately, and returns
    /// them. Requests that the peer is already asked for stay if another daemon of its host failed to take
    /// the responses.
    pub(super) fn leave_out_unanswered(
        &mut self,
        wanted: &mut BTreeMap<RouteKey, WantedRoute>,
        with: &PeerContext<'_>,
        now: Duration,
    ) -> BTreeSet<RouteKey> {
        let stalls = with.stalls.borrow();
        let stalled = std::mem::take(&mut self.unanswered.stalled);
        let left = |key: &RouteKey| {
            let responses = key.other_way();
            if self.asked.contains_key(key) && !stalled.contains(&responses) {
                return None;
            }
            stalls.left(&self.identity, &responses, now).map(|left| now + left)
        };
        let requests = wanted.keys().filter(|key| key.kind == Kind::Request);
        let closed: BTreeMap<_, _> =
            requests.filter_map(|key| Some((key.clone(), left(key)?))).collect();
        wanted.retain(|key, _| !closed.contains_key(key));
        let keys = closed.keys().cloned().collect();
        self.unanswered.closed = closed;
        self.unanswered.look.get_or_insert(now + LOOK);
        keys
    }

    /// Checks for responses that the peer does not ask for, and asks again for requests whose time is over.
    pub(super) fn look_at_unanswered(&mut self, with: &PeerContext<'_>, now: Duration) {
        let closed = self.unanswered.closed.len();
        self.unanswered.closed.retain(|_, until| *until > now);
        let is_over = self.unanswered.closed.len() < closed;
        let looks = self.unanswered.look.is_some_and(|look| look <= now);
        let mut stalled = false;
        if looks {
            let unasked = self.unasked_responses();
            self.unanswered.look = (!unasked.is_empty()).then(|| now + LOOK);
            stalled = self.find_unasked_responses(&unasked, with, now);
        }
        if is_over || stalled {
            self.update(with, now);
        }
    }

    /// Returns the request routes that this host asked for and whose responses the peer has not asked for. A
    /// request route that the peer refuses to serve is left out.
    fn unasked_responses(&self) -> BTreeSet<RouteKey> {
        let requests = self.asked.keys().filter(|key| key.kind == Kind::Request);
        let unasked = requests.filter(|key| {
            self.served.number_of(&key.other_way()).is_none() && !self.is_refused(key)
        });
        unasked.cloned().collect()
    }

    /// Finds services whose responses have waited for the limit, and left no room for further ones, without
    /// being asked for. The peer then counts as not reading them. A peer that asks for the responses for a
    /// while and takes none continues where it was. Returns whether there was such a service.
    fn find_unasked_responses(
        &mut self,
        unasked: &BTreeSet<RouteKey>,
        with: &PeerContext<'_>,
        now: Duration,
    ) -> bool {
        let before = std::mem::take(&mut self.unanswered.awaited);
        let limit = with.config.link.stalled;
        let mut found = false;
        for (key, asked) in &self.asked {
            let known = before.get(key).copied();
            if key.kind != Kind::Request || known.is_none() && !unasked.contains(key) {
                continue;
            }
            let (waiting, refused) = asked.responses();
            if waiting == 0 {
                continue;
            }
            let mut awaited = known.unwrap_or(AwaitedResponses { refused, waited: Duration::ZERO });
            if refused != awaited.refused && unasked.contains(key) && !self.silent {
                awaited.waited += LOOK;
            }
            if awaited.waited < limit {
                self.unanswered.awaited.insert(key.clone(), awaited);
                continue;
            }
            let responses = key.other_way();
            with.stalls.borrow_mut().add(&self.identity, &responses, limit, now);
            self.counters.dropped("stalled", waiting);
            self.unanswered.stalled.insert(responses);
            found = true;
        }
        found
    }
}
