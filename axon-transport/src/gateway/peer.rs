//! One linked peer: its graph, the routes in both directions, and the tasks that carry samples.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::{Arc, RwLock},
    time::Duration,
};

use axon_envelope::{Kind, Route, TopicHash};
use tokio::sync::mpsc;

use super::{
    control::Outbox,
    counters::Counters,
    hub::{Event, Shared},
    inbound::{Inbound, RouteIn, RoutesIn},
    outbound::{self, Carrier, RouteOut},
    routes::{RelaySpec, TopicKey, Wanted, relays},
    stand_in::StandIn,
};
use crate::{
    graph::{Endpoint, LIMITS},
    ids::Gid,
    link::{Graph, LastSeen, Message, RouteReady, Subscribe, Subscriber, Unsubscribe},
    session::{EndpointSpec, Subscription},
};

/// Endpoints in one GRAPH message; a larger graph takes several.
const GRAPH_PART: usize = 512;
/// A route is asked for when its stand-ins have their local readers, or after this at the latest.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(1);
/// How long ROUTE_READY waits for the first local publisher to attach.
const READY_TIMEOUT: Duration = Duration::from_secs(2);
/// How often readers are looked for meanwhile.
const POLL: Duration = Duration::from_millis(5);
/// Routes that a peer may ask for, and publishers of a peer that are shown here. Each costs a lane
/// or a ring.
const MAX_ROUTES: usize = 1024;
const MAX_STAND_INS: usize = 1024;

/// A peer with an elected link.
pub(super) struct Peer {
    /// The number of the link in use.
    pub(super) link: u64,
    /// Control messages to it.
    pub(super) outbox: Outbox,
    /// What was carried and dropped.
    pub(super) counters: Arc<Counters>,
    remote: BTreeMap<Gid, Endpoint>,
    remote_version: u64,
    sent: BTreeMap<Gid, Endpoint>,
    sent_version: u64,
    next_route: u32,
    /// Routes that this side asked for.
    asked: BTreeMap<TopicKey, Asked>,
    routes_in: RoutesIn,
    /// Routes that the peer asked for.
    served: HashMap<u32, Served>,
    orders: mpsc::UnboundedSender<outbound::Order>,
}

/// What a GRAPH message changed.
pub(super) struct GraphChange {
    /// Whether it replaces everything that was known of the peer.
    pub(super) reset: bool,
    /// Endpoints that came or changed.
    pub(super) added: Vec<Endpoint>,
    /// Endpoints that went.
    pub(super) removed: Vec<Gid>,
}

struct Asked {
    number: u32,
    subscribers: Vec<Subscriber>,
    stand_ins: HashMap<Gid, Arc<StandIn>>,
    /// Sends SUBSCRIBE once the stand-ins have their readers.
    asking: Option<OnDrop>,
}

/// A route that the peer asked for.
struct Served {
    key: TopicKey,
    relays: Vec<(RelaySpec, Arc<Subscription>)>,
    /// Sends ROUTE_READY once a publisher is attached.
    _announcing: OnDrop,
}

impl Peer {
    /// A peer whose first link was elected.
    pub(super) fn new(link: u64, outbox: Outbox, carrier: Carrier, shared: &Arc<Shared>) -> Self {
        let counters = Arc::new(Counters::default());
        let (orders, receiver) = mpsc::unbounded_channel();
        let graph = Arc::clone(&shared.local_qos);
        let offered = move |gid| super::hub::read(&graph).get(&gid).copied();
        let pulse = shared.pulse.clone();
        tokio::spawn(outbound::run(carrier, receiver, Arc::clone(&counters), pulse, offered));
        Self {
            link,
            outbox,
            counters,
            remote: BTreeMap::new(),
            remote_version: 0,
            sent: BTreeMap::new(),
            sent_version: 0,
            next_route: 1,
            asked: BTreeMap::new(),
            routes_in: RoutesIn::new(RwLock::default()),
            served: HashMap::new(),
            orders,
        }
    }

