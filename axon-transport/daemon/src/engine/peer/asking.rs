//! The routes that this host asks a peer for. They follow from the graphs of both hosts.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    rc::Rc,
    time::Duration,
};

use axon_envelope::{Kind, Route, TopicHash};
use axon_shm::{
    ids::Gid,
    qos::{History, Reliability},
};
use axon_transport::{
    access::Verb,
    config::DiscoveryRange,
    graph::{Endpoint, EndpointKind},
    internal::graph::{RangeToHost, out_of_range, verb_of},
};

use super::{
    Peer, PeerContext,
    access::AccessUse,
    routes::{
        asked::AskedRoute,
        refused::{
            NO_STAND_IN, NOT_TAKEN, RefusedSide, TOO_MANY_ASKED, TOO_MANY_LANES, TOO_MANY_WRITERS,
        },
    },
};
use crate::{
    engine::{
        inbound::RouteIn,
        peer::routes::{self, WantedRoute},
        route::RouteKey,
        stand_in::NoStandIn,
    },
    link::{LinkMessage, RouteRefused, RouteSubscriber, Unsubscribe},
};

/// The widest range of a publisher or client that may come, unless its session lists this host.
const SUBNET: RangeToHost = RangeToHost { range: DiscoveryRange::Subnet, lists: false };

impl Peer {
    /// Asks for the routes that follow from the graphs of both hosts.
    pub(super) fn update(&mut self, with: &PeerContext<'_>, now: Duration) {
        if self.stirred {
            return;
        }
        let endpoints = with.local.values().map(|(endpoint, _)| endpoint);
        let publishers = endpoints.filter(|e| e.kind == EndpointKind::Publisher);
        self.alive.watch(publishers.filter_map(|e| e.qos.lease));
        self.answering = self.now_answering();
        let reachable = self.remote.usable().filter(|remote| {
            let e = &remote.endpoint;
            e.kind != EndpointKind::Server || self.answering.contains(&e.gid)
        });
        let own =
            with.local.values().map(|(endpoint, reach)| (&**endpoint, reach.toward(self.daemon)));
        let mut wanted = routes::wanted(own, reachable);
        self.keep_asked(&mut wanted, with);
        let stalls = with.stalls.borrow();
        let blocked = |responses: &RouteKey| stalls.left(&self.identity, responses, now);
        let unanswered = self.unanswered.leave_out(&mut wanted, &self.asked, blocked, now);
        drop(stalls);
        self.want(wanted, &unanswered, with, now);
        for key in &unanswered {
            self.does_not_ask(key, NOT_TAKEN, now);
        }
        self.feed_services(now);
    }

    /// Adds the routes that were asked for earlier, and their subscriptions or servers, as long as these exist here. A
    /// publisher or client may have come to the peer's host that is not in the peer's graph here yet. It is matched there
    /// because the peer still serves the route, so the route must not end because the one before it left. A subscription
    /// or server whose range has no publisher or client of a SUBNET session any more is left out.
    fn keep_asked(&self, wanted: &mut BTreeMap<RouteKey, WantedRoute>, with: &PeerContext<'_>) {
        let most = self.asked.most();
        // A route that is not needed now may take the place of one that is.
        let lacks_room = !self.refused.unserved_without_time(1).is_empty();
        for (key, asked) in self.asked.iter().filter(|(key, _)| key.kind != Kind::Response) {
            let before = wanted.get(key);
            let lacks = |reader: &&RouteSubscriber| {
                let is_wanted = before.is_some_and(|route| route.has_reader(&reader.gid));
                let own = with.local.get(&reader.gid).map(|(_, range)| range.toward(self.daemon));
                !is_wanted && own.is_some_and(|own| out_of_range(own, SUBNET).is_none())
            };
            let readers: Vec<_> = asked.wanted.subscribers.iter().filter(lacks).cloned().collect();
            let has_room = before.is_some()
                || wanted.len() < most && !lacks_room && !self.refused.is_unserved(key);
            if readers.is_empty() || !has_room || !self.may_come_again(key, asked, before) {
                continue;
            }
            let route = wanted.entry(key.clone()).or_default();
            route.subscribers.extend(readers);
            route.subscribers.sort_by_key(|reader| reader.gid);
        }
    }

