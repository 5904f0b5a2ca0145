//! The end in a relayed session's own process.

mod relays;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use self::relays::{Group, Relay, take};
use super::{
    Pool, Tally,
    flow::Incoming,
    news::News,
    pipe::{End, Pipe},
};
use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing},
    ids::{DaemonId, Gid},
    passed::PassedFd,
    session::{
        Publisher, Session, SessionError, Shared,
        connect::{Caller, Connected},
        local::House,
        message::{Announce, EndpointRole, Gone, Graph, Message},
    },
    wait::ExternalLeader,
};

/// How long the end of a session waits for what its publishers left to be gone.
const LINGER: Duration = Duration::from_secs(1);
/// Between attempts to find a daemon.
const MIN_PAUSE: Duration = Duration::from_millis(100);
const MAX_PAUSE: Duration = Duration::from_secs(2);

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
                match self.common.outside.create_outsider(endpoint.clone()) {
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
}
