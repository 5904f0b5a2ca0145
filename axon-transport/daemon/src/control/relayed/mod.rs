//! The daemon's end of a relayed session: holds the session's endpoints in memory that every session can
//! map. One thread `axon-relay` for each session.

mod matching;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    os::fd::{AsFd, OwnedFd},
    sync::Arc,
    time::Instant,
};

use axon_shm::{
    ExternalLeader,
    ids::{Gid, SessionId},
    internal::{descriptors::PassedFd, peer_pidfd},
};
use axon_transport::{
    Node, Session, SessionError, SessionOptions, Subscription,
    config::Config,
    graph::{Endpoint, EndpointKind, GraphView},
    internal::{
        events::Alive,
        log_limit::LogLimit,
        registry::RelayCounters,
        session::{
            RemoteWriter,
            daemon::socket::{self, SocketError},
            relayed::{
                ArrivalPool, ChangeSignal, LINGER, MAX_CALLERS, MAX_ENDPOINTS,
                calls::{self, CallChannels},
                flow::{FlowChannel, IncomingFlow},
                pipe::{End, LossReport, RelaySocket},
            },
        },
        wire::session::{
            Announce, Asserted, EndpointRole, PROTOCOL, RelayGivenUp, RelayMatched, SessionMessage,
            SessionRefused, Welcome, WriterLeaving,
        },
    },
};
use rustix::io::Errno;

use self::matching::{RelayedSource, take};
use super::losses::Losses;

/// The cause under which samples of an ended writer count as lost.
const ENDED: &str = "publisher_ended";

/// The arguments of a relay's start.
pub(crate) struct DaemonRelay {
    /// The session's connection.
    pub(crate) socket: PassedFd,
    /// One end of a socket pair. The control plane serves the other end.
    pub(crate) inside: OwnedFd,
    pub(crate) config: Arc<Config>,
    /// The session's name and id.
    pub(crate) name: String,
    pub(crate) id: SessionId,
    pub(crate) tally: Arc<RelayCounters>,
    pub(crate) pool: Arc<ArrivalPool>,
    pub(crate) losses: Arc<Losses>,
}

impl DaemonRelay {
    /// Serves the session on a thread of its own, until it or the control plane ends it.
    pub(crate) fn start(self) -> std::io::Result<()> {
        std::thread::Builder::new().name("axon-relay".into()).spawn(move || self.run()).map(drop)
    }

    fn run(self) {
        let id = self.id;
        match self.open().and_then(RelayedSession::serve) {
            Ok(()) => {}
            Err(End::Socket(SocketError::Closed)) => {
                tracing::debug!(session = %id, "a relayed session ended");
            }
            Err(why) => tracing::warn!(session = %id, %why, "a relayed session was disconnected"),
        }
    }

    fn open(self) -> Result<RelayedSession, End> {
        let Self { socket, inside, config, name, id, tally, pool, losses } = self;
        let say = |message: SessionMessage| {
            let packet = message.encode().map_err(|e| End::Other(e.to_string()))?;
            // The connection is new: its buffer has room.
            Ok::<(), End>(socket::send(&socket, &packet, &[])?)
        };
        let process = match peer_pidfd(&socket) {
            Ok(process) => Some(process),
            Err(Errno::SRCH) => return Err(End::Gone),
            // The session is served as long as any process holds the connection.
            Err(error) => {
                tracing::debug!(session = %id, %error, "no pidfd of the session's process: its end shows when the socket closes");
                None
            }
        };
        let options = SessionOptions::new(name).callers(MAX_CALLERS).keep_refusals();
        let session = match Session::over_as(id, inside, &config, options) {
            Ok(session) => session,
            Err(error) => {
                say(SessionMessage::Refused(SessionRefused::because(error.to_string())))?;
                return Err(failed(&error));
            }
        };
        let change_signal = ChangeSignal::new().map_err(|e| End::Other(e.to_string()))?;
        session.set_listener(change_signal.listener());
        let leader = session.segment().external_leader().map_err(|e| End::Other(e.to_string()))?;
        let daemon = session.daemon().unwrap_or_default();
        let pid = std::process::id();
        let welcome = Welcome { protocol: PROTOCOL, daemon, pid, ranges: Some(true) };
        say(SessionMessage::Welcome(welcome))?;
        let incoming = IncomingFlow::new(config.max_message, pool);
        Ok(RelayedSession {
            id,
            pipe: RelaySocket::new(socket, incoming, Arc::clone(&tally)),
            tally,
            losses,
            writers: BTreeMap::new(),
            subscriptions: BTreeMap::new(),
            nodes: BTreeMap::new(),
            told: BTreeMap::new(),
            sources: BTreeMap::new(),
            calls: CallChannels::default(),
            callers: BTreeMap::new(),
            alive: Alive::default(),
            unreached: BTreeMap::new(),
            graph: Arc::default(),
            left: VecDeque::new(),
            given_up: LogLimit::default(),
            begun: Instant::now(),
            leader,
            change_signal,
            process,
            session,
        })
    }
}

