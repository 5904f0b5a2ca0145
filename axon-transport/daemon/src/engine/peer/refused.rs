//! Routes that do not cross, by name: for status, for the log, and for the peer.

use std::{
    collections::{BTreeMap, BTreeSet},
    rc::Rc,
    time::Duration,
};

use axon_envelope::Kind;
use axon_transport::{
    graph::EndpointKind,
    internal::{graph::verb_of, log_limit::LogLimit},
    status::LinkStatus,
};

use super::{Peer, access::AccessUse, serving::kind_of};
use crate::{
    bridge::RefusedRoute,
    engine::{
        account::{Charge, Meter},
        peer::routes::RouteKey,
    },
    link::{LinkMessage, RouteRefused, RouteUnasked},
};

/// Names that status lists.
const LISTED: usize = 64;
/// Bytes that count for a refused route besides its names and reason.
const ENTRY: usize = 200;
/// Routes of a peer that status shows at the endpoints that wait for them.
const AT_ENDPOINTS: usize = 1024;
/// Characters of a peer's reason that are shown.
const REASON: usize = 200;
/// What is shown where there is no room for a reason.
const UNREMEMBERED: &str = "too many are refused to remember why";

/// Why this side asks for no more routes.
pub(super) const TOO_MANY_ASKED: &str = "the peer serves no more routes than this host has asked \
     for already; fewer topics subscribed to here make room";
/// Why this side asks for no more publishers.
pub(super) const TOO_MANY_WRITERS: &str = "the peer has more publishers and clients for this host \
     than are shown; fewer topics subscribed to here make room";

/// Why a relay or a stand-in is not opened.
pub(super) const TOO_MANY_LANES: &str = "what a peer reads here takes as many connections to publishers, clients and \
     servers as a peer may have, or all peers";

/// A reason that is remembered.
struct RefusalReason {
    text: String,
    _charge: Option<Charge>,
}

/// Why a publisher or client is not shown, for the peer and for status.
pub(super) const NO_STAND_IN: &str =
    "the subscribers' host could not open a stand-in for a publisher; its log says why";

/// Why requests of a peer are not asked for.
pub(super) const NOT_TAKEN: &str = "clients of the service did not take its responses; they are asked again later ([link] stalled_s)";

/// The routes that are refused, and why.
pub(super) struct RefusedRoutes {
    /// What may be remembered, of all daemon ids of the peer's identity.
    room: Rc<Meter>,
    /// Routes that this side does not ask for.
    unasked: BTreeMap<RouteKey, &'static str>,
    /// Routes that the peer does not ask for, though it could.
    unwanted: BTreeMap<RouteKey, RefusalReason>,
    /// Routes that the peer does not serve, and when to ask again.
    unserved: BTreeMap<RouteKey, (RefusalReason, Option<Duration>)>,
    /// Those of them that are asked for again, by that time.
    again: BTreeSet<(Duration, RouteKey)>,
    /// Routes that the peer asked for and does not get, by its number.
    theirs: BTreeMap<u32, (RouteKey, RefusalReason)>,
    logged: LogLimit,
}

impl RefusedRoutes {
    /// None yet.
    pub(super) fn new(room: Rc<Meter>) -> Self {
        Self {
            room,
            unasked: BTreeMap::new(),
            unwanted: BTreeMap::new(),
            unserved: BTreeMap::new(),
            again: BTreeSet::new(),
            theirs: BTreeMap::new(),
            logged: LogLimit::default(),
        }
    }

    /// A reason with what it takes to remember it; `None`: there is no room.
    fn remember(&self, key: &RouteKey, text: String) -> Option<RefusalReason> {
        let charge = self.room.charge(ENTRY + key.bytes() + text.len())?;
        Some(RefusalReason { text, _charge: Some(charge) })
    }

    fn log(&self, key: &RouteKey, why: &str, now: Duration) {
        if let Some(routes) = self.logged.count(now) {
            let topic = &key.topic;
            tracing::warn!(topic, why, routes, "routes are refused; `axon status` names them");
        }
    }

    /// The peer serves a route, or is not asked for it any more.
    pub(super) fn served(&mut self, key: &RouteKey) {
        if let Some((_, Some(again))) = self.unserved.remove(key) {
            self.again.remove(&(again, key.clone()));
        }
    }