    /// Returns whether a route lost publishers or clients only because they left, and others may come.
    fn may_come_again(
        &self,
        key: &RouteKey,
        asked: &AskedRoute,
        wanted: Option<&WantedRoute>,
    ) -> bool {
        let is_wanted = |gid: &Gid| wanted.is_some_and(|route| route.has_writer(gid));
        let writers = asked.wanted.writers.iter().map(|(writer, _)| writer.gid);
        let left = writers.filter(|gid| !is_wanted(gid)).all(|gid| self.remote.get(&gid).is_none());
        let verb = if key.kind == Kind::Topic { Verb::Publish } else { Verb::Call };
        left && self.access.denial(verb, &key.topic).is_none()
    }

    /// Returns whether the peer's servers that get requests of this host changed since the last
    /// [`update`](Self::update). With them the routes to ask for change.
    pub(super) fn services_changed(&self) -> bool {
        self.answering != self.now_answering()
    }

    /// Returns the peer's servers that this host sends requests to. This host asks for their responses.
    fn now_answering(&self) -> BTreeSet<Gid> {
        let services = self.served.services().map(|(_, served)| served);
        let requests = services.filter(|served| served.key.kind == Kind::Request);
        requests.flat_map(|served| served.subscribers.iter().copied()).collect()
    }

    fn want(
        &mut self,
        wanted: BTreeMap<RouteKey, WantedRoute>,
        unanswered: &BTreeSet<RouteKey>,
        with: &PeerContext<'_>,
        now: Duration,
    ) {
        let asked = self.asked.iter().map(|(key, _)| key);
        let gone: Vec<_> = asked.filter(|key| !wanted.contains_key(key)).cloned().collect();
        let known = |key: &RouteKey| wanted.contains_key(key) || unanswered.contains(key);
        self.refused.retain_unasked(known, &mut self.messages);
        let given_up = gone.len();
        for key in gone {
            self.refused.remove_unasked(&key, &mut self.messages);
            self.refused.handle_served(&key);
            if let Some(route) = self.asked.remove(&key) {
                self.inbound.routes().remove(&route);
                self.say(LinkMessage::Unsubscribe(Unsubscribe { route }));
            }
        }
        for (key, wanted) in wanted {
            if !self.asked.has_room_for(&key) {
                self.does_not_ask(&key, TOO_MANY_ASKED, now);
                continue;
            }
            self.want_one(key, wanted, with, now);
        }
        self.inbound.handle_routes();
        if given_up > 0 {
            // Routes that the peer refused may take the place of the given-up routes.
            let instead = self.refused.unserved_without_time(given_up);
            self.ask_again(&instead);
        }
    }