fn failed(error: &SessionError) -> End {
    End::Other(error.to_string())
}

/// Counts of one publisher's samples that do not reach their destination.
#[derive(Default)]
struct UndeliverableSamples {
    /// Samples that arrived and could not be written.
    unwritten: u64,
    /// Number of samples that were reported to its process.
    told: u64,
}

impl UndeliverableSamples {
    /// Returns the number of samples to report, if readers gave up `given_up` samples in all.
    fn given_up_since(&mut self, given_up: u64) -> u64 {
        let all = given_up.saturating_add(self.unwritten);
        all.saturating_sub(std::mem::replace(&mut self.told, all))
    }
}

/// A relayed session.
struct RelayedSession {
    id: SessionId,
    pipe: RelaySocket,
    tally: Arc<RelayCounters>,
    /// The daemon's counts of lost samples.
    losses: Arc<Losses>,
    /// The publishers, clients and servers of the session.
    writers: BTreeMap<Gid, RemoteWriter>,
    subscriptions: BTreeMap<Gid, Subscription>,
    nodes: BTreeMap<Gid, Node>,
    /// The matches of each endpoint that were sent to the session.
    told: BTreeMap<Gid, BTreeSet<Gid>>,
    /// The publishers whose samples the session gets.
    sources: BTreeMap<Gid, RelayedSource>,
    /// The requests to its servers.
    calls: CallChannels,
    /// The clients for which its process has stand-ins, by server: responses to them may come.
    callers: BTreeMap<Gid, BTreeSet<Gid>>,
    alive: Alive,
    /// The undeliverable samples of its publishers.
    unreached: BTreeMap<Gid, UndeliverableSamples>,
    /// The graph that was sent to the session.
    graph: Arc<GraphView>,
    /// The pairs of an endpoint of the session and a partner that is gone and has left messages, in the order in which
    /// the partners went.
    left: VecDeque<(Gid, Gid)>,
    /// The rate limit of log lines about pairs in `left` that were given up.
    given_up: LogLimit,
    /// The time at which the session began, from which leases and log lines count.
    begun: Instant,
    leader: ExternalLeader,
    change_signal: Arc<ChangeSignal>,
    process: Option<OwnedFd>,
    /// The last field: the fields above belong to the session, and are dropped first.
    session: Session,
}

