//! The end in a relayed session's own process.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use super::{
    MAX_MATCHED, Pool, Tally,
    flow::{Departing, Incoming},
    news::News,
    pipe::{End, Pipe},
};
use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing},
    ids::{DaemonId, Gid},
    passed::PassedFd,
    qos::{Durability, History, Liveliness, Qos, Reliability},
    session::{
        EndpointSpec, Publisher, Session, SessionError, Shared, Subscription,
        connect::{Caller, Connected},
        local::House,
        message::{Announce, EndpointRole, Gone, Graph, Message},
    },
    shm::Sample,
    wait::ExternalLeader,
};

/// How long the end of a session waits for what its publishers left to be gone.
const LINGER: Duration = Duration::from_secs(1);
/// Between attempts to find a daemon.
const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// Samples of one pair that are passed over before others have their turn.
const BATCH: usize = 64;

/// Carries a session's samples to its daemon and back, until it is dropped.
#[derive(Debug)]
pub(crate) struct Near {
    finish: Arc<AtomicBool>,
    news: Arc<News>,
    thread: Option<JoinHandle<()>>,
}

/// What outlives a connection.
struct Common {
    /// The session.
    shared: Arc<Shared>,
    house: Arc<House>,
    /// Stands for the world outside.
    outside: Session,
    leader: ExternalLeader,
    news: Arc<News>,
    finish: Arc<AtomicBool>,
    reason: String,
}

impl Near {
    pub(crate) fn start(
        shared: Arc<Shared>,
        house: Arc<House>,
        outside: Session,
        connected: Connected,
        reason: String,
    ) -> Result<Self, SessionError> {
        let system = |what| move |source: std::io::Error| SessionError::System { what, source };
        let news = News::new().map_err(system("creating an eventfd"))?;
        news.of(&outside);
        let finish = Arc::new(AtomicBool::new(false));
        let leader = outside.segment().external_leader()?;
        let common = Common {
            shared,
            house,
            outside,
            leader,
            news: Arc::clone(&news),
            finish: Arc::clone(&finish),
            reason,
        };
        let blocked = crate::session::signals::Blocked::all();
        let thread = std::thread::Builder::new()
            .name("axon-relay".into())
            .spawn(move || common.run(connected))
            .map_err(system("starting the relay's thread"))?;
        drop(blocked);
        Ok(Self { finish, news, thread: Some(thread) })
    }
}

impl Drop for Near {
    fn drop(&mut self) {
        // Pairs with the loads of the relay's thread.
        self.finish.store(true, Ordering::Release);
        self.news.wake();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Common {
    fn run(self, connected: Connected) {
        let mut next = Some(connected);
        while let Some(connected) = next {
            let since = Instant::now();
            let daemon = connected.welcome.daemon;
            let mut served = Served::new(&self, connected);
            self.shared.set_daemon(Some(daemon));
            let why = served.serve();
            served.forget_world();
            drop(served);
            if self.finishes() {
                return;
            }
            if let Err(why) = why {
                tracing::warn!(%why, "the connection to the daemon is lost");
            }
            self.shared.set_daemon(None);
            next = self.reconnect(since.elapsed() < Duration::from_secs(1));
        }
    }

    fn finishes(&self) -> bool {
        self.finish.load(Ordering::Acquire)
    }

    /// Another daemon; `None` when the session ends. `brief` says that the last one was as good as
    /// none.
    fn reconnect(&self, brief: bool) -> Option<Connected> {
        let mut pause = MIN_PAUSE;
        let mut wait = brief;
        while !self.finishes() {
            if std::mem::replace(&mut wait, true) {
                std::thread::sleep(pause);
                pause = (pause * 2).min(MAX_PAUSE);
            }
            let caller = Caller {
                config: &self.shared.config,
                options: &self.shared.options,
                id: self.shared.id,
                segment: None,
                relay: Some(&self.reason),
                cancel: Some(&self.finish),
            };
            match caller.connect() {
                Ok(connected) => return Some(connected),
                Err(SessionError::NoDaemon { .. }) => {}
                Err(error) => tracing::error!(%error, "no daemon took the session"),
            }
        }
        None
    }
}

/// Publishers whose samples are taken by one relay.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Group {
    topic: String,
    type_name: String,
    best_effort: bool,
    volatile: bool,
}

impl Group {
    fn of(endpoint: &Endpoint) -> Self {
        Self {
            topic: endpoint.topic.clone(),
            type_name: endpoint.type_name.clone(),
            best_effort: endpoint.qos.reliability == Reliability::BestEffort,
            volatile: endpoint.qos.durability == Durability::Volatile,
        }
    }