    fn want_one(
        &mut self,
        key: RouteKey,
        wanted: WantedRoute,
        with: &PeerContext<'_>,
        now: Duration,
    ) {
        let known = self.asked.get(&key);
        if known.is_some_and(|asked| asked.wanted == wanted && !asked.incomplete) {
            return;
        }
        let mut asked = match self.asked.take(&key) {
            Some(asked) => asked,
            None => {
                let hash = TopicHash::new(with.config.domain, &key.topic, &key.type_name);
                // No name in the peer's graph is too long.
                let Ok(topic) = hash else { return };
                let room = self.remote.account().writers_of(&key);
                AskedRoute {
                    places: room.nothing(),
                    lanes: self.remote.account().lanes.nothing(),
                    room,
                    number: self.asked.new_number(),
                    route: Route { kind: key.kind, topic },
                    wanted: WantedRoute::default(),
                    incomplete: false,
                    stand_ins: HashMap::new(),
                }
            }
        };
        let writers: HashSet<_> = wanted.writers.iter().map(|(writer, _)| writer.gid).collect();
        asked.stand_ins.retain(|gid, _| writers.contains(gid));
        let gone = asked.places.amount() - asked.stand_ins.len();
        drop(asked.places.split(gone));
        let lanes = asked.stand_ins.len() * with.writers.read_by_stand_in(&key);
        drop(asked.lanes.split(asked.lanes.amount().saturating_sub(lanes)));
        let fresh = self.show(&key, &mut asked, &wanted.writers, with, now);
        if asked.stand_ins.is_empty() && asked.wanted.subscribers.is_empty() {
            return;
        }
        if !asked.incomplete {
            self.refused.remove_unasked(&key, &mut self.messages);
        }
        let changed = asked.wanted.subscribers != wanted.subscribers || fresh;
        if !self.inbound.routes().contains_key(&asked.number) {
            let limits = self.limits(with.config).incoming(&key);
            let route = RouteIn::new(key.topic.as_str().into(), asked.route, limits);
            self.inbound.routes().insert(asked.number, route);
        }
        let Some(route) = self.inbound.routes().get_mut(&asked.number) else { return };
        route.writers.retain(|gid, _| asked.stand_ins.contains_key(gid));
        route.keeps_all = wanted.subscribers.iter().all(|reader| {
            let kept = (Reliability::Reliable, History::KeepAll);
            (reader.qos.reliability, reader.qos.history) == kept
        });
        if key.kind == Kind::Response {
            route.set_clients(wanted.subscribers.iter().map(|client| client.gid));
        }
        if changed {
            let awaited = wanted.writers.iter().filter_map(|(writer, readers)| {
                Some((Rc::clone(asked.stand_ins.get(&writer.gid)?), *readers))
            });
            self.asked.ask_once_attached(asked.number, awaited.collect(), now);
        }
        asked.wanted = wanted;
        self.asked.insert(key, asked);
    }

    /// Opens stand-ins for the writers of a route. Returns whether there are new ones.
    fn show(
        &mut self,
        key: &RouteKey,
        asked: &mut AskedRoute,
        writers: &[(Endpoint, usize)],
        with: &PeerContext<'_>,
        now: Duration,
    ) -> bool {
        let mut fresh = false;
        asked.incomplete = false;
        for (writer, _) in writers {
            if asked.stand_ins.contains_key(&writer.gid) {
                continue;
            }
            let Some(place) = asked.room.charge(1) else {
                self.does_not_ask(key, TOO_MANY_WRITERS, now);
                asked.incomplete = true;
                break;
            };
            let Some(lanes) = asked.lanes.more(with.writers.read_by_stand_in(key)) else {
                self.does_not_ask(key, TOO_MANY_LANES, now);
                asked.incomplete = true;
                break;
            };
            match with.stand_ins.get(with.rings, writer, self.remote.account(), now) {
                Ok(stand_in) => {
                    asked.places.add(place);
                    asked.lanes.add(lanes);
                    asked.stand_ins.insert(writer.gid, stand_in);
                    fresh = true;
                }
                Err(NoStandIn::TooMany) => {
                    self.does_not_ask(key, TOO_MANY_WRITERS, now);
                    asked.incomplete = true;
                    break;
                }
                Err(NoStandIn::Failed(error)) => {
                    asked.incomplete = true;
                    let topic = &key.topic;
                    tracing::error!(topic, error, "could not open a stand-in for a remote writer");
                    self.does_not_ask(key, NO_STAND_IN, now);
                }
            }
        }
        fresh
    }

    /// Asks for the routes whose local readers are attached by now.
    pub(super) fn ask_for_attached(&mut self, now: Duration) {
        let attached = self.asked.take_attached(now);
        let mut changed = false;
        for (number, stand_ins) in attached.stand_ins {
            if let Some(route) = self.inbound.routes().get_mut(&number) {
                route.writers.extend(stand_ins.into_iter().map(|s| (s.gid(), s)));
                changed = true;
            }
        }
        if changed {
            self.inbound.handle_routes();
        }
        attached.messages.into_iter().for_each(|message| self.messages.say(message));
    }

