//! The routes that a peer asked this host for.

use std::{rc::Rc, time::Duration};

use axon_envelope::{Kind, Route, TopicHash};
use axon_shm::ids::Gid;
use axon_transport::EndpointSpec;

use super::{
    Peer, PeerContext,
    kept_relays::NotCharged,
    reader_of,
    routes::{
        refused::TOO_MANY_LANES,
        served::{DENIED_AGAIN, MAX_ROUTES, MissingRelay, ServedRoute, StalledRoute},
    },
};
use crate::{
    engine::{
        account::Charge,
        limits::RouteLimit,
        outbound::{RouteOut, Source, StallCause, UnfinishedFlows},
        peer::routes::{MAX_RELAYS_OF_ROUTE, admit, kind_of, relays},
        route::{RelaySpec, RouteKey},
    },
    link::{LinkMessage, RouteSubscriber, Subscribe},
};

/// A peer that lacks relays may ask for them again after this time.
const ASK_AGAIN: Duration = Duration::from_secs(10);
/// Memory of a route, in bytes, beside the names and subscribers of which it holds three copies.
const ROUTE_BYTES: usize = 2048;
const NAME_COPIES: usize = 3;
const TOO_MANY_RELAYS: &str = "this host has as many relays as a peer may have, or all peers";

/// The relays of a route.
struct Relays {
    sources: Vec<Source>,
    /// The relays among them that were taken over from another daemon of the peer's host.
    adopted: Vec<Gid>,
    /// The unfinished flows of the adopted relays, or those of the service's earlier route.
    unfinished: UnfinishedFlows,
    without: Option<MissingRelay>,
}

/// Returns the text that some relays of a route are missing, with the reason.
fn missing(missing: usize, asked: usize, why: &str) -> String {
    format!("{missing} of {asked} kinds of subscriptions get nothing: {why}")
}