impl RelayedSession {
    fn serve(mut self) -> Result<(), End> {
        let mut begun = false;
        loop {
            self.leader.clear();
            let waits = self.pipe.waits_for_readers();
            self.leader.arm(waits);
            let signalled = self.change_signal.take() | !std::mem::replace(&mut begun, true);
            if self.change_signal.is_lost() {
                // Usually the daemon and its process are ending. Its readers must not report before that they have
                // left: their undelivered samples are kept for the next daemon.
                self.pipe.hang_up();
                std::thread::sleep(LINGER);
                return Err(End::Other("the control plane dropped it".into()));
            }
            let (messages, more) = self.pipe.receive()?;
            let changed = messages.iter().any(|m| !matches!(m, SessionMessage::Credit(_)));
            messages.into_iter().try_for_each(|message| self.handle(message))?;
            if signalled {
                self.tell_refused()?;
                self.tell_graph()?;
            }
            if signalled || changed || !self.left.is_empty() {
                self.match_up()?;
            }
            let leased = self.subscriptions.values().flat_map(Subscription::assertions);
            for publishers in self.alive.due_assertions(self.begun.elapsed(), leased) {
                self.pipe.say(&SessionMessage::Asserted(Asserted { publishers }))?;
            }
            self.write()?;
            if self.pipe.is_over() {
                return self.drain();
            }
            let writers = &self.writers;
            let find = |gid: &Gid| writers.get(gid);
            let (sources, subscriptions) = (&mut self.sources, &self.subscriptions);
            let calls = &mut self.calls;
            let sent = self.pipe.send(|channel| {
                if channel.client.is_some() {
                    calls::response(channel, find)
                } else if let Some(source) = sources.get_mut(&channel.writer) {
                    take(source, subscriptions, &channel.writer)
                } else {
                    calls.request(&channel.writer, find)
                }
            })?;
            let passed = self.pass_over();
            if more || sent || passed || self.pipe.waits_for_readers() && !waits {
                self.leader.disarm();
                continue;
            }
            let process = self.process.as_ref().map(AsFd::as_fd);
            let left = self.alive.left(self.begun.elapsed());
            self.pipe.sleep(&self.leader, &self.change_signal, process, left);
        }
    }

    /// Writes the messages that came, and reports the results to the process.
    fn write(&mut self) -> Result<(), End> {
        let (writers, tally, unreached) = (&self.writers, &self.tally, &mut self.unreached);
        let losses = &self.losses;
        let credits = self.pipe.write(
            |gid| writers.get(gid),
            |gid, loss| {
                tally.lost(loss.samples());
                let cause = match loss {
                    LossReport::Before { .. } => "queue",
                    LossReport::Unwritten => "ring",
                };
                if let Some(writer) = writers.get(gid) {
                    losses.add(&writer.endpoint().topic, cause, loss.samples());
                }
                if let LossReport::Unwritten = loss {
                    unreached.entry(*gid).or_default().unwritten += 1;
                }
            },
        );
        let publishers: BTreeSet<Gid> = credits.iter().map(|credit| credit.publisher).collect();
        for writer in publishers {
            let Some(given_up) = self.writers.get(&writer).and_then(RemoteWriter::given_up) else {
                continue;
            };
            let samples = self.unreached.entry(writer).or_default().given_up_since(given_up);
            if samples > 0 {
                // Sent ahead of the credit by which the samples count as acknowledged.
                self.pipe.say(&SessionMessage::GivenUp(RelayGivenUp {
                    reader: writer,
                    writer,
                    samples,
                }))?;
            }
        }
        self.pipe.give_back(credits)
    }

    /// Writes the remaining messages of a process that is gone, after all of them were received, for as long as readers
    /// free space for them. No endpoint counts its endpoints any more.
    fn drain(mut self) -> Result<(), End> {
        let mut end = Instant::now() + LINGER;
        self.subscriptions.clear();
        self.nodes.clear();
        self.writers.values().for_each(|remote_writer| remote_writer.leave(true));
        let mut left = self.pipe.unpublished();
        while self.pipe.is_blocked() && !self.change_signal.is_lost() && Instant::now() < end {
            self.leader.clear();
            self.leader.arm(true);
            self.change_signal.take();
            self.write()?;
            let before = std::mem::replace(&mut left, self.pipe.unpublished());
            if before != left {
                end = Instant::now() + LINGER;
            }
            if self.pipe.is_blocked() {
                let left = end.saturating_duration_since(Instant::now());
                self.pipe.sleep(&self.leader, &self.change_signal, None, Some(left));
            }
        }
        self.discard_all(&left);
        Err(SocketError::Closed.into())
    }

