//! The daemon's end: the endpoints of a relayed session, in memory that every session maps.

use std::{
    collections::{BTreeMap, BTreeSet},
    os::fd::{AsFd, OwnedFd},
    sync::Arc,
};

use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::{
    MAX_ENDPOINTS, MAX_MATCHED, Pool, Tally,
    flow::{Departing, Incoming},
    news::News,
    pipe::{End, Pipe},
};
use crate::{
    config::Config,
    daemon::registry::parts,
    graph::{Endpoint, EndpointKind, GraphView},
    ids::{Gid, SessionId},
    passed::PassedFd,
    qos::{Durability, History, Qos, Reliability},
    session::{
        Node, Publisher, Session, SessionError, SessionOptions, Subscription,
        message::{
            Announce, EndpointRole, GraphItem, Matched, Message, PROTOCOL, Refused, Welcome,
        },
        socket,
    },
    shm::Sample,
    wait::ExternalLeader,
};

/// Samples of one pair that are passed over before others have their turn.
const BATCH: usize = 64;

/// What a relay is started with.
pub(crate) struct Far {
    /// The session's connection.
    pub(crate) socket: PassedFd,
    /// One end of a socket pair, at whose other end the control plane serves.
    pub(crate) inside: OwnedFd,
    pub(crate) config: Arc<Config>,
    /// The session's name and id.
    pub(crate) name: String,
    pub(crate) id: SessionId,
    /// Its process; 0 where that cannot be seen.
    pub(crate) pid: u32,
    pub(crate) tally: Arc<Tally>,
    pub(crate) pool: Arc<Pool>,
}

impl Far {
    /// Serves the session on a thread of its own, until it or the control plane ends it.
    pub(crate) fn start(self) -> std::io::Result<()> {
        std::thread::Builder::new().name("axon-relay".into()).spawn(move || self.run()).map(drop)
    }

    fn run(self) {
        let id = self.id;
        match self.open().and_then(Served::serve) {
            Ok(()) => {}
            Err(End::Socket(socket::SocketError::Closed)) => {
                tracing::debug!(session = %id, "a relayed session ended");
            }
            Err(why) => tracing::warn!(session = %id, %why, "a relayed session was disconnected"),
        }
    }

    fn open(self) -> Result<Served, End> {
        let Self { socket, inside, config, name, id, pid, tally, pool } = self;
        let say = |message: Message| {
            let packet = message.encode().map_err(|e| End::Other(e.to_string()))?;
            // The connection is new: its buffer has room.
            Ok::<(), End>(socket::send(&socket, &packet, &[])?)
        };
        let process = i32::try_from(pid).ok().and_then(Pid::from_raw);
        let process = process.and_then(|pid| pidfd_open(pid, PidfdFlags::empty()).ok());
        let session = match Session::over_as(id, inside, &config, SessionOptions::new(name)) {
            Ok(session) => session,
            Err(error) => {
                let text = error.to_string();
                let [variable, ours, theirs] = [const { String::new() }; 3];
                say(Message::Refused(Refused { variable, ours, theirs, text }))?;
                return Err(failed(&error));
            }
        };
        let news = News::new().map_err(|e| End::Other(e.to_string()))?;
        news.of(&session);
        let leader = session.segment().external_leader().map_err(|e| End::Other(e.to_string()))?;
        let daemon = session.daemon().unwrap_or_default();
        let welcome = Welcome { protocol: PROTOCOL, daemon, pid: std::process::id() };
        say(Message::Welcome(welcome))?;
        let incoming = Incoming::new(config.max_message, pool);
        Ok(Served {
            id,
            pipe: Pipe::new(socket, incoming, Arc::clone(&tally)),
            tally,
            publishers: BTreeMap::new(),
            subscriptions: BTreeMap::new(),
            nodes: BTreeMap::new(),
            told: BTreeMap::new(),
            sources: BTreeMap::new(),
            others: Vec::new(),
            graph: Arc::default(),
            draining: false,
            leader,
            news,
            process,
            session,
        })
    }
}

fn failed(error: &SessionError) -> End {
    End::Other(error.to_string())
}

/// A session that is served.
struct Served {
    id: SessionId,
    pipe: Pipe,
    tally: Arc<Tally>,
    publishers: BTreeMap<Gid, Publisher>,
    subscriptions: BTreeMap<Gid, Subscription>,
    nodes: BTreeMap<Gid, Node>,
    /// The others that each endpoint was said to be matched with.
    told: BTreeMap<Gid, BTreeSet<Gid>>,
    /// The publishers whose samples the session gets.
    sources: BTreeMap<Gid, Source>,
    /// The pairs, reader first, whose samples it gets by way of another of its subscriptions.
    others: Vec<(Gid, Gid)>,
    /// The graph as it was told.
    graph: Arc<GraphView>,
    /// Whether a publisher that is gone has samples left.
    draining: bool,
    leader: ExternalLeader,
    news: Arc<News>,
    process: Option<OwnedFd>,
    /// Last: what is above is of it.
    session: Session,
}