impl Peer {
    /// Serves a route.
    ///
    /// # Errors
    /// The peer violated the protocol.
    pub(super) fn serve(
        &mut self,
        subscribe: Subscribe,
        with: &PeerContext<'_>,
        now: Duration,
    ) -> Result<(), String> {
        let bytes = ROUTE_BYTES + NAME_COPIES * subscribe.bytes();
        let Subscribe { route: number, topic, type_name, kind, last, .. } = subscribe;
        let subscribers = self.proven_only(subscribe.subscribers, &topic);
        let hash =
            TopicHash::new(with.config.domain, &topic, &type_name).map_err(|e| e.to_string())?;
        let kind = kind_of(kind).ok_or_else(|| format!("a route of kind {kind}"))?;
        let acknowledged = subscribe.acknowledges == Some(true);
        let short_headers = kind == Kind::Topic && subscribe.short_headers == Some(true);
        let key = RouteKey { kind, topic, type_name };
        if let Some(other) = self.served.number_of(&key).filter(|other| *other != number) {
            if self.served.get(other).is_some_and(|served| served.repeated) {
                return Err(format!("{} has a route already", key.topic));
            }
            self.unserve_earlier(other, with, now);
        }
        if self.served.get(number).is_some_and(|old| !old.repeated && old.key != key) {
            self.unserve_earlier(number, with, now);
        }
        let account = Rc::clone(self.remote.account());
        let (old, mut places, mut lanes) = match self.served.take(number) {
            Some(served) if served.key == key => (served.sources, served.relays, served.lanes),
            Some(_) => return Err("a route number for two topics".into()),
            None => {
                if self.served.len() >= MAX_ROUTES {
                    let why = format!("a peer is served {MAX_ROUTES} routes at most, and has them");
                    self.refuse(number, &key, why, None, now);
                    return Ok(());
                }
                (Vec::new(), account.relays.nothing(), account.lanes.nothing())
            }
        };
        if let Some(why) = self.access.denial(reader_of(kind), &key.topic) {
            self.outbound.end_route(number);
            self.refuse(number, &key, why, Some(DENIED_AGAIN), now);
            return Ok(());
        }
        if let Some(left) = with.stalls.borrow().left(&self.identity, &key, now) {
            self.outbound.end_route(number);
            self.refuse(number, &key, "it was not read".into(), Some(left), now);
            return Ok(());
        }
        let room = &self.remote.account().routes;
        let (charge, most) = (room.charge(bytes), room.most() >> 20);
        let Some(charge) = charge else {
            self.outbound.end_route(number);
            let why = format!("what a peer asks for takes more than {most} MiB ([link] graph_mb)");
            self.refuse(number, &key, why, None, now);
            return Ok(());
        };
        self.refused.forget(number);
        let relays = match kind {
            Kind::Topic => {
                self.open_relays(&key, &subscribers, &old, (&mut places, &mut lanes), with, now)
            }
            Kind::Request | Kind::Response => {
                let sources = self.sources_of_service(&key);
                let unfinished = self.unanswered.go_on(&key);
                Relays { sources, adopted: Vec::new(), unfinished, without: None }
            }
        };
        let Relays { sources, adopted, unfinished, without } = relays;
        self.served.announce(number, now);
        let route = Route { kind, topic: hash };
        let seen = last.iter().map(|l| (l.publisher, l.sequence)).collect();
        let out = RouteOut {
            topic: key.topic.as_str().into(),
            route,
            priority: with.config.topic_priority(&key.topic),
            acknowledged,
            short_headers,
            compressed: with.config.topic_compression(&key.topic),
            redundant: with.config.topic_redundancy(&key.topic),
            limit: RouteLimit::new(self.limits(with.config).outgoing(&key)),
            sources: sources.clone(),
            seen,
            unfinished,
        };
        self.outbound.set_route(number, out, now);
        // Reports the ended publishers of adopted relays. This host's graph is followed with a delay, so publishers of
        // other relays may be newer than the graph.
        let adopted = sources.iter().filter(|source| adopted.contains(&source.gid()));
        for of in adopted.flat_map(Source::unacknowledged).map(|(of, _)| of) {
            if !with.local.contains_key(&of) {
                self.outbound.handle_publisher_ended(now, number, of);
            }
        }
        let served = ServedRoute {
            key,
            subscribers: subscribers.iter().map(|subscriber| subscriber.gid).collect(),
            sources,
            _room: charge,
            relays: places,
            lanes,
            without,
            repeated: true,
        };
        self.served.insert(number, served);
        Ok(())
    }

    /// Returns whether this host serves the peer this topic's route for one of these subscriptions.
    pub(in crate::engine) fn serves_one_of(&self, asks: &Subscribe, subscriptions: &[Gid]) -> bool {
        let (topic, type_name) = (asks.topic.clone(), asks.type_name.clone());
        let key = RouteKey { kind: Kind::Topic, topic, type_name };
        let served = self.served.number_of(&key).and_then(|number| self.served.get(number));
        served
            .filter(|_| asks.kind == Kind::Topic as u8)
            .is_some_and(|served| subscriptions.iter().any(|gid| served.subscribers.contains(gid)))
    }

    /// Returns the subscribers that belong to the peer's own sessions, and disowns the others.
    fn proven_only(
        &mut self,
        mut subscribers: Vec<RouteSubscriber>,
        topic: &str,
    ) -> Vec<RouteSubscriber> {
        let others = subscribers.extract_if(.., |reader| !self.remote.owns(&reader.gid));
        let others: Vec<_> = others.map(|reader| reader.gid).collect();
        for gid in others {
            self.remote.disown_reader(&gid, topic);
            self.stirred = true;
        }
        subscribers
    }

