//! Routes that either side refuses, by name: for the status, for the log, and for the peer.

use std::{
    collections::{BTreeMap, BTreeSet},
    rc::Rc,
    time::Duration,
};

use axon_envelope::Kind;
use axon_transport::{graph::EndpointKind, internal::log_limit::LogLimit, status::LinkStatus};

use super::kind_of;
use crate::engine::route::RouteKey;
use crate::{
    bridge::RefusedRoute,
    engine::{
        account::{Charge, Meter},
        peer::control_queue::ControlQueue,
    },
    link::{LinkMessage, RouteRefused, RouteUnasked},
};

/// Most names that status lists.
const MAX_LISTED_ROUTES: usize = 64;
/// Bytes that count for a refused route besides its names and reason.
const ENTRY_BYTES: usize = 200;
/// Most routes of a peer that status shows at the endpoints that wait for them.
const MAX_ROUTES_AT_ENDPOINTS: usize = 1024;
/// Most characters of a peer's reason that are shown.
const MAX_REASON_CHARS: usize = 200;
/// Text for a reason for which there is no room.
const UNREMEMBERED: &str = "too many are refused to remember why";

/// The reason for which this side asks for no more routes.
pub(in crate::engine::peer) const TOO_MANY_ASKED: &str = "the peer serves no more routes than this host has asked \
     for already; fewer topics subscribed to here make room";
/// The reason for which this side asks for no more publishers.
pub(in crate::engine::peer) const TOO_MANY_WRITERS: &str = "the peer has more publishers and clients for this host \
     than are shown; fewer topics subscribed to here make room";

/// The reason for which a relay or a stand-in is not opened.
pub(in crate::engine::peer) const TOO_MANY_LANES: &str = "what a peer reads here takes as many connections to publishers, clients and \
     servers as a peer may have, or all peers";

/// A reason that is remembered.
struct RefusalReason {
    text: String,
    _charge: Option<Charge>,
}

/// The reason for which a publisher or client is not shown, for the peer and for the status.
pub(in crate::engine::peer) const NO_STAND_IN: &str =
    "the subscribers' host could not open a stand-in for a publisher; its log says why";

/// The reason for which requests of a peer are not asked for.
pub(in crate::engine::peer) const NOT_TAKEN: &str = "clients of the service did not take its responses; they are asked again later ([link] stalled_s)";

/// The refused routes, with the reasons.
pub(in crate::engine::peer) struct RefusedRoutes {
    /// The bound on the remembered routes, for all daemon ids of the peer's identity.
    room: Rc<Meter>,
    /// Routes that this side does not ask for.
    unasked: BTreeMap<RouteKey, &'static str>,
    /// Routes that the peer does not ask for, although it could.
    unwanted: BTreeMap<RouteKey, RefusalReason>,
    /// Routes that the peer does not serve, and when to ask again.
    unserved: BTreeMap<RouteKey, (RefusalReason, Option<Duration>)>,
    /// Unserved routes that are asked for again, by the time of the next request.
    again: BTreeSet<(Duration, RouteKey)>,
    /// Routes that the peer asked for and does not get, by the peer's number.
    theirs: BTreeMap<u32, (RouteKey, RefusalReason)>,
    logged: LogLimit,
}