/// By what a publisher's samples are taken: they cross once, whatever the number of subscriptions.
struct Source {
    subscription: Gid,
    /// The samples that this one lost, as far as the session knows.
    lost: u64,
}

impl Served {
    fn serve(mut self) -> Result<(), End> {
        let mut begun = false;
        loop {
            self.leader.clear();
            let blocked = self.pipe.blocked;
            self.leader.arm(blocked);
            let news = self.news.take() | !std::mem::replace(&mut begun, true);
            if self.news.is_lost() {
                return Err(End::Other("the control plane dropped it".into()));
            }
            let (messages, more) = self.pipe.receive()?;
            let changed = !messages.is_empty();
            messages.into_iter().try_for_each(|message| self.handle(message))?;
            if news {
                self.tell_graph()?;
            }
            if news || changed || self.draining {
                self.match_up()?;
            }
            let (publishers, tally) = (&self.publishers, &self.tally);
            self.pipe.publish(|gid| publishers.get(gid), |_, samples| tally.lost(samples))?;
            let (sources, subscriptions) = (&mut self.sources, &self.subscriptions);
            let sent = self.pipe.send(|gid| take(sources, subscriptions, gid))?;
            let passed = self.pass_over();
            if more || sent || passed || self.pipe.blocked && !blocked {
                self.leader.disarm();
                continue;
            }
            let process = self.process.as_ref().map(AsFd::as_fd);
            if self.pipe.sleep(&self.leader, &self.news, process) {
                return Err(End::Other("its process ended".into()));
            }
        }
    }

    fn handle(&mut self, message: Message) -> Result<(), End> {
        match message {
            Message::Endpoint(announce) => self.announce(announce),
            Message::EndpointGone(gone) => {
                let gid = gone.gid;
                if self.publishers.remove(&gid).is_some() {
                    self.pipe.close(&gid);
                }
                self.subscriptions.remove(&gid);
                self.nodes.remove(&gid);
                self.told.remove(&gid);
                Ok(())
            }
            Message::Unknown(_) => Ok(()),
            _ => Err(End::Other("it sent a message that no relayed session sends".into())),
        }
    }

    fn announce(&mut self, announce: Announce) -> Result<(), End> {
        let Announce { endpoint, role, .. } = announce;
        let gid = endpoint.gid;
        if role != EndpointRole::Application || !gid.is_of(&self.id) {
            return Err(End::Other(format!("endpoint {gid} is not its own")));
        }
        let known = self.publishers.contains_key(&gid)
            || self.subscriptions.contains_key(&gid)
            || self.nodes.contains_key(&gid);
        let full = |count: usize| {
            (count >= MAX_ENDPOINTS).then_some("a relayed session may have no more of its kind")
        };
        let refusal = match endpoint.kind {
            _ if known => return Ok(()),
            _ if !endpoint.is_sane() => Some("a name, type hash or depth out of bounds"),
            EndpointKind::Publisher => full(self.publishers.len()),
            EndpointKind::Subscription => full(self.subscriptions.len()),
            EndpointKind::Node => full(self.nodes.len()),
            EndpointKind::Server | EndpointKind::Client => Some("services are not relayed"),
        };
        match refusal {
            Some(text) => self.refuse(&endpoint, text),
            None => self.adopt(endpoint),
        }
    }

    fn adopt(&mut self, endpoint: Endpoint) -> Result<(), End> {
        let gid = endpoint.gid;
        match endpoint.kind {
            EndpointKind::Publisher => match self.session.adopt_publisher(endpoint.clone()) {
                Ok(publisher) => {
                    self.publishers.insert(gid, publisher);
                    self.pipe.open(gid)?;
                }
                Err(error) => self.refuse(&endpoint, &error.to_string())?,
            },
            EndpointKind::Subscription => {
                self.subscriptions.insert(gid, self.session.adopt_subscription(endpoint));
            }
            _ => {
                self.nodes.insert(gid, self.session.adopt_node(endpoint));
            }
        }
        Ok(())
    }

    fn refuse(&mut self, endpoint: &Endpoint, why: &str) -> Result<(), End> {
        let [variable, ours, theirs] = [const { String::new() }; 3];
        let text = format!("endpoint {} of topic {:?}: {why}", endpoint.gid, endpoint.topic);
        self.pipe.say(&Message::Refused(Refused { variable, ours, theirs, text }))
    }

