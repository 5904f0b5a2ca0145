//! The session's end of a relay: a thread in the session's own process that carries samples to and from the daemon.

mod reconnect;
mod relays;
mod resumed;
mod stand_ins;

use std::{
    cell::OnceCell,
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use axon_shm::{ExternalLeader, internal::descriptors::PassedFd};

use self::{
    relays::SessionRelay,
    stand_ins::{KeptCalls, LeftByConnection, SessionStandIn},
};
use super::{
    calls::{self, CallChannels},
    flow::{ArrivalPool, FlowChannel, IncomingFlow},
    pipe::{End, LossReport, RelaySocket},
    unanswered::Unanswered,
};
use crate::{
    events::Alive,
    graph::{Endpoint, EndpointKind, reads, writes},
    ids::{DaemonId, Gid},
    registry::RelayCounters,
    session::{
        clock,
        control::in_process::LocalRegistry,
        core::ChangeSignal,
        daemon::{connect::Connected, socket::SocketError},
        error::SessionError,
        handle::Session,
        relay_thread::RelayThread,
        state::SessionShared,
    },
    wire::session::{
        Announce, Asserted, EndpointRole, Gone, RelayGivenUp, SessionGraph, SessionMessage,
        SessionRefused, WriterLeaving,
    },
};

/// The state that outlives a connection.
struct RelayContext {
    /// The session.
    shared: Arc<SessionShared>,
    local_registry: Arc<LocalRegistry>,
    /// The session that represents the endpoints outside this process.
    outside: Session,
    leader: ExternalLeader,
    change_signal: Arc<ChangeSignal>,
    finish: Arc<AtomicBool>,
    finish_by: OnceCell<Instant>,
    reason: String,
}

/// Starts the thread that carries the samples of `shared`.
///
/// # Errors
/// The process has no descriptors left, or no thread can be started.
pub(in crate::session) fn start(
    shared: Arc<SessionShared>,
    local_registry: Arc<LocalRegistry>,
    outside: Session,
    connected: Connected,
    reason: String,
) -> Result<RelayThread, SessionError> {
    let system = |what| move |source: std::io::Error| SessionError::System { what, source };
    let change_signal = ChangeSignal::new().map_err(system("creating an eventfd"))?;
    outside.set_listener(change_signal.listener());
    let finish = Arc::new(AtomicBool::new(false));
    let leader = outside.segment().external_leader()?;
    let common = RelayContext {
        shared,
        local_registry,
        outside,
        leader,
        change_signal: Arc::clone(&change_signal),
        finish: Arc::clone(&finish),
        finish_by: OnceCell::new(),
        reason,
    };
    RelayThread::spawn(finish, change_signal, move || common.run(connected))
        .map_err(system("starting the relay's thread"))
}

impl RelayContext {
    fn run(self, connected: Connected) {
        let mut next = Some(connected);
        let mut kept = LeftByConnection::default();
        while let Some(connected) = next {
            let since = Instant::now();
            let daemon = connected.welcome.daemon;
            let mut served = RelayConnection::new(&self, connected, std::mem::take(&mut kept));
            self.shared.set_daemon(Some(daemon));
            let why = served.serve();
            served.forget_world();
            kept = LeftByConnection { relays: served.keep_relays(), calls: served.keep_calls() };
            drop(served);
            if self.finishes() && (why.is_ok() || kept.relays.is_empty()) {
                break;
            }
            if let Err(why) = why {
                tracing::warn!(%why, "the connection to the daemon is lost");
            }
            self.shared.set_daemon(None);
            next = self.reconnect(since.elapsed() < Duration::from_secs(1), &mut kept);
        }
        kept.relays.values().for_each(SessionRelay::give_up);
    }
}

/// The state of one connection to a daemon.
struct RelayConnection<'a> {
    common: &'a RelayContext,
    daemon: DaemonId,
    pipe: RelaySocket,
    /// The session's endpoints that were announced to the daemon.
    own: BTreeMap<Gid, Arc<Endpoint>>,
    /// The session's endpoints that the daemon has refused.
    refused: BTreeSet<Gid>,
    /// Writing endpoints among `own` that are gone and may have left messages, each with whether the daemon was told
    /// that it is leaving.
    ending: BTreeMap<Gid, bool>,
    /// True if an endpoint of the session cannot be announced yet.
    held_back: bool,
    /// Reading endpoints that are gone, until the daemon has confirmed that.
    parting: BTreeSet<Gid>,
    /// The matches of the session's endpoints, as the daemon reports them.
    matched: HashMap<Gid, BTreeSet<Gid>>,
    /// A relay for each of the session's publishers whose samples cross.
    relays: BTreeMap<Gid, SessionRelay>,
    stand_ins: BTreeMap<Gid, SessionStandIn>,
    /// The requests of the session's clients.
    calls: CallChannels,
    /// The clients' requests that have no response.
    unanswered: Unanswered,
    /// The time at which each client was announced to the daemon.
    asking: HashMap<Gid, Instant>,
    /// Clients whose requests wait until the daemon has matched them with all servers that they count, each with the
    /// end of the wait.
    settling: HashMap<Gid, Instant>,
    /// The clients outside this process that each of its servers may answer, as reported to the daemon.
    callers: BTreeMap<Gid, BTreeSet<Gid>>,
    alive: Alive,
    /// The endpoints outside this process, each with its daemon.
    world: HashMap<Gid, (DaemonId, Endpoint)>,
}

