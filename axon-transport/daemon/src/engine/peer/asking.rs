//! The routes that this host asks a peer for.

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
use axon_transport::graph::{Endpoint, EndpointKind};

use super::{
    Peer, PeerContext, poll_after,
    refused::{NO_STAND_IN, NOT_TAKEN, TOO_MANY_ASKED, TOO_MANY_LANES, TOO_MANY_WRITERS},
};
use crate::{
    engine::{
        account::{Charge, Meter},
        inbound::RouteIn,
        peer::routes::{self, RouteKey, WantedRoute},
        stand_in::{NoStandIn, StandIn},
    },
    link::{LastSeen, LinkMessage, Subscribe, Unsubscribe},
};

/// The peer is asked for a route once the local readers are attached, or after this time.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(1);

/// A route that this host asked for.
pub(super) struct AskedRoute {
    pub(super) number: u32,
    route: Route,
    /// The readers and writers that it was last asked for.
    wanted: WantedRoute,
    /// Whether a writer of it is not shown.
    incomplete: bool,
    pub(super) stand_ins: HashMap<Gid, Rc<StandIn>>,
    /// One for each stand-in, of what the route may show of the peer's identity.
    places: Charge,
    /// One for each stand-in and each writer here that it may read.
    pub(super) lanes: Charge,
    room: Rc<Meter>,
}

/// A route whose local readers are not all attached.
pub(super) struct Attaching {
    until: Duration,
    awaited: Vec<(Rc<StandIn>, usize)>,
}

impl AskedRoute {
    /// Keeps so many of its stand-ins, and gives up the others until there are lanes for them again.
    pub(super) fn leave(&mut self, stand_ins: usize) {
        let mut left = stand_ins;
        self.stand_ins.retain(|_, _| {
            left.checked_sub(1).is_some_and(|less| {
                left = less;
                true
            })
        });
        let gone = self.places.amount().saturating_sub(self.stand_ins.len());
        drop(self.places.split(gone));
        self.incomplete = true;
    }

    /// Asks for it.
    pub(super) fn message(&self, key: &RouteKey) -> LinkMessage {
        let last = self.stand_ins.iter().filter_map(|(gid, stand_in)| {
            Some(LastSeen { publisher: *gid, sequence: stand_in.last_sequence()? })
        });
        LinkMessage::Subscribe(Subscribe {
            route: self.number,
            topic: key.topic.clone(),
            type_name: key.type_name.clone(),
            kind: key.kind as u8,
            subscribers: self.wanted.subscribers.clone(),
            last: last.collect(),
            acknowledges: Some(true),
            short_headers: Some(key.kind == Kind::Topic),
        })
    }
}

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
        let unanswered = self.leave_out_unanswered(&mut wanted, with, now);
        self.want(wanted, &unanswered, with, now);
        for key in &unanswered {
            self.does_not_ask(key, NOT_TAKEN, now);
        }
        self.feed_services(now);
    }

    /// Whether the routes of services that the peer asked for changed, and with them those that are asked for here.
    pub(super) fn services_changed(&self) -> bool {
        self.answering != self.now_answering()
    }

    /// The servers of the peer to which requests of this host go: their responses are wanted.
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
        let gone: Vec<_> = self.asked.keys().filter(|k| !wanted.contains_key(k)).cloned().collect();
        self.want_no_more(|key| wanted.contains_key(key) || unanswered.contains(key));
        let given_up = gone.len();
        for key in gone {
            self.asks(&key);
            self.refused.served(&key);
            if let Some(asked) = self.asked.remove(&key) {
                self.numbers.remove(&asked.number);
                self.attaching.remove(&asked.number);
                self.inbound.routes().remove(&asked.number);
                self.say(LinkMessage::Unsubscribe(Unsubscribe { route: asked.number }));
            }
        }
        for (key, wanted) in wanted {
            if self.asked.len() >= self.serves && !self.asked.contains_key(&key) {
                self.does_not_ask(&key, TOO_MANY_ASKED, now);
                continue;
            }
            self.want_one(key, wanted, with, now);
        }
        self.inbound.handle_routes();
        if given_up > 0 {
            self.ask_instead(given_up);
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
        let mut asked = match self.asked.remove(&key) {
            Some(asked) => asked,
            None => {
                let hash = TopicHash::new(with.config.domain, &key.topic, &key.type_name);
                // The peer's graph has no name that is too long.
                let Ok(topic) = hash else { return };
                self.next_route += 1;
                let room = self.remote.account().writers_of(&key);
                AskedRoute {
                    places: room.nothing(),
                    lanes: self.remote.account().lanes.nothing(),
                    room,
                    number: self.next_route - 1,
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
            self.asks(&key);
        }
        let changed = asked.wanted.subscribers != wanted.subscribers || fresh;
        if !self.inbound.routes().contains_key(&asked.number) {
            let limits = self.incoming_limits(&key, with.config);
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
            let attaching = Attaching { until: now + ATTACH_TIMEOUT, awaited: awaited.collect() };
            self.attaching.insert(asked.number, attaching);
            self.look_at_attaching = Some(now);
        }
        asked.wanted = wanted;
        self.numbers.insert(asked.number, key.clone());
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
        if self.look_at_attaching.is_none_or(|due| due > now) {
            return;
        }
        let mut asks = Vec::new();
        let mut changed = false;
        for (number, attaching) in &mut self.attaching {
            let late = now >= attaching.until;
            let ready = |(stand_in, readers): &mut (Rc<StandIn>, usize)| {
                late || stand_in.ring().partners().len() >= *readers
            };
            let ready: Vec<_> = attaching.awaited.extract_if(.., ready).collect();
            if let Some(route) = self.inbound.routes().get_mut(number)
                && !ready.is_empty()
            {
                route.writers.extend(ready.into_iter().map(|(s, _)| (s.gid(), s)));
                changed = true;
            }
            if attaching.awaited.is_empty() {
                asks.push(*number);
            }
        }
        if changed {
            self.inbound.handle_routes();
        }
        asks.sort_unstable();
        for number in asks {
            self.attaching.remove(&number);
            let key = self.numbers.get(&number).cloned();
            if let Some((key, asked)) = key
                .and_then(|key| Some((self.asked.get(&key)?, key)))
                .map(|(asked, key)| (key, asked))
            {
                let message = asked.message(&key);
                self.say(message);
            }
        }
        let waiting = self.attaching.len();
        self.look_at_attaching = (waiting > 0).then(|| now + poll_after(waiting));
    }
}