    /// The peer does not serve a route. It is asked again then, if at all.
    fn unserved(&mut self, key: RouteKey, reason: String, again: Option<Duration>) {
        self.served(&key);
        self.again.extend(again.map(|again| (again, key.clone())));
        let unremembered = || RefusalReason { text: UNREMEMBERED.into(), _charge: None };
        let reason = self.remember(&key, reason).unwrap_or_else(unremembered);
        self.unserved.insert(key, (reason, again));
    }

    /// The peer asked for a route and does not get it.
    fn refused(&mut self, number: u32, key: &RouteKey, reason: String) {
        self.theirs.remove(&number);
        let reason = self.remember(key, reason);
        self.theirs.extend(reason.map(|reason| (number, (key.clone(), reason))));
    }

    /// The peer no longer wants the route, or gets it.
    pub(super) fn forget(&mut self, number: u32) {
        self.theirs.remove(&number);
    }

    /// Bytes of names and reasons.
    #[cfg(test)]
    pub(super) fn held(&self) -> usize {
        let theirs = self.theirs.values().map(|(key, why)| (key, why));
        let all = theirs.chain(&self.unwanted);
        all.map(|(key, why)| key.bytes() + why.text.len()).sum()
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
    /// This side does not ask for a route, or not for all of it. The peer is told why.
    pub(super) fn does_not_ask(&mut self, key: &RouteKey, why: &'static str, now: Duration) {
        if self.refused.unasked.insert(key.clone(), why) != Some(why) {
            self.refused.log(key, why, now);
            self.say(unasked(key, Some(why)));
        }
    }

    /// Whether the peer refuses to serve a route.
    pub(super) fn is_refused(&self, key: &RouteKey) -> bool {
        self.refused.unserved.contains_key(key)
    }

    /// This side asks for the route after all, or has no use for it.
    pub(super) fn asks(&mut self, key: &RouteKey) {
        if self.refused.unasked.remove(key).is_some() {
            self.say(unasked(key, None));
        }
    }

    /// This side has no use for other routes than these.
    pub(super) fn want_no_more(&mut self, wanted: impl Fn(&RouteKey) -> bool) {
        let gone = self.refused.unasked.keys().filter(|key| !wanted(key));
        let gone: Vec<_> = gone.cloned().collect();
        gone.iter().for_each(|key| self.asks(key));
    }

    /// A successor took over, and with it goes what was said and not heard.
    pub(super) fn say_unasked_again(&mut self) {
        self.refused.unwanted.clear();
        let again = self.refused.unasked.iter().map(|(key, why)| unasked(key, Some(*why)));
        let again: Vec<_> = again.collect();
        again.into_iter().for_each(|message| self.say(message));
    }

    /// The peer does not ask for a route, or asks for it after all.
    pub(super) fn handle_route_unasked(&mut self, message: RouteUnasked, now: Duration) {
        let RouteUnasked { topic, type_name, kind, reason } = message;
        let Some(kind) = kind_of(kind) else { return };
        let key = RouteKey { kind, topic, type_name };
        self.refused.unwanted.remove(&key);
        if let Some(reason) = reason {
            let reason = shown(&reason);
            self.refused.log(&key, &reason, now);
            let reason = self.refused.remember(&key, reason);
            self.refused.unwanted.extend(reason.map(|reason| (key, reason)));
        }
    }

    /// Refuses a route that the peer asked for. The peer may ask again after `retry`.
    pub(super) fn refuse(
        &mut self,
        number: u32,
        key: &RouteKey,
        reason: String,
        retry: Option<Duration>,
        now: Duration,
    ) {
        self.say(LinkMessage::RouteRefused(RouteRefused {
            route: number,
            reason: reason.clone(),
            retry_s: retry.map(|retry| u32::try_from(retry.as_secs().max(1)).unwrap_or(u32::MAX)),
        }));
        self.refused.log(key, &reason, now);
        self.refused.refused(number, key, reason);
    }

    /// The peer refuses a route.
    pub(super) fn handle_route_refused(&mut self, refused: RouteRefused, now: Duration) {
        let RouteRefused { route, reason, retry_s } = refused;
        let Some(key) = self.numbers.get(&route).cloned() else { return };
        let reason = shown(&reason);
        self.refused.log(&key, &reason, now);
        let again = retry_s.map(|seconds| now + Duration::from_secs(seconds.into()));
        self.refused.unserved(key, reason, again);
    }

    /// The peer lets this host do what it denied: routes that wait for it are asked for again.
    pub(super) fn ask_for_allowed(&mut self, uses: &[AccessUse]) {
        let keys = self.refused.unserved.keys();
        let allowed = |key: &&RouteKey| {
            let verb = verb_of(RefusedSide::Peer.waits(key.kind));
            uses.iter().any(|(used, name)| Some(*used) == verb && *name == key.topic)
        };
        let keys: Vec<_> = keys.filter(allowed).cloned().collect();
        for key in keys {
            if let Some(asked) = self.asked.get(&key) {
                self.say(asked.message(&key));
            }
        }
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

    /// Each refused route, with the host that refuses it and the reason.
    fn all_refused(&self) -> impl Iterator<Item = (&RouteKey, RefusedSide, &str)> {
        let RefusedRoutes { unasked, unwanted, unserved, theirs, .. } = &self.refused;
        let unasked = unasked.iter().map(|(key, why)| (key, RefusedSide::NotAsked, *why));
        let unserved = unserved.iter().map(|(key, (why, _))| (key, RefusedSide::Peer, &*why.text));
        let theirs = theirs.values().map(|(key, why)| (key, RefusedSide::Here, &*why.text));
        let unwanted =
            unwanted.iter().map(|(key, why)| (key, RefusedSide::NotAskedByPeer, &*why.text));
        unasked.chain(unserved).chain(theirs).chain(unwanted)
    }

    /// Names the refused routes in the link's status.
    pub(super) fn show_refused(&self, status: &mut LinkStatus) {
        let mut listed = BTreeSet::new();
        // Of thousands nothing but the number is shown.
        for (key, by, why) in self.all_refused() {
            if listed.len() < LISTED {
                listed.insert(key);
                status.routes_refused.insert(key.to_string(), format!("{}: {why}", by.text()));
            } else if !listed.contains(key) {
                status.more_routes_refused += 1;
            }
        }
    }

    /// The same for the status of the endpoints that wait.
    pub(in crate::engine) fn refused_routes(&self) -> Vec<RefusedRoute> {
        let refused = self.all_refused().take(AT_ENDPOINTS);
        let refused = refused.map(|(key, by, why)| RefusedRoute {
            topic: key.topic.clone(),
            type_name: Some(key.type_name.clone()),
            waits: by.waits(key.kind),
            reason: format!("{}: {why}", by.text()),
        });
        refused.chain(self.access.refused_routes()).collect()
    }
}

/// Who does not have a route cross.
#[derive(Clone, Copy)]
enum RefusedSide {
    /// This host, which reads.
    NotAsked,
    /// The peer, which writes.
    Peer,
    /// This host, which writes.
    Here,
    /// The peer, which reads.
    NotAskedByPeer,
}

impl RefusedSide {
    fn text(self) -> &'static str {
        match self {
            Self::NotAsked => "not asked for",
            Self::Peer => "refused by the peer",
            Self::Here => "refused here",
            Self::NotAskedByPeer => "not asked for by the peer",
        }
    }

    /// The endpoints of this host that wait for the route.
    fn waits(self, kind: Kind) -> EndpointKind {
        let reads = matches!(self, Self::NotAsked | Self::Peer);
        match (kind, reads) {
            (Kind::Topic, true) => EndpointKind::Subscription,
            (Kind::Topic, false) => EndpointKind::Publisher,
            (Kind::Request, true) | (Kind::Response, false) => EndpointKind::Server,
            (Kind::Request, false) | (Kind::Response, true) => EndpointKind::Client,
        }
    }
}

/// A reason of the peer, as it is shown.
pub(super) fn shown(reason: &str) -> String {
    reason.chars().filter(|c| !c.is_control()).take(REASON).collect()
}

fn unasked(key: &RouteKey, reason: Option<&str>) -> LinkMessage {
    LinkMessage::RouteUnasked(RouteUnasked {
        topic: key.topic.clone(),
        type_name: key.type_name.clone(),
        kind: key.kind as u8,
        reason: reason.map(str::to_owned),
    })
}
