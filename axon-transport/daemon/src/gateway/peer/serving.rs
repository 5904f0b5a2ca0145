//! Routes that the peer asks for, and what they are fed from.

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::{Kind, Route, TopicHash};
use axon_shm::ids::Gid;
use axon_transport::EndpointSpec;
use tokio::sync::oneshot;

use super::{OnDrop, POLL, Peer};
use crate::{
    gateway::{
        account::Charge,
        hub::Shared,
        keyring::lock,
        outbound::{Order, RouteOut, Source},
        routes::{RelaySpec, RouteKey, admit, relays},
    },
    link::{Message, RouteReady, Subscribe, Subscriber},
};

/// How long ROUTE_READY waits for the first local publisher to attach.
const READY_TIMEOUT: Duration = Duration::from_secs(2);

/// A route that the peer asked for.
pub(super) struct Served {
    pub(super) key: RouteKey,
    route: Route,
    /// Its readers there.
    pub(super) subscribers: Vec<Gid>,
    pub(super) sources: Vec<Source>,
    /// What it takes of the peer's account: bytes, and relays.
    _charges: [Charge; 2],
    /// Whether it was asked for on the link in use.
    pub(super) repeated: bool,
    /// Sends ROUTE_READY once a publisher is attached.
    _announcing: OnDrop,
}

/// A route that its peer does not read.
pub(in crate::gateway) struct Stalled {
    /// Its topic.
    pub(in crate::gateway) topic: String,
    /// What was done.
    pub(in crate::gateway) reason: String,
    /// How many samples were given up, once that is known.
    pub(in crate::gateway) samples: oneshot::Receiver<u64>,
}

/// Bytes that a route takes besides what its SUBSCRIBE says.
const ROUTE: usize = 2048;
/// How often what a SUBSCRIBE says is kept: by the route, its relays, and what feeds them.
const COPIES: usize = 3;

impl Peer {
    /// SUBSCRIBE: opens a route, or changes it. One for requests may have made servers reachable:
    /// [`update`](Self::update) sees to it.
    ///
    /// # Errors
    /// Text for the peer: what is wrong with the request.
    pub(in crate::gateway) fn serve(
        &mut self,
        subscribe: Subscribe,
        shared: &Arc<Shared>,
    ) -> Result<(), String> {
        let bytes = ROUTE + COPIES * subscribe.bytes();
        let Subscribe { route: number, topic, type_name, kind, last, .. } = subscribe;
        let subscribers = self.proven_only(subscribe.subscribers, &topic);
        let hash = TopicHash::new(shared.domain, &topic, &type_name).map_err(|e| e.to_string())?;
        let kind = match kind {
            0 => Kind::Topic,
            1 => Kind::Request,
            2 => Kind::Response,
            other => return Err(format!("a route of kind {other}")),
        };
        let acknowledged = kind == Kind::Topic && subscribe.acknowledges == Some(true);
        let key = RouteKey { kind, topic, type_name };
        let mut others = self.served.iter().filter(|(route, _)| **route != number);
        match others.find(|(_, served)| served.key == key).map(|(other, s)| (*other, s.repeated)) {
            // Its UNSUBSCRIBE was lost with an old link, as it may have been where a number is new.
            Some((other, false)) => self.unserve(other),
            Some(_) => return Err(format!("{} has a route already", key.topic)),
            None => {}
        }
        if self.served.get(&number).is_some_and(|old| !old.repeated && old.key != key) {
            self.unserve(number);
        }
        let old = match self.served.remove(&number) {
            Some(served) if served.key == key => served.sources,
            Some(_) => return Err("a route number for two topics".into()),
            None => {
                if let Some(why) = self.has_too_many_routes() {
                    self.refuse(number, &key, why, None);
                    return Ok(());
                }
                Vec::new()
            }
        };
        let left = lock(&shared.stalls).left(&self.identity, &key, Instant::now());
        if let Some(left) = left {
            self.refuse(number, &key, "it was not read".into(), Some(left));
            return Ok(());
        }
        let room = &self.remote.account().routes;
        let (charge, most) = (room.charge(bytes), room.most() >> 20);
        let Some(charge) = charge else {
            // It may have been served until now.
            let _ = self.orders.send(Order::End(number));
            let why = format!("what a peer asks for takes more than {most} MiB ([link] graph_mb)");
            self.refuse(number, &key, why, None);
            return Ok(());
        };
        self.refused.forget(number);
        let sources = match kind {
            Kind::Topic => self.open_relays(&key, &subscribers, &old, shared),
            Kind::Request | Kind::Response => self.of_service(&key),
        };
        let relays = sources.iter().filter(|source| matches!(source, Source::Relay(..))).count();
        let room = &self.remote.account().relays;
        // There is room for all of them: all peers are served by one task.
        let relays = room.charge(relays).unwrap_or_else(|| room.nothing());
        let _announcing = self.announce_ready(number, &sources);
        let route = Route { kind, topic: hash };
        let seen = last.iter().map(|l| (l.publisher, l.sequence)).collect();
        let topic = key.topic.as_str().into();
        let out = RouteOut { topic, route, acknowledged, sources: sources.clone(), seen };
        let _ = self.orders.send(Order::Route(number, out));
        let subscribers = subscribers.iter().map(|subscriber| subscriber.gid).collect();
        let repeated = true;
        let served = Served {
            key,
            route,
            subscribers,
            sources,
            _charges: [charge, relays],
            repeated,
            _announcing,
        };
        self.served.insert(number, served);
        Ok(())
    }