    /// A successor link takes over: samples go over it from now on, and both sides repeat what they
    /// said last, since it may have been lost with the old one.
    pub(super) fn succeed(&mut self, link: u64, outbox: Outbox, carrier: Carrier) {
        self.link = link;
        self.outbox = outbox;
        let _ = self.orders.send(outbound::Order::Connection(carrier));
        for (key, asked) in &self.asked {
            self.say(subscribe(key, asked));
        }
    }

    /// What a data stream of `connection` needs.
    pub(super) fn inbound(
        &self,
        carrier: Carrier,
        shared: &Shared,
        refused: mpsc::Sender<(crate::link::CloseCode, String)>,
    ) -> Inbound {
        Inbound {
            connection: carrier.connection,
            protection: carrier.protection,
            routes: Arc::clone(&self.routes_in),
            counters: Arc::clone(&self.counters),
            pulse: shared.pulse.clone(),
            max_message: shared.max_message,
            refused,
        }
    }

    /// Puts a message into the outbox.
    pub(super) fn say(&self, message: Message) {
        self.outbox.send(message);
    }

    /// The endpoints that the peer announced.
    pub(super) fn remote(&self) -> impl Iterator<Item = &Endpoint> {
        self.remote.values()
    }

    /// Whether the peer announced this endpoint.
    pub(super) fn has(&self, gid: Gid) -> bool {
        self.remote.contains_key(&gid)
    }

    // ---- graph ----

    /// Sends what changed since the last time, or all of it.
    pub(super) fn send_graph(&mut self, local: &BTreeMap<Gid, Endpoint>, whole: bool) {
        if whole {
            self.sent.clear();
        }
        let added: Vec<_> =
            local.values().filter(|e| self.sent.get(&e.gid) != Some(e)).cloned().collect();
        let removed: Vec<_> =
            self.sent.keys().filter(|gid| !local.contains_key(gid)).copied().collect();
        if !whole && added.is_empty() && removed.is_empty() {
            return;
        }
        let mut before = if whole { 0 } else { self.sent_version };
        let mut removed = Some(removed);
        let mut parts: Vec<_> = added.chunks(GRAPH_PART).map(<[_]>::to_vec).collect();
        if parts.is_empty() {
            parts.push(Vec::new());
        }
        for part in parts {
            self.sent_version += 1;
            let removed = removed.take().unwrap_or_default();
            let graph = Graph { version: self.sent_version, before, added: part, removed };
            self.say(Message::Graph(graph));
            before = self.sent_version;
        }
        self.sent.clone_from(local);
    }