    /// Gives up a route that the peer does not read, for a while.
    pub(super) fn give_up_stalled(
        &mut self,
        route: u32,
        why: StallCause,
        with: &PeerContext<'_>,
        now: Duration,
    ) -> Option<StalledRoute> {
        let served = self.served.remove(route)?;
        let samples = self.outbound.give_up_route(route);
        let (limit, key) = (with.config.link.stalled, &served.key);
        let wait = with.stalls.borrow_mut().add(&self.identity, key, limit, now);
        let (topic, again) = (&key.topic, wait.as_secs());
        let what = match why {
            StallCause::NothingRead => {
                format!("nothing of {topic} was read for {} s", limit.as_secs())
            }
            StallCause::TooSlow => format!("{topic} was read so slowly that its publisher waited"),
            StallCause::NoKeys => {
                format!("a KME gave no keys for {topic}, and its publisher waited")
            }
        };
        let reason = format!("{what}; it is not sent for {again} s ([link] stalled_s)");
        self.refuse(route, key, reason.clone(), Some(wait), now);
        Some(StalledRoute { topic: served.key.topic.clone(), reason, samples })
    }

    /// Ends a route that the peer no longer wants.
    pub(super) fn unserve(&mut self, route: u32) {
        self.refused.forget(route);
        if let Some(served) = self.served.get(route).filter(|served| served.key.kind != Kind::Topic)
        {
            let unfinished = self.outbound.leave_service(route);
            self.unanswered.leave(&served.key, unfinished);
        }
        self.served.remove(route);
        self.outbound.end_route(route);
    }

    /// Ends a route that the peer asked for over an earlier link, and may be about to ask for again under another number:
    /// the peer alone saw the end of that link. The samples that it did not acknowledge are kept for that.
    fn unserve_earlier(&mut self, route: u32, with: &PeerContext<'_>, now: Duration) {
        if let Some(served) = self.served.get_mut(route)
            && served.key.kind == Kind::Topic
            && served.subscribers.iter().any(|reader| self.remote.get(reader).is_some())
        {
            let mut kept = with.kept.borrow_mut();
            kept.add_route(&self.identity, route, served, &mut self.outbound, now);
        }
        self.unserve(route);
    }

    /// Ends the routes that the peer did not ask for again over the link in use.
    pub(in crate::engine) fn unserve_unrepeated(&mut self, with: &PeerContext<'_>, now: Duration) {
        let unrepeated = self.served.iter().filter(|(_, served)| !served.repeated);
        let lost: Vec<_> = unrepeated.map(|(route, _)| route).collect();
        lost.into_iter().for_each(|route| self.unserve_earlier(route, with, now));
    }

    /// Opens the relays of a topic, and leaves relays open that the route already has. `places` and `lanes` are the
    /// charges of the route's earlier relays on entry, and of all its relays on return.
    fn open_relays(
        &self,
        key: &RouteKey,
        subscribers: &[RouteSubscriber],
        old: &[Source],
        (places, lanes): (&mut Charge, &mut Charge),
        with: &PeerContext<'_>,
        now: Duration,
    ) -> Relays {
        let hash = |gid: &Gid| self.remote.get(gid).map_or_else(Vec::new, |e| e.type_hash.clone());
        let mut specs = relays(subscribers, hash);
        let there = |spec: &RelaySpec| {
            old.iter().find_map(|source| match source {
                Source::Relay(other, reader) if other.is(spec) => Some(Rc::clone(reader)),
                _ => None,
            })
        };
        let asked = specs.len();
        let mut without = None;
        if admit(&mut specs, |spec| there(spec).is_some()) > 0 {
            let why = format!("a topic has {MAX_RELAYS_OF_ROUTE} relays for a peer at most");
            without = Some((why, None));
        }
        let stay = specs.iter().filter(|spec| there(spec).is_some()).count();
        let each = with.writers.of_route(key);
        drop(places.split(places.amount().saturating_sub(stay)));
        drop(lanes.split(lanes.amount().saturating_sub(stay * each)));
        let (mut sources, mut adopted) = (Vec::new(), Vec::new());
        let mut unfinished = UnfinishedFlows::new();
        for spec in specs {
            if let Some(reader) = there(&spec) {
                reader.set_stands_for(spec.stands_for.clone());
                sources.push(Source::Relay(spec, reader));
                continue;
            }
            // A kept relay stays kept if there is no place for it.
            let mut relays_kept = with.kept.borrow_mut();
            let own = &self.identity;
            let charged = relays_kept.charge(key, &spec, own, (&*places, &*lanes), each);
            let (place, its_lanes) = match charged {
                Ok(charged) => charged,
                Err(lacks) => {
                    let why = match lacks {
                        NotCharged::Relays => TOO_MANY_RELAYS,
                        NotCharged::Lanes => TOO_MANY_LANES,
                    };
                    without = Some((why.to_owned(), Some(ASK_AGAIN)));
                    continue;
                }
            };
            let limit = with.config.link.stalled;
            let kept = relays_kept.adopt(key, &spec, own, limit, now);
            let reader = match kept {
                Some((reader, flows)) => {
                    for (of, flow) in flows {
                        let known = unfinished.entry(of).or_insert(flow);
                        *known = known.and(flow);
                    }
                    Ok((reader, true))
                }
                None => {
                    let endpoint = EndpointSpec::new(&*key.topic, &*key.type_name, spec.qos)
                        .type_hash(spec.type_hash.clone());
                    let opened = with.rings.open_reader(endpoint, spec.stands_for.clone());
                    opened.map(|reader| (reader, false))
                }
            };
            match reader {
                Ok((reader, is_adopted)) => {
                    places.add(place);
                    lanes.add(its_lanes);
                    let source = Source::Relay(spec, reader);
                    adopted.extend(is_adopted.then(|| source.gid()));
                    sources.push(source);
                }
                Err(error) => {
                    let topic = &key.topic;
                    tracing::error!(topic, error, "could not open a relay: a peer gets no samples");
                    let why = "the publishers' host could not open a relay; its log says why";
                    without = Some((why.to_owned(), Some(ASK_AGAIN)));
                }
            }
        }
        let lacks = asked - sources.len();
        let without = without.map(|(why, again)| (missing(lacks, asked, &why), again));
        Relays { sources, adopted, unfinished, without }
    }