    /// Tells what changed in the graph.
    fn tell_graph(&mut self) -> Result<(), End> {
        let now = self.session.graph();
        let before = std::mem::replace(&mut self.graph, Arc::clone(&now));
        let same = |gid: &Gid| match (now.endpoints.get(gid), before.endpoints.get(gid)) {
            (Some(a), Some(b)) => a.daemon == b.daemon && a.endpoint == b.endpoint,
            _ => false,
        };
        let removed: Vec<Gid> = before.endpoints.keys().filter(|gid| !same(gid)).copied().collect();
        let added = now.endpoints.values().filter(|entry| !same(&entry.endpoint.gid));
        let added = added
            .map(|e| GraphItem { endpoint: Endpoint::clone(&e.endpoint), daemon: e.daemon })
            .collect::<Vec<_>>();
        if removed.is_empty() && added.is_empty() {
            return Ok(());
        }
        let all = parts(now.version, false, added.into_iter(), &removed, &BTreeSet::new(), false);
        all.into_iter().try_for_each(|part| self.pipe.say(&Message::Graph(part)))
    }

    /// Tells with whom the session's endpoints are matched, and decides by which of its subscriptions
    /// each publisher's samples go to it.
    fn match_up(&mut self) -> Result<(), End> {
        let mut changes = Vec::new();
        for (gid, publisher) in &self.publishers {
            changes.push((*gid, publisher.matched().into_iter().collect()));
        }
        self.draining = false;
        for (gid, subscription) in &self.subscriptions {
            let mut writers: BTreeSet<Gid> = subscription.matched().into_iter().collect();
            for writer in self.told.get(gid).into_iter().flatten() {
                // What it left comes first.
                let rest = || {
                    subscription.has_from(writer)
                        || self.sources.get(writer).is_some_and(|s| s.subscription == *gid)
                            && !self.pipe.outgoing.is_idle(writer)
                };
                if !writers.contains(writer) && rest() {
                    writers.insert(*writer);
                    self.draining = true;
                }
            }
            changes.push((*gid, writers));
        }
        self.choose(&changes);
        for (gid, others) in changes {
            if self.told.get(&gid) != Some(&others) {
                let shown = others.iter().take(MAX_MATCHED).copied().collect();
                self.pipe.say(&Message::Matched(Matched { gid, others: shown }))?;
                self.told.insert(gid, others);
            }
        }
        Ok(())
    }

    fn choose(&mut self, matched: &[(Gid, BTreeSet<Gid>)]) {
        let mut best: BTreeMap<Gid, Gid> = BTreeMap::new();
        self.others.clear();
        for (gid, writers) in matched {
            let Some(qos) = self.subscriptions.get(gid).map(|s| s.endpoint().qos) else { continue };
            for writer in writers {
                match best.insert(*writer, *gid) {
                    Some(other)
                        if rank(&self.subscriptions[&other].endpoint().qos) >= rank(&qos) =>
                    {
                        best.insert(*writer, other);
                        self.others.push((*gid, *writer));
                    }
                    Some(other) => self.others.push((other, *writer)),
                    None => {}
                }
            }
        }
        let gone: Vec<Gid> =
            self.sources.keys().filter(|writer| !best.contains_key(writer)).copied().collect();
        for writer in gone {
            self.sources.remove(&writer);
            self.pipe.outgoing.close(&writer);
        }
        for (writer, subscription) in best {
            let source = self.sources.entry(writer).or_insert(Source { subscription, lost: 0 });
            if source.subscription != subscription {
                *source = Source { subscription, lost: 0 };
            }
            self.pipe.outgoing.open(writer);
        }
    }

    /// Takes what comes by way of another subscription; whether there was any.
    fn pass_over(&self) -> bool {
        let mut any = false;
        for (reader, writer) in &self.others {
            let Some(subscription) = self.subscriptions.get(reader) else { continue };
            for _ in 0..BATCH {
                if subscription.take_from(writer).is_none() {
                    break;
                }
                any = true;
            }
        }
        any
    }
}

/// Which of two subscriptions to one publisher is the one that misses least.
fn rank(qos: &Qos) -> (bool, bool, bool, u32) {
    (
        qos.reliability == Reliability::Reliable,
        qos.durability == Durability::TransientLocal,
        qos.history == History::KeepAll,
        qos.depth,
    )
}

fn take(
    sources: &mut BTreeMap<Gid, Source>,
    subscriptions: &BTreeMap<Gid, Subscription>,
    writer: &Gid,
) -> Option<Departing<Sample>> {
    let source = sources.get_mut(writer)?;
    let (content, lost) = subscriptions.get(&source.subscription)?.take_from(writer)?;
    let before = std::mem::replace(&mut source.lost, lost);
    // A publisher that attached anew counts from 0.
    let lost = lost.checked_sub(before).unwrap_or(lost);
    Some(Departing { meta: content.meta(), lost, content })
}