    /// Takes a GRAPH in; `None` when a version is missing and the whole graph must be asked for.
    ///
    /// # Errors
    /// The peer announces more endpoints than allowed.
    pub(super) fn take_graph(&mut self, graph: Graph) -> Result<Option<GraphChange>, &'static str> {
        let whole = graph.before == 0;
        if !whole && graph.before != self.remote_version {
            return Ok(None);
        }
        if whole {
            self.remote.clear();
        }
        for gid in &graph.removed {
            self.remote.remove(gid);
        }
        for endpoint in &graph.added {
            self.remote.insert(endpoint.gid, endpoint.clone());
        }
        if self.remote.len() > LIMITS.endpoints {
            return Err("more endpoints than a peer may have");
        }
        self.remote_version = graph.version;
        Ok(Some(GraphChange { reset: whole, added: graph.added, removed: graph.removed }))
    }

    /// The version of the peer's graph that this side holds.
    pub(super) fn remote_version(&self) -> u64 {
        self.remote_version
    }

    /// These endpoints are another daemon's.
    pub(super) fn forget(&mut self, gids: &[Gid]) {
        for gid in gids {
            self.remote.remove(gid);
        }
    }

    // ---- routes that this side asks for ----

    /// Brings stand-ins and subscriptions in line with what is wanted from the peer.
    pub(super) fn want(&mut self, wanted: BTreeMap<TopicKey, Wanted>, shared: &Arc<Shared>) {
        let gone: Vec<_> = self.asked.keys().filter(|k| !wanted.contains_key(k)).cloned().collect();
        for key in gone {
            if let Some(asked) = self.asked.remove(&key) {
                write(&self.routes_in).remove(&asked.number);
                self.say(Message::Unsubscribe(Unsubscribe { route: asked.number }));
            }
        }
        for (key, wanted) in wanted {
            self.want_one(key, wanted, shared);
        }
    }

    fn want_one(&mut self, key: TopicKey, wanted: Wanted, shared: &Arc<Shared>) {
        let mut asked = self.asked.remove(&key).unwrap_or_else(|| {
            self.next_route += 1;
            Asked {
                number: self.next_route - 1,
                subscribers: Vec::new(),
                stand_ins: HashMap::new(),
                asking: None,
            }
        });
        let publishers: HashSet<_> = wanted.publishers.iter().map(|p| p.gid).collect();
        asked.stand_ins.retain(|gid, _| publishers.contains(gid));
        let mut shown =
            asked.stand_ins.len() + self.asked.values().map(|a| a.stand_ins.len()).sum::<usize>();
        let mut fresh = Vec::new();
        for publisher in wanted.publishers {
            let gid = publisher.gid;
            if asked.stand_ins.contains_key(&gid) {
                continue;
            }
            if shown >= MAX_STAND_INS {
                tracing::warn!(topic = key.topic, "a peer has more publishers than are shown");
                break;
            }
            shown += 1;
            match shared.stand_ins.get(&shared.session, &publisher) {
                Ok(stand_in) => {
                    fresh.push(Arc::clone(&stand_in));
                    asked.stand_ins.insert(gid, stand_in);
                }
                Err(error) => {
                    tracing::error!(topic = key.topic, %error, "a remote publisher is not shown");
                }
            }
        }
        let hash = TopicHash::new(shared.domain, &key.topic, &key.type_name);
        let Ok(topic) = hash else { return };
        write(&self.routes_in).insert(
            asked.number,
            RouteIn {
                route: Route { kind: Kind::Topic, topic },
                publishers: asked.stand_ins.clone(),
            },
        );
        let changed = asked.subscribers != wanted.subscribers || !fresh.is_empty();
        asked.subscribers = wanted.subscribers;
        if changed {
            // Samples must find the local readers attached.
            let count = asked.subscribers.len();
            let (outbox, message) = (self.outbox.clone(), subscribe(&key, &asked));
            let stand_ins: Vec<_> = asked.stand_ins.values().cloned().collect();
            asked.asking = Some(OnDrop(tokio::spawn(async move {
                let attached = || stand_ins.iter().all(|s| s.matched().len() >= count);
                poll(attached, ATTACH_TIMEOUT).await;
                outbox.send(message);
            })));
        }
        self.asked.insert(key, asked);
    }

    // ---- routes that the peer asks for ----

    /// SUBSCRIBE: opens, or changes, the relays of a route.
    ///
    /// # Errors
    /// Text for the peer: what is wrong with the request.
    pub(super) fn serve(
        &mut self,
        subscribe: Subscribe,
        shared: &Arc<Shared>,
    ) -> Result<(), String> {
        if subscribe.kind != 0 {
            return Err("routes for services are of a later protocol version".into());
        }
        let topic = TopicHash::new(shared.domain, &subscribe.topic, &subscribe.type_name)
            .map_err(|e| e.to_string())?;
        let key =
            TopicKey { topic: subscribe.topic.clone(), type_name: subscribe.type_name.clone() };
        let mut others = self.served.iter().filter(|(route, _)| **route != subscribe.route);
        if others.any(|(_, served)| served.key == key) {
            return Err(format!("{} has a route already", key.topic));
        }
        let mut old = match self.served.remove(&subscribe.route) {
            Some(served) if served.key == key => served.relays,
            Some(_) => return Err("a route number for two topics".into()),
            None if self.served.len() >= MAX_ROUTES => {
                return Err(format!("more than {MAX_ROUTES} routes"));
            }
            None => Vec::new(),
        };
        let mut current = Vec::new();
        for spec in relays(&subscribe.subscribers) {
            let same = old.iter().position(|(o, _)| o.qos == spec.qos);
            if let Some(at) = same {
                let (_, subscription) = old.swap_remove(at);
                subscription.set_stands_for(spec.stands_for.clone());
                current.push((spec, subscription));
                continue;
            }
            let endpoint = EndpointSpec::new(&*subscribe.topic, &*subscribe.type_name, spec.qos);
            match shared.session.create_relay(endpoint, spec.stands_for.clone()) {
                Ok(subscription) => current.push((spec, Arc::new(subscription))),
                Err(error) => {
                    let topic = &subscribe.topic;
                    tracing::error!(topic, %error, "a topic is not sent to a peer");
                }
            }
        }
        let announcing = self.announce_ready(subscribe.route, &current);
        let served = Served { key, relays: current.clone(), _announcing: announcing };
        self.served.insert(subscribe.route, served);
        let seen = subscribe.last.iter().map(|l| (l.publisher, l.sequence)).collect();
        let route = RouteOut { route: Route { kind: Kind::Topic, topic }, relays: current, seen };
        let _ = self.orders.send(outbound::Order::Route(subscribe.route, route));
        Ok(())
    }

    /// UNSUBSCRIBE.
    pub(super) fn unserve(&mut self, route: u32) {
        self.served.remove(&route);
        let _ = self.orders.send(outbound::Order::End(route));
    }

    fn announce_ready(&self, route: u32, relays: &[(RelaySpec, Arc<Subscription>)]) -> OnDrop {
        let relays: Vec<_> = relays.iter().map(|(_, s)| Arc::clone(s)).collect();
        let outbox = self.outbox.clone();
        OnDrop(tokio::spawn(async move {
            poll(|| relays.iter().any(|r| !r.matched().is_empty()), READY_TIMEOUT).await;
            let publishers = relays.iter().flat_map(|r| r.matched()).collect();
            outbox.send(Message::RouteReady(RouteReady { route, publishers }));
        }))
    }
}