    /// Counts and logs by topic the remaining samples of the ended process, because no reader takes them.
    fn discard_all(&self, left: &BTreeMap<Gid, u64>) {
        let mut topics: BTreeMap<&str, u64> = BTreeMap::new();
        for (gid, samples) in left {
            let Some(writer) = self.writers.get(gid) else { continue };
            *topics.entry(&writer.endpoint().topic).or_default() += samples;
        }
        for (topic, samples) in &topics {
            self.tally.lost(*samples);
            self.losses.add(topic, ENDED, *samples);
        }
        let samples: u64 = topics.values().sum();
        // This logs one line for all topics.
        if let Some((topic, most)) = topics.iter().max_by_key(|(_, samples)| **samples) {
            let others = topics.len() - 1;
            tracing::warn!(
                session = %self.id, topic, most, others, samples,
                "discarded samples of a process that ended: no reader takes them"
            );
        }
        let open = || self.writers.values().map(RemoteWriter::endpoint);
        let mut publishers = open().filter(|e| e.kind == EndpointKind::Publisher);
        if let Some(Endpoint { topic, .. }) = publishers.next() {
            let others = publishers.count();
            tracing::warn!(
                session = %self.id, topic, others,
                "the process ended and had not ended its publishers: samples that it had not sent are lost"
            );
        }
    }

    fn handle(&mut self, message: SessionMessage) -> Result<(), End> {
        match message {
            SessionMessage::Endpoint(announce) => self.announce(announce),
            SessionMessage::EndpointGone(gone) => {
                self.forget(&gone.gid);
                self.pipe.say(&SessionMessage::EndpointGone(gone))
            }
            SessionMessage::Leaving(WriterLeaving { gid, leaving }) => {
                // The writer may have been refused.
                if let Some(remote_writer) = self.writers.get(&gid) {
                    remote_writer.leave(leaving);
                }
                Ok(())
            }
            SessionMessage::Matched(matched) => self.callers(matched),
            SessionMessage::Asserted(asserted) => {
                let own = asserted.publishers.iter().filter_map(|gid| self.writers.get(gid));
                own.for_each(RemoteWriter::assert_alive);
                Ok(())
            }
            SessionMessage::Credit(credit) => {
                self.pipe.outgoing.credit(&credit);
                if let (Some(client), Some(number)) = (&credit.client, credit.done)
                    && let Some(client) = self.writers.get(client)
                {
                    client.finish_through(&credit.publisher, number);
                }
                if let Some(source) = self.sources.get_mut(&credit.publisher) {
                    source.done = source.done.max(credit.done);
                    source.acknowledge(&self.subscriptions, &credit.publisher);
                } else if let (None, Some(number)) = (&credit.client, credit.done) {
                    let writers = &self.writers;
                    self.calls.finish(&credit.publisher, number, |gid| writers.get(gid));
                }
                Ok(())
            }
            SessionMessage::Unknown(_) => Ok(()),
            _ => Err(End::Other("it sent a message that no relayed session sends".into())),
        }
    }

    fn announce(&mut self, announce: Announce) -> Result<(), End> {
        let Announce { endpoint, role, .. } = announce;
        let gid = endpoint.gid;
        if role != EndpointRole::Application || !gid.is_of(&self.id) {
            return Err(End::Other(format!("endpoint {gid} is not its own")));
        }
        let known = self.writers.contains_key(&gid)
            || self.subscriptions.contains_key(&gid)
            || self.nodes.contains_key(&gid);
        let refusal = match endpoint.kind {
            _ if known => return Ok(()),
            _ if !endpoint.is_sane() => Some("a name, type hash or depth out of bounds"),
            kind if self.count(kind) >= MAX_ENDPOINTS => {
                Some("a relayed session may have no more of its kind")
            }
            _ => None,
        };
        match refusal {
            Some(text) => self.refuse(&endpoint, text),
            None => self.adopt(endpoint),
        }
    }