    /// Returns the stand-ins that supply the requests, or responses, of a service.
    fn sources_of_service(&self, key: &RouteKey) -> Vec<Source> {
        let asked = self.asked.get(&key.other_way());
        let stand_ins = asked.into_iter().flat_map(|asked| asked.stand_ins.values());
        let mut sources: Vec<_> = stand_ins.cloned().collect();
        sources.sort_by_key(|stand_in| stand_in.gid());
        sources.into_iter().map(Source::StandIn).collect()
    }

    /// Updates the routes of services to the stand-ins that exist now.
    pub(super) fn feed_services(&mut self, now: Duration) {
        let mut changes = Vec::new();
        for (number, served) in self.served.services() {
            let sources = self.sources_of_service(&served.key);
            let same = sources.len() == served.sources.len()
                && sources.iter().zip(&served.sources).all(|(one, other)| one.is(other));
            if !same {
                changes.push((number, sources));
            }
        }
        for (number, sources) in changes {
            let Some(served) = self.served.get_mut(number) else { continue };
            served.sources.clone_from(&sources);
            self.outbound.set_sources(number, sources, now);
        }
    }

    /// Gives up the relays for which there are not enough lanes any more.
    pub(super) fn fit_relays(&mut self, with: &PeerContext<'_>, now: Duration) {
        for (number, had) in self.served.fit_lanes(with.writers) {
            let Some(served) = self.served.get(number) else { continue };
            let (key, sources) = (served.key.clone(), served.sources.clone());
            let why = missing(had - sources.len(), had, TOO_MANY_LANES);
            self.outbound.set_sources(number, sources, now);
            self.refuse(number, &key, why, Some(ASK_AGAIN), now);
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
        self.refused.refuse(number, key, reason, retry, now, &mut self.messages);
    }

    /// Reports the routes that have a writer by now.
    pub(super) fn announce_ready(&mut self, now: Duration) {
        for ready in self.served.take_ready(now) {
            let number = ready.route;
            self.say(LinkMessage::RouteReady(ready));
            // The peer takes the report as the end of a refusal, so the refusal follows it.
            if let Some(served) = self.served.get(number)
                && let Some((reason, again)) = served.without.clone()
            {
                let key = served.key.clone();
                self.refuse(number, &key, reason, again, now);
            }
        }
    }
}