    /// Asks for routes again.
    fn ask_again(&mut self, routes: &[RouteKey]) {
        let messages = routes.iter().filter_map(|key| self.asked.message(key));
        messages.for_each(|message| self.messages.say(message));
    }

    /// Asks again for refused routes whose time has come.
    pub(super) fn ask_again_in_time(&mut self, now: Duration) {
        let due = self.refused.take_due(now);
        self.ask_again(&due);
    }

    /// Asks again for routes whose use the peer denied and now allows.
    pub(super) fn ask_for_allowed(&mut self, uses: &[AccessUse]) {
        let allowed = self.refused.unserved_where(|key| {
            let verb = verb_of(RefusedSide::Peer.waits(key.kind));
            uses.iter().any(|(used, name)| Some(*used) == verb && *name == key.topic)
        });
        self.ask_again(&allowed);
    }

    /// Records that the peer refuses a route.
    pub(super) fn handle_route_refused(&mut self, now: Duration, refused: RouteRefused) {
        let RouteRefused { route, reason, retry_s } = refused;
        let Some(key) = self.asked.key_of(route).cloned() else { return };
        let again = retry_s.map(|seconds| now + Duration::from_secs(seconds.into()));
        self.refused.handle_unserved(now, key, &reason, again);
    }

    /// Records that the peer serves a route.
    pub(super) fn handle_route_ready(&mut self, route: u32) {
        if let Some(key) = self.asked.key_of(route) {
            self.refused.handle_served(key);
        }
    }

    /// Gives up the stand-ins for which there are not enough lanes any more.
    pub(super) fn fit_stand_ins(&mut self, with: &PeerContext<'_>, now: Duration) {
        for key in self.asked.fit_lanes(with.writers) {
            let Some(asked) = self.asked.get(&key) else { continue };
            if let Some(route) = self.inbound.routes().get_mut(&asked.number) {
                route.writers.retain(|gid, _| asked.stand_ins.contains_key(gid));
            }
            self.does_not_ask(&key, TOO_MANY_LANES, now);
            self.inbound.handle_routes();
        }
    }

    /// Records that this host does not ask for a route, or not for all of it.
    fn does_not_ask(&mut self, key: &RouteKey, why: &'static str, now: Duration) {
        self.refused.set_unasked(key, why, now, &mut self.messages);
    }

    /// Checks for responses that the peer does not ask for, and asks again for requests whose time is over.
    pub(super) fn check_unanswered(&mut self, with: &PeerContext<'_>, now: Duration) {
        let reopened = self.unanswered.reopen(now);
        let limit = with.config.link.stalled;
        let mut stalled = Vec::new();
        if self.unanswered.is_due(now) {
            let unasked = self.unasked_responses();
            stalled = self.unanswered.check(&self.asked, &unasked, self.silent, limit, now);
        }
        for (responses, waiting) in &stalled {
            with.stalls.borrow_mut().add(&self.identity, responses, limit, now);
            self.counters.dropped("stalled", *waiting);
        }
        if reopened || !stalled.is_empty() {
            self.update(with, now);
        }
    }

    /// Returns the request routes that this host asked for and whose responses the peer has not asked for. A
    /// request route that the peer refuses to serve is left out.
    fn unasked_responses(&self) -> BTreeSet<RouteKey> {
        let requests = self.asked.iter().filter(|(key, _)| key.kind == Kind::Request);
        // A route without a client has no responses.
        let unasked = requests.filter(|(key, asked)| {
            !asked.stand_ins.is_empty()
                && self.served.number_of(&key.other_way()).is_none()
                && !self.refused.is_unserved(key)
        });
        unasked.map(|(key, _)| key.clone()).collect()
    }
}