    fn count(&self, kind: EndpointKind) -> usize {
        match kind {
            EndpointKind::Subscription => self.subscriptions.len(),
            EndpointKind::Node => self.nodes.len(),
            _ => self
                .writers
                .values()
                .filter(|remote_writer| remote_writer.endpoint().kind == kind)
                .count(),
        }
    }

    fn adopt(&mut self, endpoint: Endpoint) -> Result<(), End> {
        let gid = endpoint.gid;
        match endpoint.kind {
            EndpointKind::Subscription => {
                self.subscriptions.insert(gid, self.session.adopt_subscription(endpoint));
            }
            EndpointKind::Node => {
                self.nodes.insert(gid, self.session.adopt_node(endpoint));
            }
            kind => match RemoteWriter::adopt(&self.session, endpoint.clone()) {
                Ok(remote_writer) => {
                    self.writers.insert(gid, remote_writer);
                    // A server's responses are a channel for each of its clients.
                    if kind != EndpointKind::Server {
                        self.pipe.open_in(FlowChannel::of(gid))?;
                    }
                }
                Err(error) => self.refuse(&endpoint, &error.to_string())?,
            },
        }
        Ok(())
    }

    /// Removes an endpoint that is gone. Messages for it are not wanted any more from here on, which both ends know
    /// from the answer: its channels must not be mistaken for later channels of the same name.
    fn forget(&mut self, gid: &Gid) {
        if self.writers.remove(gid).is_some() {
            self.pipe.retain(|channel| channel.writer != *gid);
        }
        self.subscriptions.remove(gid);
        self.nodes.remove(gid);
        self.callers.remove(gid);
        self.unreached.remove(gid);
        if self.told.remove(gid).is_some() {
            self.close_unwanted();
        }
    }

    /// Records the clients of a server for which the process has stand-ins. The responses to them pass through the
    /// process.
    fn callers(&mut self, matched: RelayMatched) -> Result<(), End> {
        let RelayMatched { gid, others } = matched;
        let others: BTreeSet<Gid> = others.into_iter().collect();
        match self.writers.get(&gid) {
            Some(RemoteWriter::Server(_)) => {}
            // The endpoint was refused.
            None if gid.is_of(&self.id) => return Ok(()),
            _ => return Err(End::Other(format!("{gid} is no server of its own"))),
        }
        self.callers.remove(&gid);
        let elsewhere: usize = self.callers.values().map(BTreeSet::len).sum();
        if elsewhere + others.len() > MAX_CALLERS {
            return Err(End::Other(format!("its servers answer more than {MAX_CALLERS} clients")));
        }
        let wanted = |client: Option<Gid>| client.is_some_and(|client| others.contains(&client));
        self.pipe.retain(|channel| channel.writer != gid || wanted(channel.client));
        for client in &others {
            self.pipe.open_in(FlowChannel::between(gid, *client))?;
        }
        self.callers.insert(gid, others);
        Ok(())
    }

    /// Sends the process the refusals of the control plane, like those of the relay itself.
    fn tell_refused(&mut self) -> Result<(), End> {
        for (gid, text) in self.session.refused() {
            self.forget(&gid);
            let refused = SessionRefused { endpoint: Some(gid), ..SessionRefused::because(text) };
            self.pipe.say(&SessionMessage::Refused(refused))?;
        }
        for text in self.session.take_refusals() {
            self.pipe.say(&SessionMessage::Refused(SessionRefused::because(text)))?;
        }
        Ok(())
    }

    fn refuse(&mut self, endpoint: &Endpoint, why: &str) -> Result<(), End> {
        self.pipe.say(&SessionMessage::Refused(SessionRefused::of(endpoint, why)))
    }
}