    /// Those whose sessions the peer proved to have; the others are left out by name.
    fn proven_only(&mut self, mut subscribers: Vec<Subscriber>, topic: &str) -> Vec<Subscriber> {
        let others = subscribers.extract_if(.., |reader| !self.remote.owns(&reader.gid));
        let others: Vec<_> = others.map(|reader| reader.gid).collect();
        for gid in others {
            self.remote.disown_reader(&gid, topic);
            // It is said with the next change of the graph.
            self.stirred = true;
        }
        subscribers
    }

    /// The peer does not read a route: it ends. What is to be said of it.
    pub(in crate::gateway) fn stalled(&mut self, route: u32, shared: &Shared) -> Option<Stalled> {
        let served = self.served.remove(&route)?;
        let (told, samples) = oneshot::channel();
        let _ = self.orders.send(Order::GiveUp(route, told));
        let (limit, now) = (shared.stalled_after, Instant::now());
        let wait = lock(&shared.stalls).add(&self.identity, &served.key, limit, now);
        let reason = format!(
            "nothing of {} was read for {} s; it is not sent for {} s ([link] stalled_s)",
            served.key.topic,
            limit.as_secs(),
            wait.as_secs()
        );
        self.refuse(route, &served.key, reason.clone(), Some(wait));
        Some(Stalled { topic: served.key.topic.clone(), reason, samples })
    }

    /// UNSUBSCRIBE.
    pub(in crate::gateway) fn unserve(&mut self, route: u32) {
        self.refused.forget(route);
        self.served.remove(&route);
        let _ = self.orders.send(Order::End(route));
    }

    /// The peer has said on this link what it wants: the UNSUBSCRIBE of the rest was lost.
    pub(super) fn unserve_unrepeated(&mut self) {
        let unrepeated = self.served.iter().filter(|(_, served)| !served.repeated);
        let lost: Vec<_> = unrepeated.map(|(route, _)| *route).collect();
        lost.into_iter().for_each(|route| self.unserve(route));
    }

    fn open_relays(
        &self,
        key: &RouteKey,
        subscribers: &[Subscriber],
        old: &[Source],
        shared: &Arc<Shared>,
    ) -> Vec<Source> {
        let hash = |gid: &Gid| self.remote.get(gid).map_or_else(Vec::new, |e| e.type_hash.clone());
        let mut specs = relays(subscribers, hash);
        let there = |spec: &RelaySpec| {
            old.iter().position(|source| matches!(source, Source::Relay(o, _) if o.is(spec)))
        };
        // Those of this route are not among them: what it took was given back.
        let elsewhere = self.remote.account().relays.held();
        let refused = admit(&mut specs, |spec| there(spec).is_some(), elsewhere);
        if refused > 0 {
            let topic = &key.topic;
            tracing::warn!(
                topic,
                refused,
                "peer exceeded its relay limit; some of its subscriptions to this topic get no samples"
            );
        }
        let mut sources = Vec::new();
        for spec in specs {
            let RelaySpec { qos, ref type_hash, ref stands_for, .. } = spec;
            if let Some(at) = there(&spec)
                && let Source::Relay(_, subscription) = &old[at]
            {
                subscription.set_stands_for(stands_for.clone());
                sources.push(Source::Relay(spec, Arc::clone(subscription)));
                continue;
            }
            let endpoint =
                EndpointSpec::new(&*key.topic, &*key.type_name, qos).type_hash(type_hash.clone());
            match shared.session.create_relay(endpoint, stands_for.clone()) {
                Ok(subscription) => sources.push(Source::Relay(spec, Arc::new(subscription))),
                Err(error) => {
                    let topic = &key.topic;
                    tracing::error!(topic, %error, "a topic is not sent to a peer");
                }
            }
        }
        sources
    }

    /// What stands in for the peer's end of a service takes what is for it.
    fn of_service(&self, key: &RouteKey) -> Vec<Source> {
        let asked = self.asked.get(&key.other_way());
        let stand_ins = asked.into_iter().flat_map(|asked| asked.stand_ins.values());
        let mut sources: Vec<_> = stand_ins.cloned().collect();
        sources.sort_by_key(|stand_in| stand_in.gid());
        sources.into_iter().map(Source::StandIn).collect()
    }

    /// Services are fed from the stand-ins that there are now.
    pub(super) fn feed_services(&mut self) {
        let services = self.served.iter().filter(|(_, served)| served.key.kind != Kind::Topic);
        let mut changes = Vec::new();
        for (number, served) in services {
            let now = self.of_service(&served.key);
            let same = now.len() == served.sources.len()
                && now.iter().zip(&served.sources).all(|(one, other)| one.is(other));
            if !same {
                changes.push((*number, now));
            }
        }
        for (number, sources) in changes {
            let Some(served) = self.served.get_mut(&number) else { continue };
            served.sources.clone_from(&sources);
            let topic = served.key.topic.as_str().into();
            let (route, acknowledged, seen) = (served.route, false, HashMap::new());
            let out = RouteOut { topic, route, acknowledged, sources, seen };
            let _ = self.orders.send(Order::Route(number, out));
        }
    }

    fn announce_ready(&self, route: u32, sources: &[Source]) -> OnDrop {
        let (sources, outbox) = (sources.to_vec(), self.outbox.clone());
        OnDrop(tokio::spawn(async move {
            poll(|| sources.iter().any(|s| !s.writers().is_empty()), READY_TIMEOUT).await;
            let publishers = sources.iter().flat_map(Source::writers).collect();
            outbox.send(Message::RouteReady(RouteReady { route, publishers }));
        }))
    }
}

/// Looks until `reached`, or until `limit` has passed. A few milliseconds of latency, once a route,
/// for no thread that a peer could keep busy.
async fn poll(reached: impl Fn() -> bool, limit: Duration) {
    let until = tokio::time::Instant::now() + limit;
    while !reached() && tokio::time::Instant::now() < until {
        tokio::time::sleep(POLL).await;
    }
}