impl<'a> RelayConnection<'a> {
    fn new(common: &'a RelayContext, connected: Connected, kept: LeftByConnection) -> Self {
        let LeftByConnection { relays, calls } = kept;
        let KeptCalls { stand_ins, calls, mut unanswered, response_log, .. } =
            calls.for_daemon(connected.welcome.daemon);
        // A client may have ended while there was no daemon.
        let graph = common.outside.graph();
        unanswered.keep_clients(|client| graph.endpoints.contains_key(client));
        // This end needs no bound for its daemon: there is one daemon, and this end takes only as much as it gives
        // credit for.
        let incoming =
            IncomingFlow::new(common.shared.core.config.max_message, ArrivalPool::new(u64::MAX));
        let socket = PassedFd::connection(connected.socket).trusted();
        let mut pipe = RelaySocket::new(socket, incoming, Arc::new(RelayCounters::default()));
        pipe.response_log = Some(response_log);
        Self {
            common,
            daemon: connected.welcome.daemon,
            pipe,
            own: BTreeMap::new(),
            refused: BTreeSet::new(),
            ending: BTreeMap::new(),
            held_back: false,
            parting: BTreeSet::new(),
            matched: HashMap::new(),
            relays,
            stand_ins,
            calls,
            unanswered,
            asking: HashMap::new(),
            settling: HashMap::new(),
            callers: BTreeMap::new(),
            alive: Alive::default(),
            world: HashMap::new(),
        }
    }

    fn serve(&mut self) -> Result<(), End> {
        let mut begun = false;
        loop {
            let common = self.common;
            common.leader.clear();
            let waiting = self.pipe.waits_for_readers();
            common.leader.arm(waiting);
            let signalled = common.change_signal.take() | !std::mem::replace(&mut begun, true);
            let (messages, more) = self.pipe.receive()?;
            let changed = messages.iter().any(|m| !matches!(m, SessionMessage::Credit(_)));
            messages.into_iter().for_each(|message| self.handle(message));
            let waits = self.held_back
                || !self.ending.is_empty()
                || !self.settling.is_empty()
                || self.stand_ins.values().any(SessionStandIn::is_kept)
                || self.relays.values().any(SessionRelay::is_carried_over);
            if signalled || changed || waits {
                self.update()?;
            }
            let leased = self.relays.values().flat_map(SessionRelay::assertions);
            for publishers in
                self.alive.due_assertions(Duration::from_nanos(clock::monotonic()), leased)
            {
                self.pipe.say(&SessionMessage::Asserted(Asserted { publishers }))?;
            }
            let stand_ins = &self.stand_ins;
            let find = |gid: &Gid| stand_ins.get(gid).map(SessionStandIn::remote_writer);
            let credits = self.pipe.write(find, |gid, loss| {
                let first = matches!(loss, LossReport::Before { first: true, .. });
                common.shared.lost(gid, loss.samples(), first);
            });
            for credit in &credits {
                if let (Some(client), Some(number)) = (credit.client, credit.done) {
                    self.unanswered.answered(client, &credit.publisher, number);
                }
            }
            self.pipe.give_back(credits)?;
            if self.pipe.is_over() {
                return Err(SocketError::Closed.into());
            }
            let (own, relays) = (&self.own, &mut self.relays);
            let (calls, settling) = (&mut self.calls, &self.settling);
            let unanswered = &mut self.unanswered;
            let sent = self.pipe.send(|channel| {
                let FlowChannel { writer, client } = channel;
                match own.get(writer)? {
                    _ if client.is_some() => calls::response(channel, find),
                    _ if settling.contains_key(writer) => None,
                    endpoint if endpoint.kind == EndpointKind::Client => {
                        calls.request_to_send(writer, unanswered, find)
                    }
                    _ => relays.get_mut(writer)?.take(),
                }
            })?;
            let passed = self.calls.pass_over(find);
            let finish_by = common.finish_by();
            if finish_by.is_some_and(|by| self.is_drained() || Instant::now() >= by) {
                return Ok(());
            }
            if more || sent || passed || self.pipe.waits_for_readers() && !waiting {
                common.leader.disarm();
                continue;
            }
            let end = finish_by.map(|by| by.saturating_duration_since(Instant::now()));
            let left = self
                .alive
                .left(Duration::from_nanos(clock::monotonic()))
                .into_iter()
                .chain(self.settled_in())
                .chain(self.kept_for())
                .chain(self.relays.values().filter_map(SessionRelay::waits_for))
                .chain(end)
                .min();
            self.pipe.sleep(&common.leader, &common.change_signal, None, left);
        }
    }