impl RefusedRoutes {
    /// Creates an empty list. `room` bounds the remembered routes.
    pub(in crate::engine::peer) fn new(room: Rc<Meter>) -> Self {
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

    /// Returns the reason with the charge for remembering it; `None` if there is no room.
    fn remember(&self, key: &RouteKey, text: String) -> Option<RefusalReason> {
        let charge = self.room.charge(ENTRY_BYTES + key.bytes() + text.len())?;
        Some(RefusalReason { text, _charge: Some(charge) })
    }

    fn log(&self, key: &RouteKey, why: &str, now: Duration) {
        if let Some(routes) = self.logged.count(now) {
            let topic = &key.topic;
            tracing::warn!(topic, why, routes, "routes are refused; `axon status` names them");
        }
    }

    /// Records that this side does not ask for a route, or not for all of it, and tells the peer why.
    pub(in crate::engine::peer) fn set_unasked(
        &mut self,
        key: &RouteKey,
        why: &'static str,
        now: Duration,
        messages: &mut ControlQueue,
    ) {
        if self.unasked.insert(key.clone(), why) != Some(why) {
            self.log(key, why, now);
            messages.say(unasked(key, Some(why)));
        }
    }

    /// Records that this side asks for a route after all, or has no use for it.
    pub(in crate::engine::peer) fn remove_unasked(
        &mut self,
        key: &RouteKey,
        messages: &mut ControlQueue,
    ) {
        if self.unasked.remove(key).is_some() {
            messages.say(unasked(key, None));
        }
    }

    /// Records that this side has no use for other routes than these.
    pub(in crate::engine::peer) fn retain_unasked(
        &mut self,
        wanted: impl Fn(&RouteKey) -> bool,
        messages: &mut ControlQueue,
    ) {
        let gone: Vec<_> = self.unasked.keys().filter(|key| !wanted(key)).cloned().collect();
        gone.iter().for_each(|key| self.remove_unasked(key, messages));
    }

    /// Repeats the messages over a new link, because messages over the earlier link may not have been received.
    pub(in crate::engine::peer) fn succeed(&mut self, messages: &mut ControlQueue) {
        self.unwanted.clear();
        let again = self.unasked.iter().map(|(key, why)| unasked(key, Some(*why)));
        again.for_each(|message| messages.say(message));
    }

    /// Records that the peer does not ask for a route, or asks for it after all.
    pub(in crate::engine::peer) fn handle_route_unasked(
        &mut self,
        now: Duration,
        message: RouteUnasked,
    ) {
        let RouteUnasked { topic, type_name, kind, reason } = message;
        let Some(kind) = kind_of(kind) else { return };
        let key = RouteKey { kind, topic, type_name };
        self.unwanted.remove(&key);
        if let Some(reason) = reason {
            let reason = shown(&reason);
            self.log(&key, &reason, now);
            let reason = self.remember(&key, reason);
            self.unwanted.extend(reason.map(|reason| (key, reason)));
        }
    }

    /// Refuses a route that the peer asked for. The peer may ask again after `retry`.
    pub(in crate::engine::peer) fn refuse(
        &mut self,
        number: u32,
        key: &RouteKey,
        reason: String,
        retry: Option<Duration>,
        now: Duration,
        messages: &mut ControlQueue,
    ) {
        messages.say(LinkMessage::RouteRefused(RouteRefused {
            route: number,
            reason: reason.clone(),
            retry_s: retry.map(|retry| u32::try_from(retry.as_secs().max(1)).unwrap_or(u32::MAX)),
        }));
        self.log(key, &reason, now);
        self.theirs.remove(&number);
        let reason = self.remember(key, reason);
        self.theirs.extend(reason.map(|reason| (number, (key.clone(), reason))));
    }

    /// Forgets a refused route that the peer no longer wants, or gets.
    pub(in crate::engine::peer) fn forget(&mut self, number: u32) {
        self.theirs.remove(&number);
    }

    /// Records that the peer refuses to serve a route, and when to ask again, if at all.
    pub(in crate::engine::peer) fn handle_unserved(
        &mut self,
        now: Duration,
        key: RouteKey,
        reason: &str,
        again: Option<Duration>,
    ) {
        let reason = shown(reason);
        self.log(&key, &reason, now);
        self.handle_served(&key);
        self.again.extend(again.map(|again| (again, key.clone())));
        let unremembered = || RefusalReason { text: UNREMEMBERED.into(), _charge: None };
        let reason = self.remember(&key, reason).unwrap_or_else(unremembered);
        self.unserved.insert(key, (reason, again));
    }

    /// Records that the peer serves a route, or is not asked for it any more.
    pub(in crate::engine::peer) fn handle_served(&mut self, key: &RouteKey) {
        if let Some((_, Some(again))) = self.unserved.remove(key) {
            self.again.remove(&(again, key.clone()));
        }
    }

    /// Returns whether the peer refuses to serve a route.
    pub(in crate::engine::peer) fn is_unserved(&self, key: &RouteKey) -> bool {
        self.unserved.contains_key(key)
    }

    /// Returns the routes that the peer refuses to serve and for which this is true.
    pub(in crate::engine::peer) fn unserved_where(
        &self,
        is_meant: impl Fn(&RouteKey) -> bool,
    ) -> Vec<RouteKey> {
        self.unserved.keys().filter(|key| is_meant(key)).cloned().collect()
    }

    /// Returns up to `most` routes that the peer refuses to serve without saying when to ask again.
    pub(in crate::engine::peer) fn unserved_without_time(&self, most: usize) -> Vec<RouteKey> {
        let without = self.unserved.iter().filter(|(_, (_, again))| again.is_none());
        without.map(|(key, _)| key.clone()).take(most).collect()
    }

    /// Returns when a refused route is asked for again.
    pub(in crate::engine::peer) fn poll_timeout(&self) -> Option<Duration> {
        self.again.first().map(|(again, _)| *again)
    }

    /// Takes the routes that the peer is to be asked for again now.
    pub(in crate::engine::peer) fn take_due(&mut self, now: Duration) -> Vec<RouteKey> {
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

    /// Returns each refused route, with the host that refuses it and the reason.
    fn all(&self) -> impl Iterator<Item = (&RouteKey, RefusedSide, &str)> {
        let Self { unasked, unwanted, unserved, theirs, .. } = self;
        let unasked = unasked.iter().map(|(key, why)| (key, RefusedSide::NotAsked, *why));
        let unserved = unserved.iter().map(|(key, (why, _))| (key, RefusedSide::Peer, &*why.text));
        let theirs = theirs.values().map(|(key, why)| (key, RefusedSide::Here, &*why.text));
        let unwanted =
            unwanted.iter().map(|(key, why)| (key, RefusedSide::NotAskedByPeer, &*why.text));
        unasked.chain(unserved).chain(theirs).chain(unwanted)
    }

    /// Adds the refused routes to the link's status.
    pub(in crate::engine::peer) fn fill(&self, status: &mut LinkStatus) {
        let mut listed = BTreeSet::new();
        // Beyond the limit the status shows only the number.
        for (key, by, why) in self.all() {
            if listed.len() < MAX_LISTED_ROUTES {
                listed.insert(key);
                status.routes_refused.insert(key.to_string(), format!("{}: {why}", by.text()));
            } else if !listed.contains(key) {
                status.more_routes_refused += 1;
            }
        }
    }

    /// Returns the refused routes for the status of the endpoints that wait for them.
    pub(in crate::engine::peer) fn at_endpoints(&self) -> impl Iterator<Item = RefusedRoute> {
        self.all().take(MAX_ROUTES_AT_ENDPOINTS).map(|(key, by, why)| RefusedRoute {
            topic: key.topic.clone(),
            type_name: Some(key.type_name.clone()),
            waits: by.waits(key.kind),
            reason: format!("{}: {why}", by.text()),
        })
    }

    /// Returns the bytes of names and reasons.
    #[cfg(test)]
    pub(in crate::engine::peer) fn held(&self) -> usize {
        let theirs = self.theirs.values().map(|(key, why)| (key, why));
        let all = theirs.chain(&self.unwanted);
        all.map(|(key, why)| key.bytes() + why.text.len()).sum()
    }
}

/// The side that prevents a route.
#[derive(Clone, Copy)]
pub(in crate::engine::peer) enum RefusedSide {
    /// The reading side is this host.
    NotAsked,
    /// The peer, which writes.
    Peer,
    /// The writing side is this host.
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

    /// Returns the kind of this host's endpoints that wait for the route.
    pub(in crate::engine::peer) fn waits(self, kind: Kind) -> EndpointKind {
        let reads = matches!(self, Self::NotAsked | Self::Peer);
        match (kind, reads) {
            (Kind::Topic, true) => EndpointKind::Subscription,
            (Kind::Topic, false) => EndpointKind::Publisher,
            (Kind::Request, true) | (Kind::Response, false) => EndpointKind::Server,
            (Kind::Request, false) | (Kind::Response, true) => EndpointKind::Client,
        }
    }
}

/// Returns a peer's reason as it is shown.
pub(in crate::engine::peer) fn shown(reason: &str) -> String {
    reason.chars().filter(|c| !c.is_control()).take(MAX_REASON_CHARS).collect()
}

fn unasked(key: &RouteKey, reason: Option<&str>) -> LinkMessage {
    LinkMessage::RouteUnasked(RouteUnasked {
        topic: key.topic.clone(),
        type_name: key.type_name.clone(),
        kind: key.kind as u8,
        reason: reason.map(str::to_owned),
    })
}