    /// What a relay requests to get all that its publishers offer: whether one is held back is up to
    /// the publisher's QoS, as ever.
    fn qos(&self, depth: u32) -> Qos {
        Qos {
            reliability: if self.best_effort {
                Reliability::BestEffort
            } else {
                Reliability::Reliable
            },
            durability: if self.volatile {
                Durability::Volatile
            } else {
                Durability::TransientLocal
            },
            history: if self.best_effort { History::KeepLast } else { History::KeepAll },
            depth,
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            lease: None,
        }
    }
}

/// What is wanted of a relay.
#[derive(Default)]
struct Wanted {
    depth: u32,
    stands_for: BTreeSet<Gid>,
}

struct Relay {
    subscription: Subscription,
    stands_for: BTreeSet<Gid>,
}

/// One connection.
struct Served<'a> {
    common: &'a Common,
    daemon: DaemonId,
    pipe: Pipe,
    /// The session's endpoints that the daemon was told of.
    own: BTreeMap<Gid, Arc<Endpoint>>,
    /// Publishers among them that are gone, and may have left something.
    ending: BTreeSet<Gid>,
    /// Whether one of them waits for something else before it is told of.
    held_back: bool,
    /// With whom the daemon says they are matched.
    matched: HashMap<Gid, Vec<Gid>>,
    relays: BTreeMap<Group, Relay>,
    /// Samples of the session's publishers that were lost here, as far as the daemon knows.
    lost: HashMap<Gid, u64>,
    stand_ins: BTreeMap<Gid, Publisher>,
    /// The endpoints outside.
    world: HashMap<Gid, (DaemonId, Endpoint)>,
}

impl<'a> Served<'a> {
    fn new(common: &'a Common, connected: Connected) -> Self {
        // This end trusts its daemon with memory: there is one, and it takes what it is given credit
        // for.
        let incoming = Incoming::new(common.shared.config.max_message, Pool::new(u64::MAX));
        let socket = PassedFd::connection(connected.socket).trusted();
        Self {
            common,
            daemon: connected.welcome.daemon,
            pipe: Pipe::new(socket, incoming, Arc::new(Tally::default())),
            own: BTreeMap::new(),
            ending: BTreeSet::new(),
            held_back: false,
            matched: HashMap::new(),
            relays: BTreeMap::new(),
            lost: HashMap::new(),
            stand_ins: BTreeMap::new(),
            world: HashMap::new(),
        }
    }