    fn handle(&mut self, message: SessionMessage) {
        match message {
            SessionMessage::Graph(graph) => self.graph(graph),
            SessionMessage::Matched(matched) => self.rematch(matched),
            SessionMessage::EndpointGone(gone) => self.part(&gone.gid),
            SessionMessage::Credit(credit) => {
                self.pipe.outgoing.credit(&credit);
                if let (Some(client), Some(number)) = (&credit.client, credit.done)
                    && let Some(client) = self.stand_ins.get(client)
                {
                    client.remote_writer().finish_through(&credit.publisher, number);
                }
                if let Some(relay) = self.relays.get(&credit.publisher)
                    && let Some(sequence) = credit.done
                {
                    relay.acknowledge(sequence);
                }
            }
            // It comes before the credit that confirms the samples.
            SessionMessage::GivenUp(RelayGivenUp { writer, samples, .. }) => {
                if let Some(relay) = self.relays.get(&writer) {
                    relay.lose(samples);
                }
            }
            SessionMessage::Asserted(asserted) => {
                let named = asserted.publishers.iter().filter_map(|gid| self.stand_ins.get(gid));
                named.for_each(|stand_in| stand_in.remote_writer().assert_alive());
            }
            SessionMessage::Refused(SessionRefused { endpoint, text: reason, .. }) => {
                tracing::error!(reason, "the daemon refuses an endpoint");
                if let Some(gid) = endpoint {
                    self.refuse(gid, reason);
                }
            }
            // A message that a daemon never sends is ignored.
            _ => {}
        }
    }

    fn graph(&mut self, graph: SessionGraph) {
        let mut changes: BTreeMap<DaemonId, (Vec<Endpoint>, Vec<Gid>)> = BTreeMap::new();
        for gid in graph.removed {
            if let Some((daemon, _)) = self.world.remove(&gid) {
                changes.entry(daemon).or_default().1.push(gid);
            }
        }
        for item in graph.added {
            let daemon = item.daemon.unwrap_or(self.daemon);
            // The local registry describes this process's own endpoints.
            if !item.endpoint.gid.is_of(&self.common.shared.core.id) {
                changes.entry(daemon).or_default().0.push(item.endpoint.clone());
                self.world.insert(item.endpoint.gid, (daemon, item.endpoint));
            }
        }
        for (daemon, (added, removed)) in changes {
            self.common.local_registry.outside(daemon, added, removed);
        }
    }

    fn forget_world(&mut self) {
        let daemons: BTreeSet<DaemonId> = self.world.values().map(|(daemon, _)| *daemon).collect();
        daemons.iter().for_each(|daemon| self.common.local_registry.outside_gone(daemon));
    }

    /// Brings the daemon's knowledge of the session, and the session's knowledge of remote endpoints, up to date.
    fn update(&mut self) -> Result<(), End> {
        self.tell_endpoints()?;
        self.announce_ended()?;
        self.update_relays();
        self.end_writers()?;
        self.forget_overdue();
        self.update_stand_ins()?;
        self.note_leaving();
        self.update_calls()?;
        let matched = |e: &Endpoint| self.matched.get(&e.gid).is_some_and(|all| !all.is_empty());
        let read = self.own.values().filter(|e| e.kind == EndpointKind::Publisher && matched(e));
        self.alive.watch(read.filter_map(|e| e.qos.lease));
        Ok(())
    }