fn subscribe(key: &TopicKey, asked: &Asked) -> Message {
    let last = asked
        .stand_ins
        .iter()
        .filter_map(|(gid, s)| Some(LastSeen { publisher: *gid, sequence: s.last_sequence()? }))
        .collect();
    Message::Subscribe(Subscribe {
        route: asked.number,
        topic: key.topic.clone(),
        type_name: key.type_name.clone(),
        kind: 0,
        subscribers: asked.subscribers.clone(),
        last,
    })
}

/// Looks until `reached`, or until `limit` has passed. A few milliseconds of latency, once a route,
/// for no thread that a peer could keep busy.
async fn poll(reached: impl Fn() -> bool, limit: Duration) {
    let until = tokio::time::Instant::now() + limit;
    while !reached() && tokio::time::Instant::now() < until {
        tokio::time::sleep(POLL).await;
    }
}

/// A task that ends with what it is for.
struct OnDrop(tokio::task::JoinHandle<()>);

impl Drop for OnDrop {
    fn drop(&mut self) {
        self.0.abort();
    }
}

fn write<T>(lock: &RwLock<T>) -> std::sync::RwLockWriteGuard<'_, T> {
    lock.write().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// What the hub hears from the tasks of a peer.
pub(super) fn spawn_reader(
    link: u64,
    mut reader: super::control::ControlReader,
    events: mpsc::Sender<Event>,
) {
    tokio::spawn(async move {
        loop {
            let next = reader.next().await;
            let ended = next.is_err();
            if events.send(Event::Control(link, next)).await.is_err() || ended {
                return;
            }
        }
    });
}