    fn serve(&mut self) -> Result<(), End> {
        let mut begun = false;
        let mut finish_by = None;
        loop {
            let common = self.common;
            common.leader.clear();
            let blocked = self.pipe.blocked;
            common.leader.arm(blocked);
            let news = common.news.take() | !std::mem::replace(&mut begun, true);
            let (messages, more) = self.pipe.receive()?;
            let changed = !messages.is_empty();
            messages.into_iter().for_each(|message| self.handle(message));
            if news || changed || self.held_back || !self.ending.is_empty() {
                self.update()?;
            }
            let stand_ins = &self.stand_ins;
            self.pipe.publish(
                |gid| stand_ins.get(gid),
                |gid, samples| common.shared.lost(gid, samples),
            )?;
            let (own, relays, lost) = (&self.own, &self.relays, &mut self.lost);
            let sent = self.pipe.send(|gid| take(own, relays, lost, gid))?;
            let passed = self.pass_over();
            if common.finishes() {
                let by = *finish_by.get_or_insert_with(|| Instant::now() + LINGER);
                if self.is_drained() || Instant::now() >= by {
                    return Ok(());
                }
            }
            if more || sent || passed || self.pipe.blocked && !blocked {
                common.leader.disarm();
                continue;
            }
            self.pipe.sleep(&common.leader, &common.news, None);
        }
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Graph(graph) => self.graph(graph),
            Message::Matched(matched) => {
                self.matched.insert(matched.gid, matched.others);
            }
            Message::Refused(refused) => {
                tracing::error!(reason = refused.text, "the daemon refuses an endpoint");
            }
            // What a daemon never says is not worth more than not being heard.
            _ => {}
        }
    }

    fn graph(&mut self, graph: Graph) {
        let mut changes: BTreeMap<DaemonId, (Vec<Endpoint>, Vec<Gid>)> = BTreeMap::new();
        for gid in graph.removed {
            if let Some((daemon, _)) = self.world.remove(&gid) {
                changes.entry(daemon).or_default().1.push(gid);
            }
        }
        for item in graph.added {
            let daemon = item.daemon.unwrap_or(self.daemon);
            // This process knows better what its own endpoints are.
            if !item.endpoint.gid.is_of(&self.common.shared.id) {
                changes.entry(daemon).or_default().0.push(item.endpoint.clone());
                self.world.insert(item.endpoint.gid, (daemon, item.endpoint));
            }
        }
        for (daemon, (added, removed)) in changes {
            self.common.house.outside(daemon, added, removed);
        }
    }

    fn forget_world(&mut self) {
        let daemons: BTreeSet<DaemonId> = self.world.values().map(|(daemon, _)| *daemon).collect();
        daemons.iter().for_each(|daemon| self.common.house.outside_gone(daemon));
    }

    /// Brings what the daemon knows of the session, and the session of the world, up to date.
    fn update(&mut self) -> Result<(), End> {
        self.tell_endpoints()?;
        self.update_relays();
        self.end_publishers()?;
        self.update_stand_ins()
    }

    fn tell_endpoints(&mut self) -> Result<(), End> {
        let graph = self.common.outside.graph();
        let session = &self.common.shared.id;
        let gone: Vec<(Gid, EndpointKind)> = self
            .own
            .values()
            .filter(|e| !graph.endpoints.contains_key(&e.gid))
            .map(|e| (e.gid, e.kind))
            .collect();
        for (gid, kind) in gone {
            if kind == EndpointKind::Publisher {
                self.ending.insert(gid);
            } else {
                self.tell_gone(gid)?;
            }
        }
        self.held_back = false;
        for (gid, entry) in &graph.endpoints {
            let endpoint = &entry.endpoint;
            if !gid.is_of(session) || self.own.contains_key(gid) {
                continue;
            }
            if endpoint.kind == EndpointKind::Subscription && !self.is_served(endpoint) {
                self.held_back = true;
                continue;
            }
            self.pipe.say(&Message::Endpoint(Announce {
                endpoint: Endpoint::clone(endpoint),
                role: EndpointRole::Application,
                stands_for: Vec::new(),
                ring: None,
            }))?;
            self.own.insert(*gid, Arc::clone(endpoint));
            if endpoint.kind == EndpointKind::Publisher {
                self.pipe.outgoing.open(*gid);
            }
        }
        Ok(())
    }

    /// Whether a subscription receives from all stand-ins that there are for it: who outside counts it
    /// may rely on it.
    fn is_served(&self, subscription: &Endpoint) -> bool {
        self.stand_ins.values().all(|stand_in| {
            pairing(stand_in.endpoint(), subscription) != Pairing::Match
                || stand_in.matched().contains(&subscription.gid)
        })
    }

    fn tell_gone(&mut self, gid: Gid) -> Result<(), End> {
        self.own.remove(&gid);
        self.matched.remove(&gid);
        self.lost.remove(&gid);
        self.pipe.say(&Message::EndpointGone(Gone { gid }))
    }

    fn update_relays(&mut self) {
        let mut wanted: BTreeMap<Group, Wanted> = BTreeMap::new();
        for endpoint in self.own.values().filter(|e| e.kind == EndpointKind::Publisher) {
            let group = Group::of(endpoint);
            let readers = self.matched.get(&endpoint.gid).map_or(&[][..], Vec::as_slice);
            // History goes ahead of those who will ask for it; what is left is carried to its end.
            let rest = self.ending.contains(&endpoint.gid) && self.relays.contains_key(&group);
            if readers.is_empty() && group.volatile && !rest {
                continue;
            }
            let wanted = wanted.entry(group).or_default();
            wanted.depth = wanted.depth.max(endpoint.qos.depth);
            wanted.stands_for.extend(readers);
        }
        self.relays.retain(|group, _| wanted.contains_key(group));
        for (group, Wanted { depth, stands_for }) in wanted {
            let gids: Vec<Gid> = stands_for.iter().take(MAX_MATCHED).copied().collect();
            if let Some(relay) = self.relays.get_mut(&group) {
                if relay.stands_for != stands_for {
                    relay.subscription.set_stands_for(gids);
                    relay.stands_for = stands_for;
                }
                continue;
            }
            let spec = EndpointSpec::new(&*group.topic, &*group.type_name, group.qos(depth));
            match self.common.outside.create_relay(spec, gids) {
                Ok(subscription) => {
                    self.relays.insert(group, Relay { subscription, stands_for });
                }
                Err(error) => tracing::error!(topic = group.topic, %error, "nothing is relayed"),
            }
        }
    }

    /// Whether all that a publisher has published is with the daemon.
    fn has_left(&self, publisher: &Endpoint) -> bool {
        let relay = self.relays.get(&Group::of(publisher));
        relay.is_none_or(|relay| !relay.subscription.has_from(&publisher.gid))
            && self.pipe.outgoing.is_idle(&publisher.gid)
    }

    fn is_drained(&self) -> bool {
        self.own.values().all(|e| e.kind != EndpointKind::Publisher || self.has_left(e))
    }

    fn end_publishers(&mut self) -> Result<(), End> {
        let left =
            self.ending.iter().filter(|gid| self.own.get(gid).is_none_or(|e| self.has_left(e)));
        for gid in left.copied().collect::<Vec<_>>() {
            self.ending.remove(&gid);
            self.pipe.outgoing.close(&gid);
            self.tell_gone(gid)?;
        }
        Ok(())
    }

    fn update_stand_ins(&mut self) -> Result<(), End> {
        let mut wanted: BTreeMap<Gid, Vec<Gid>> = BTreeMap::new();
        for endpoint in self.own.values().filter(|e| e.kind == EndpointKind::Subscription) {
            for writer in self.matched.get(&endpoint.gid).into_iter().flatten() {
                wanted.entry(*writer).or_default().push(endpoint.gid);
            }
        }
        let gone: Vec<Gid> =
            self.stand_ins.keys().filter(|gid| !wanted.contains_key(gid)).copied().collect();
        for gid in gone {
            self.pipe.close(&gid);
            self.stand_ins.remove(&gid);
        }
        for (writer, readers) in wanted {
            if !self.stand_ins.contains_key(&writer) {
                // The graph may say later who it is.
                let Some((_, endpoint)) = self.world.get(&writer) else { continue };
                match self.common.outside.create_stand_in(endpoint.clone()) {
                    Ok(stand_in) => drop(self.stand_ins.insert(writer, stand_in)),
                    Err(error) => {
                        tracing::error!(%writer, %error, "a publisher cannot be received from");
                        continue;
                    }
                }
            }
            let matched = self.stand_ins[&writer].matched();
            if readers.iter().all(|reader| matched.contains(reader)) {
                self.pipe.open(writer)?;
            }
        }
        Ok(())
    }

    /// Takes what goes by way of another relay; whether there was any.
    fn pass_over(&self) -> bool {
        let mut any = false;
        for (group, relay) in &self.relays {
            for publisher in self.own.values().filter(|e| {
                e.kind == EndpointKind::Publisher
                    && e.topic == group.topic
                    && e.type_name == group.type_name
                    && Group::of(e) != *group
            }) {
                for _ in 0..BATCH {
                    if relay.subscription.take_from(&publisher.gid).is_none() {
                        break;
                    }
                    any = true;
                }
            }
        }
        any
    }
}

fn take(
    own: &BTreeMap<Gid, Arc<Endpoint>>,
    relays: &BTreeMap<Group, Relay>,
    lost: &mut HashMap<Gid, u64>,
    publisher: &Gid,
) -> Option<Departing<Sample>> {
    let relay = relays.get(&Group::of(own.get(publisher)?))?;
    let (content, now) = relay.subscription.take_from(publisher)?;
    let before = lost.insert(*publisher, now).unwrap_or(0);
    // A relay that attached anew counts from 0.
    let lost = now.checked_sub(before).unwrap_or(now);
    Some(Departing { meta: content.meta(), lost, content })
}