    fn tell_endpoints(&mut self) -> Result<(), End> {
        let common = self.common;
        let graph = common.outside.graph();
        let session = &common.shared.core.id;
        let gone: Vec<(Gid, EndpointKind)> = self
            .own
            .values()
            .filter(|e| !graph.endpoints.contains_key(&e.gid))
            .map(|e| (e.gid, e.kind))
            .collect();
        for (gid, kind) in gone {
            if writes(kind) {
                self.ending.entry(gid).or_default();
            } else {
                self.tell_gone(gid)?;
            }
        }
        self.refused.retain(|gid| graph.endpoints.contains_key(gid));
        self.held_back = false;
        for (gid, entry) in &graph.endpoints {
            let endpoint = &entry.endpoint;
            let known = self.own.contains_key(gid) || self.refused.contains(gid);
            if !gid.is_of(session) || known {
                continue;
            }
            if !self.is_served(endpoint) {
                self.held_back = true;
                continue;
            }
            self.announce(endpoint)?;
            if endpoint.kind == EndpointKind::Client {
                self.asking.insert(*gid, Instant::now());
            }
        }
        Ok(())
    }

    fn announce(&mut self, endpoint: &Arc<Endpoint>) -> Result<(), End> {
        self.pipe.say(&SessionMessage::Endpoint(Announce {
            endpoint: Endpoint::clone(endpoint),
            role: EndpointRole::Application,
            stands_for: Vec::new(),
            ring: None,
            only: None,
        }))?;
        self.own.insert(endpoint.gid, Arc::clone(endpoint));
        // A server's responses are a channel for each of its clients.
        if matches!(endpoint.kind, EndpointKind::Publisher | EndpointKind::Client) {
            self.pipe.open_out(FlowChannel::of(endpoint.gid));
        }
        Ok(())
    }

    /// Announces once more the publishers that ended before the next daemon had all their samples.
    fn announce_ended(&mut self) -> Result<(), End> {
        let kept = self.relays.values_mut().filter(|relay| relay.is_carried_over());
        let untold = kept.filter(|relay| !self.own.contains_key(&relay.publisher().gid));
        let untold: Vec<_> = untold.map(SessionRelay::resume).collect();
        for endpoint in untold {
            self.announce(&endpoint)?;
            self.ending.insert(endpoint.gid, false);
        }
        Ok(())
    }

    fn tell_gone(&mut self, gid: Gid) -> Result<(), End> {
        let Some(endpoint) = self.let_go(&gid) else { return Ok(()) };
        if reads(endpoint.kind) {
            self.parting.insert(gid);
        } else {
            self.matched.remove(&gid);
        }
        self.pipe.say(&SessionMessage::EndpointGone(Gone { gid }))
    }

    /// Handles the daemon's refusal of an endpoint: the daemon does not know the endpoint.
    fn refuse(&mut self, gid: Gid, why: String) {
        if self.let_go(&gid).is_some() {
            self.ending.remove(&gid);
            self.matched.remove(&gid);
            self.refused.insert(gid);
            if let Some(relay) = self.relays.remove(&gid) {
                relay.give_up();
            }
        }
        self.common.shared.refuse(gid, why);
    }

    /// Stops all outgoing messages of an endpoint of the session. Returns the endpoint, if it was announced.
    fn let_go(&mut self, gid: &Gid) -> Option<Arc<Endpoint>> {
        self.callers.remove(gid);
        self.asking.remove(gid);
        self.unanswered.forget_client(gid);
        self.pipe.outgoing.retain(|channel| channel.writer != *gid);
        self.own.remove(gid)
    }

    fn is_drained(&self) -> bool {
        self.own.values().all(|e| self.has_left(e))
    }

    /// Returns whether the daemon has all messages of an endpoint.
    fn has_left(&self, endpoint: &Endpoint) -> bool {
        match endpoint.kind {
            EndpointKind::Publisher => self.is_published(&endpoint.gid),
            EndpointKind::Client => self.is_asked(&endpoint.gid),
            EndpointKind::Server => self.is_answered(&endpoint.gid),
            EndpointKind::Subscription | EndpointKind::Node => true,
        }
    }

    fn end_writers(&mut self) -> Result<(), End> {
        for gid in self.ending.keys().copied().collect::<Vec<_>>() {
            if self.own.get(&gid).is_none_or(|endpoint| self.has_left(endpoint)) {
                self.ending.remove(&gid);
                self.tell_gone(gid)?;
            } else if self.is_revived(&gid) {
                // The daemon tells readers that a publisher is leaving only if they knew the publisher before.
            } else if self.ending.insert(gid, true) == Some(false) {
                self.pipe.say(&SessionMessage::Leaving(WriterLeaving { gid, leaving: true }))?;
            }
        }
        Ok(())
    }
}
