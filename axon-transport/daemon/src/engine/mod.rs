//! The engine: links, flows and their scheduling, as one state machine without I/O.
//!
//! It is on quinn-proto, which works the same way. The owner passes in datagrams, orders, answers of the KME and the
//! time, and takes out packets, effects and the time of the next deadline. Rings are [`rings::Rings`]. After inputs
//! the owner calls [`Engine::settle`] once, then takes out packets and effects: one pass for all that was ready.

#![forbid(unsafe_code)]

pub(crate) mod account;
pub(crate) mod connection;
pub(crate) mod control;
pub(crate) mod counters;
pub(crate) mod credentials;
pub(crate) mod endpoints;
pub(crate) mod frames;
pub(crate) mod inbound;
pub(crate) mod keyring;
pub(crate) mod link;
pub(crate) mod links;
pub(crate) mod outbound;
mod pace;
pub(crate) mod peer;
pub(crate) mod protection;
pub(crate) mod refusal;
pub(crate) mod rings;
#[cfg(test)]
mod sim;
pub(crate) mod stand_in;
pub(crate) mod tls_settings;
pub(crate) mod transport;

use std::{
    cell::RefCell,
    collections::{HashMap, VecDeque},
    net::{IpAddr, SocketAddr},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{config::Config, internal::graph::RemoteEndpoint, status::LinkStatus};
use bytes::BytesMut;
use quinn_proto::{EcnCodepoint, StreamEvent, Transmit};

use self::{
    inbound::Inbound,
    links::{LinkEvent, LinkParts, LinkReport, Links},
    outbound::{Outbound, OutboundEvent, budget::Budget},
    peer::{Peer, PeerParts, ROUTES_UNSAID, Surroundings},
    rings::Rings,
    stand_in::StandIns,
};
use crate::{
    bridge::{ToControl, ToGateway},
    engine::{
        counters::{Counters, Loss},
        link::target::Target,
        peer::{
            Local,
            graph::{GraphChange, GraphTaken},
            owners::Prover,
            stalls::Stalls,
        },
        refusal::{Refusal, RefusedBy},
    },
    error::GatewayError,
    keys::{self, Origin, Request},
    link::{CloseCode, GraphResync, Message},
    owner::SessionKeys,
};

/// Between two reports of the links' status.
const REPORT: Duration = Duration::from_secs(1);
/// Bytes of streams that one pass reads. The rest has the next pass, after timers and packets that came meanwhile.
const READ: usize = 8 << 20;
/// What following a change costs for each endpoint of both graphs, as an estimate: other peers have nine times as long
/// before this one's next turn.
const ENDPOINT: Duration = Duration::from_nanos(500);

/// What the engine has its owner do.
#[derive(Debug)]
pub(crate) enum Effect {
    /// Tell the control plane.
    Tell(ToControl),
    /// Ask the KME; the answer comes back by [`Engine::handle_key_event`].
    Kme(Origin, Request),
    /// Record a key in the ledger of used keys; the result comes back by [`Engine::handle_recorded`].
    Record {
        /// The connection.
        link: u64,
        /// The key.
        key_id: String,
    },
    /// Give freed memory back to the system, after a while.
    ReturnMemory,
}

/// The parts of an engine that its owner makes.
pub(crate) struct EngineParts {
    /// Links.
    pub(crate) links: LinkParts,
    /// The rings of this host.
    pub(crate) rings: Rc<dyn Rings>,
    /// Keys of this host's sessions.
    pub(crate) session_keys: Arc<SessionKeys>,
    /// GIDs of the engine's own session begin with this.
    pub(crate) session: [u8; 12],
    /// CLOCK_MONOTONIC, in nanoseconds, when the engine's time was zero.
    pub(crate) epoch_nanos: u64,
}

/// The engine of one daemon.
pub(crate) struct Engine {
    config: Arc<Config>,
    daemon: DaemonId,
    links: Links,
    peers: HashMap<DaemonId, Peer>,
    rings: Rc<dyn Rings>,
    stand_ins: StandIns,
    session_keys: Arc<SessionKeys>,
    session: [u8; 12],
    budget: Rc<Budget>,
    stalls: RefCell<Stalls>,
    local: Local,
    epoch: Instant,
    epoch_nanos: u64,
    effects: VecDeque<Effect>,
    /// Readers with samples to take; kept for its memory.
    active: Vec<(Gid, Gid)>,
    waiting_for_room: bool,
    draining: bool,
    /// A peer let go of endpoints that another one may have claimed.
    freed: bool,
    next_report: Duration,
}

impl Engine {
    /// An engine without peers.
    ///
    /// # Errors
    /// The settings make no TLS server.
    pub(crate) fn new(parts: EngineParts) -> Result<Self, GatewayError> {
        let EngineParts { links, rings, session_keys, session, epoch_nanos } = parts;
        let (config, daemon, epoch) = (Arc::clone(&links.config), links.hello.daemon, links.epoch);
        Ok(Self {
            budget: Budget::new(config.reliable_queue),
            config,
            daemon,
            links: Links::new(links)?,
            peers: HashMap::new(),
            rings,
            stand_ins: StandIns::default(),
            session_keys,
            session,
            stalls: RefCell::default(),
            local: Local::new(),
            epoch,
            epoch_nanos,
            effects: VecDeque::new(),
            active: Vec::new(),
            waiting_for_room: false,
            draining: false,
            freed: false,
            next_report: REPORT,
        })
    }

    /// Handles a datagram that came to a bound address.
    pub(crate) fn handle_datagram(
        &mut self,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
        now: Duration,
    ) {
        self.links.handle_datagram(endpoint, from, local, ecn, bytes, now);
    }

    /// Handles an order of the control plane.
    pub(crate) fn handle_order(&mut self, order: ToGateway, now: Duration) {
        match order {
            ToGateway::Dial { daemon, sae, addresses, listed, standing } => {
                let (daemon, standing) = (Some(daemon), Some(standing));
                let target = Target { daemon, sae, addresses, listed, standing, replaces: None };
                self.links.dial(target, now);
            }
            ToGateway::SendDatagram { to, bytes } => self.links.send_datagram(to, bytes),
            ToGateway::Listed(addresses) => self.links.set_listed(addresses),
            // The owner looks at `backlog`.
            ToGateway::Finish | ToGateway::Shutdown => {}
        }
    }

    /// The graph of this host changed.
    pub(crate) fn handle_local_graph(&mut self, local: Local, now: Duration) {
        self.local = local;
        self.with_peers(|peer, with| peer.handle_local_graph(with, now));
        self.tell_draining();
    }

    /// Samples wait in rings, or readers made room in them.
    pub(crate) fn handle_rings(&mut self, now: Duration) {
        let mut active = std::mem::take(&mut self.active);
        self.rings.take_active(&mut active);
        for peer in self.peers.values_mut() {
            peer.outbound.handle_active(&active, now);
            peer.inbound.handle_room();
        }
        active.clear();
        self.active = active;
    }

    /// The KME answered.
    pub(crate) fn handle_key_event(&mut self, event: keys::Event, now: Duration) {
        self.links.handle_key_event(event, now);
    }

    /// The ledger of used keys recorded the key of a connection; `first` if it was new.
    pub(crate) fn handle_recorded(&mut self, link: u64, first: bool, now: Duration) {
        self.links.handle_recorded(link, first, now);
    }

    /// The files of the identity changed.
    pub(crate) fn handle_identity(&mut self, now: Duration) {
        self.links.close_untrusted(true, now);
    }

    fn with_peers(&mut self, mut each: impl FnMut(&mut Peer, &Surroundings<'_>)) {
        let with = Surroundings {
            rings: &*self.rings,
            stand_ins: &self.stand_ins,
            local: &self.local,
            domain: self.config.domain,
            stalled_after: self.config.link.stalled,
            stalls: &self.stalls,
            epoch: self.epoch,
        };
        self.peers.values_mut().for_each(|peer| each(peer, &with));
    }

    fn with_peer<T>(
        &mut self,
        daemon: DaemonId,
        act: impl FnOnce(&mut Peer, &Surroundings<'_>) -> T,
    ) -> Option<T> {
        let with = Surroundings {
            rings: &*self.rings,
            stand_ins: &self.stand_ins,
            local: &self.local,
            domain: self.config.domain,
            stalled_after: self.config.link.stalled,
            stalls: &self.stalls,
            epoch: self.epoch,
        };
        self.peers.get_mut(&daemon).map(|peer| act(peer, &with))
    }

    /// Does all that the inputs since the last call ask for. One call for all inputs that were ready.
    pub(crate) fn settle(&mut self, now: Duration) {
        let mut left = READ;
        loop {
            self.links.settle(now);
            let mut idle = true;
            while let Some(event) = self.links.poll_event() {
                idle = false;
                self.handle_link_event(event, now);
            }
            self.follow_graphs(now);
            if left > 0 {
                idle &= !self.read_streams(&mut left, now);
            }
            idle &= !self.say(now);
            // All that came over a lost connection is read before its link ends.
            if idle && (left == 0 || !self.links.end_lost(now)) {
                break;
            }
        }
        self.pump(now);
        for (number, daemon) in self.links.leaving() {
            let reading = self.peers.get(&daemon).map_or(0, |p| p.inbound.streams_of(number));
            self.links.look_at_leaving(number, reading, now);
        }
        self.say(now);
        self.links.settle(now);
        self.collect(now);
    }

    fn handle_link_event(&mut self, event: LinkEvent, now: Duration) {
        match event {
            LinkEvent::Up { number, daemon, old, closed } => {
                self.link_up(number, daemon, old, now);
                self.with_peer(daemon, |peer, with| {
                    closed.into_iter().for_each(|closed| peer.say(Message::LinkClosed(closed)));
                    peer.send_graph(with.local, true);
                });
                self.next_report = now;
                // Streams that the peer opened before this host knew it: QUIC told of them once.
                let opened = StreamEvent::Opened { dir: quinn_proto::Dir::Uni };
                self.handle_stream(number, daemon, opened, now);
            }
            LinkEvent::Message(number, daemon, message) => {
                self.handle_message(number, daemon, message, now);
            }
            LinkEvent::Stream(number, daemon, event) => {
                self.handle_stream(number, daemon, event, now)
            }
            LinkEvent::Keys(daemon) => {
                if let Some(peer) = self.peers.get_mut(&daemon) {
                    peer.outbound.handle_keys();
                }
            }
            LinkEvent::Gone(number, daemon) => {
                if let Some(peer) = self.peers.get_mut(&daemon) {
                    peer.inbound.link_over(number);
                }
            }
            LinkEvent::Down { number, daemon, peer: text, reason } => {
                if let Some(mut peer) = self.peers.remove(&daemon) {
                    peer.inbound.link_over(number);
                    self.count_lost(daemon, &text, &mut peer);
                    self.effects.push_back(Effect::ReturnMemory);
                }
                self.freed = true;
                self.tell_draining();
                self.tell(ToControl::LinkDown { daemon, reason });
            }
        }
    }

    /// A link of a peer is elected, the first or a successor.
    fn link_up(&mut self, number: u64, daemon: DaemonId, old: Option<u64>, now: Duration) {
        let binding = self.links.binding(number);
        if let (Some(peer), Some(old)) = (self.peers.get_mut(&daemon), old) {
            peer.succeed(number, binding, &self.local);
            let old = self.links.connection(old).map(|connection| &mut connection.quic);
            peer.outbound.succeed(old);
            return;
        }
        let (Some(summary), Some(account)) =
            (self.links.summary(number), self.links.account(number))
        else {
            return;
        };
        let identity = self.links.identity(number).unwrap_or_default();
        let serves = summary.hello.routes.map_or(ROUTES_UNSAID, |routes| routes as usize);
        let needed = self.links.credentials.authenticates();
        let prover = Prover::new(&self.session_keys, self.daemon, needed, binding);
        let counters = Rc::<Counters>::default();
        let inbound = Inbound::new(
            Rc::clone(&counters),
            Rc::clone(&account.messages),
            self.config.max_message,
            self.epoch_nanos,
        );
        let stalled = self.config.link.stalled;
        let outbound = Outbound::new(self.budget.of_peer(), Rc::clone(&counters), stalled, now);
        let parts = PeerParts {
            daemon,
            link: number,
            identity,
            account,
            prover,
            counters,
            inbound,
            outbound,
            serves,
        };
        self.peers.insert(daemon, Peer::new(parts));
    }

    fn handle_message(&mut self, number: u64, daemon: DaemonId, message: Message, now: Duration) {
        let Some(peer) = self.peers.get_mut(&daemon).filter(|peer| peer.link == number) else {
            return;
        };
        match message {
            Message::Graph(graph) => match peer.take_graph(graph) {
                GraphTaken::Changed { .. } => peer.stirred = true,
                GraphTaken::Part => {}
                GraphTaken::Gap => {
                    let version = peer.remote.version();
                    peer.say(Message::GraphResync(GraphResync { version }));
                }
            },
            Message::Owners(owners) => {
                if let Some(binding) = self.links.binding(number) {
                    peer.remote.prove(&owners.proofs, &binding, daemon);
                }
            }
            message => {
                let handled =
                    self.with_peer(daemon, |p, with| p.handle_message(message, with, now));
                if let Some(Err((code, why))) = handled {
                    self.links.violation(number, code, &why, now);
                }
            }
        }
    }

    fn handle_stream(&mut self, number: u64, daemon: DaemonId, event: StreamEvent, now: Duration) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let in_use = peer.link == number;
        match event {
            StreamEvent::Opened { dir: quinn_proto::Dir::Uni } => {
                while let Some(connection) = self.links.connection(number)
                    && let Some(stream) = connection.quic.streams().accept(quinn_proto::Dir::Uni)
                {
                    peer.inbound.handle_readable(number, stream);
                }
            }
            StreamEvent::Opened { .. } => {}
            StreamEvent::Readable { id } => peer.inbound.handle_readable(number, id),
            StreamEvent::Available { .. } if in_use => peer.outbound.handle_streams_available(),
            StreamEvent::Writable { id } if in_use => {
                if let Some(flow) = self.links.flow_of(number, id) {
                    peer.outbound.handle_writable(flow);
                }
            }
            StreamEvent::Finished { id } => {
                let Some(flow) = self.links.flow_of(number, id) else { return };
                if let Some(connection) = self.links.connection(number) {
                    connection.flows.remove(&id);
                    if in_use {
                        peer.outbound.handle_finished(flow, id, &mut connection.quic, now);
                    }
                }
            }
            StreamEvent::Stopped { id, .. } if in_use => {
                let Some(flow) = self.links.flow_of(number, id) else { return };
                if let Some(connection) = self.links.connection(number) {
                    connection.flows.remove(&id);
                    peer.outbound.handle_stopped(flow, id, &mut connection.quic);
                }
            }
            _ => {}
        }
    }

    /// Reads data streams as far as they go. Returns whether there was anything.
    fn read_streams(&mut self, left: &mut usize, now: Duration) -> bool {
        let mut read = false;
        let mut violations = Vec::new();
        for peer in self.peers.values_mut() {
            peer.inbound.look_for_memory();
            // As many as are ready now: one that goes on comes after the others, and after what they cause.
            for _ in 0..peer.inbound.ready() {
                if *left == 0 {
                    break;
                }
                let Some((number, stream)) = peer.inbound.next_ready() else { break };
                read = true;
                let Some((quic, mut open)) = self.links.reader(number) else {
                    peer.inbound.forget_stream((number, stream));
                    continue;
                };
                match peer.inbound.read((number, stream), quic, &mut open, now) {
                    Ok(bytes) => *left = left.saturating_sub(bytes),
                    Err((code, why)) => violations.push((number, code, why)),
                }
                self.links.touch(number);
            }
        }
        for (number, code, why) in violations {
            let told = match code {
                CloseCode::Envelope => "an envelope was refused",
                _ => &why,
            };
            self.links.violation_told(number, code, &why, told, now);
        }
        let waiting = self.peers.values().any(|peer| peer.inbound.waits_for_room());
        if waiting || self.waiting_for_room {
            self.waiting_for_room = waiting;
            self.rings.set_waiting_for_room(waiting);
        }
        read
    }

    /// Passes the peers' control messages to their links. Returns whether there was any.
    fn say(&mut self, now: Duration) -> bool {
        let mut messages = Vec::new();
        for peer in self.peers.values_mut() {
            while let Some(receipt) = peer.inbound.poll_receipt(now) {
                peer.say(Message::Received(receipt));
            }
            while let Some(message) = peer.poll_message() {
                messages.push((peer.link, message));
            }
        }
        let any = !messages.is_empty();
        for (number, message) in messages {
            self.links.send(number, &message, now);
        }
        any
    }

    /// Hands samples to QUIC.
    fn pump(&mut self, now: Duration) {
        let mut events = Vec::new();
        for (daemon, peer) in &mut self.peers {
            if peer.outbound.has_work()
                && let Some(mut carrier) = self.links.carrier(peer.link)
            {
                peer.outbound.pump(&mut carrier, now);
                self.links.touch(peer.link);
            }
            while let Some(event) = peer.outbound.poll_event() {
                events.push((*daemon, event));
            }
        }
        for (daemon, event) in events {
            self.handle_outbound_event(daemon, event, now);
        }
    }

    fn handle_outbound_event(&mut self, daemon: DaemonId, event: OutboundEvent, now: Duration) {
        match event {
            OutboundEvent::Drained(gid) => {
                self.with_peer(daemon, |peer, with| peer.handle_drained(&gid, with.local));
                self.tell_draining();
            }
            OutboundEvent::Lost { topic, cause, samples } => {
                self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples });
            }
            OutboundEvent::Stalled(route) => {
                let Some(Some(stalled)) =
                    self.with_peer(daemon, |peer, with| peer.handle_stalled(route, with, now))
                else {
                    return;
                };
                let Some(peer) = self.peers.get(&daemon) else { return };
                peer.counters.dropped("stalled", stalled.samples);
                let (topic, samples) = (stalled.topic, stalled.samples);
                tracing::warn!(topic, samples, "samples are lost: a peer does not read the topic");
                let (peer, what) = (self.links.peer_text(peer.link), format!("topic {topic}"));
                self.tell(ToControl::Refusal { peer, what, reason: stalled.reason });
                self.tell(ToControl::Lost { topic, cause: "stalled", samples });
            }
        }
    }

    /// Follows the changes of the peers' graphs whose turn it is.
    fn follow_graphs(&mut self, now: Duration) {
        let stirred = self.peers.iter().filter(|(_, peer)| peer.stirred);
        let stirred: Vec<_> = stirred.map(|(daemon, _)| *daemon).collect();
        for daemon in stirred {
            let Some(peer) = self.peers.get_mut(&daemon) else { continue };
            let account = Rc::clone(peer.remote.account());
            if !account.turns.borrow_mut().take(self.epoch + now) {
                continue;
            }
            peer.stirred = false;
            let endpoints = self.follow_graph(daemon, now) + self.local.len();
            let took = ENDPOINT * u32::try_from(endpoints).unwrap_or(u32::MAX);
            account.turns.borrow_mut().over(self.epoch + now, self.epoch + now + took);
        }
    }

    /// Follows the changes of a peer's graph. Returns how many endpoints it has.
    fn follow_graph(&mut self, daemon: DaemonId, now: Duration) -> usize {
        let Some(peer) = self.peers.get_mut(&daemon) else { return 0 };
        let number = peer.link;
        if let Some(reason) = peer.newly_refused() {
            let who = self.links.summary(number).map(|summary| summary.who.to_string());
            let peer = format!("{} at {}", who.unwrap_or_default(), self.links.peer_text(number));
            self.tell(ToControl::Refusal { peer, what: "graph".into(), reason });
        }
        let Some(peer) = self.peers.get_mut(&daemon) else { return 0 };
        let GraphChange { reset, mut added, removed } = peer.remote.changes();
        // An endpoint is its host's: no other host speaks for one of ours, or for the engine.
        let ours: Vec<Gid> = added
            .iter()
            .map(|e| e.endpoint.gid)
            .filter(|gid| self.local.contains_key(gid) || gid.0[..12] == self.session)
            .collect();
        if !ours.is_empty() {
            tracing::warn!(peer = %daemon, endpoints = ours.len(),
                "ignored endpoints announced by a peer: they belong to this host");
            added.retain(|e| !ours.contains(&e.endpoint.gid));
            peer.remote.forget(&ours);
        }
        self.freed |= !removed.is_empty();
        let dead = self.taken_over(daemon, &added);
        // Before the dead links let go of their stand-ins: rings and readers stay as they are.
        self.with_peer(daemon, |peer, with| peer.handle_remote_graph(with, now));
        for link in dead {
            let text = "its host's daemon was restarted";
            self.links.replace(link, text, now);
        }
        // The control plane forgets the endpoints of the dead link before it learns of the same ones here.
        while let Some(event) = self.links.poll_event() {
            self.handle_link_event(event, now);
        }
        self.tell(ToControl::RemoteGraph { daemon, reset, added, removed });
        self.peers.get(&daemon).map_or(0, |peer| peer.remote.len())
    }

    /// The links of peers whose endpoints a restarted daemon of the same host announces: those links are dead. The
    /// claim of another host is ignored.
    fn taken_over(&mut self, daemon: DaemonId, added: &[RemoteEndpoint]) -> Vec<u64> {
        let mut dead = Vec::new();
        let identity =
            |engine: &Self, daemon: DaemonId| engine.links.identity(engine.links.current(daemon)?);
        let Some(owner) = identity(self, daemon) else { return dead };
        let others: Vec<_> = self.peers.keys().filter(|d| **d != daemon).copied().collect();
        for other in others {
            let same_host = identity(self, other).is_some_and(|i| i == owner);
            let Some(peer) = self.peers.get(&other) else { continue };
            let gids = added.iter().map(|e| e.endpoint.gid);
            let moved: Vec<_> = gids.filter(|gid| peer.remote.has(gid)).collect();
            if moved.is_empty() {
                continue;
            }
            if same_host {
                dead.push(peer.link);
                continue;
            }
            tracing::warn!(peer = %daemon, endpoints = moved.len(),
                "ignored endpoints announced by a peer: they belong to another peer");
            if let Some(claimer) = self.peers.get_mut(&daemon) {
                claimer.remote.forget(&moved);
                claimer.displaced = true;
            }
        }
        dead
    }

    /// Asks peers again for the parts of their graphs that were left out and have room now.
    fn resync(&mut self) {
        let freed = std::mem::take(&mut self.freed);
        for peer in self.peers.values_mut() {
            let displaced = freed && std::mem::take(&mut peer.displaced);
            if displaced || peer.remote.has_room_again() {
                let version = peer.remote.version();
                peer.say(Message::GraphResync(GraphResync { version }));
            }
        }
    }

    fn tell(&mut self, what: ToControl) {
        self.effects.push_back(Effect::Tell(what));
    }

    fn tell_draining(&mut self) {
        let draining = self.peers.values().any(Peer::is_draining);
        if std::mem::replace(&mut self.draining, draining) != draining {
            self.tell(ToControl::Draining(draining));
        }
    }

    fn tell_lost(&mut self, peer: &str, losses: Vec<Loss>) {
        counters::log(&losses, peer);
        for Loss { topic, cause, samples } in losses {
            self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples });
        }
    }

    /// Collects what the links report.
    fn collect(&mut self, now: Duration) {
        while let Some(report) = self.links.poll_report() {
            match report {
                LinkReport::Refused(peer, refusal) => self.tell_refused(peer, &refusal),
                LinkReport::DialFailed { daemon, standing } => {
                    self.tell(ToControl::DialFailed { daemon, standing });
                }
                LinkReport::Up { daemon, address } => {
                    self.tell(ToControl::LinkUp { daemon, address });
                }
                LinkReport::Datagram { from, bytes } => {
                    self.tell(ToControl::Datagram { from, bytes });
                }
            }
        }
        while let Some((origin, request)) = self.links.poll_request(now) {
            self.effects.push_back(Effect::Kme(origin, request));
        }
        while let Some((link, key_id)) = self.links.poll_record() {
            self.effects.push_back(Effect::Record { link, key_id });
        }
    }

    fn tell_refused(&mut self, peer: String, refusal: &Refusal) {
        if refusal.by == RefusedBy::Network {
            tracing::debug!(peer, %refusal, "no link");
        } else {
            tracing::warn!(peer, %refusal, "link refused");
        }
        let by = match refusal.by {
            RefusedBy::Here => "refused here",
            RefusedBy::Peer => "refused by the peer",
            RefusedBy::Network => "not reached",
        };
        let reason = format!("{by}: {}", refusal.reason);
        self.tell(ToControl::Refusal { peer, what: refusal.name.clone(), reason });
    }

    /// Reports losses and the status of each link.
    fn report(&mut self, now: Duration) {
        let mut reports = Vec::new();
        for peer in self.peers.values() {
            let text = self.links.peer_text(peer.link);
            reports.push((text, peer.counters.take_lost(), self.link_status(peer, now)));
        }
        for (peer, losses, status) in reports {
            self.tell_lost(&peer, losses);
            self.effects.extend(status.map(|s| Effect::Tell(ToControl::Link(Box::new(s)))));
        }
    }

    fn link_status(&self, peer: &Peer, now: Duration) -> Option<LinkStatus> {
        let mut status = self.links.status(peer.link)?;
        peer.fill(&mut status, now);
        Some(status)
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub(crate) fn poll_timeout(&self, now: Duration) -> Option<Duration> {
        let links = self.links.poll_timeout();
        let peers = self.peers.values().flat_map(|peer| {
            let turn = peer.stirred.then(|| {
                let account = peer.remote.account();
                now + account.turns.borrow_mut().wait(self.epoch + now)
            });
            let more = peer.inbound.has_work().then_some(now);
            let samples = [peer.inbound.poll_timeout(), peer.outbound.poll_timeout()];
            samples.into_iter().chain([peer.poll_timeout(self.epoch, now), turn, more])
        });
        let report = (!self.peers.is_empty()).then_some(self.next_report);
        // What the last packets of a pass brought about.
        let work = self.links.has_work().then_some(now);
        peers.chain([links, report, work]).flatten().min()
    }

    /// Does what is due. [`settle`](Self::settle) has to follow.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        self.links.handle_timeout(now);
        self.with_peers(|peer, with| {
            peer.inbound.handle_timeout(now);
            if peer.poll_timeout(with.epoch, now).is_some_and(|due| due <= now) {
                peer.handle_timeout(with, now);
            }
        });
        for peer in self.peers.values_mut() {
            if peer.outbound.poll_timeout().is_none_or(|due| due > now) {
                continue;
            }
            let heard = self.links.heard(peer.link);
            let mut carrier = self.links.carrier(peer.link);
            peer.outbound.handle_timeout(carrier.as_mut(), heard, now);
            self.links.touch(peer.link);
        }
        if now >= self.next_report {
            self.next_report = now + REPORT;
            self.resync();
            self.peers.values_mut().for_each(|peer| peer.outbound.count_overwritten());
            self.report(now);
        }
    }

    /// The next packets: the endpoint that sends them, and how. `buffer` has their bytes.
    pub(crate) fn poll_transmit(
        &mut self,
        max_datagrams: usize,
        buffer: &mut Vec<u8>,
        now: Duration,
    ) -> Option<(usize, Transmit)> {
        self.links.poll_transmit(max_datagrams, buffer, now)
    }

    /// The next effect.
    pub(crate) fn poll_effect(&mut self) -> Option<Effect> {
        self.effects.pop_front()
    }

    /// Samples that wait for peers, in bytes, and how many bytes have left the queues since the start.
    pub(crate) fn backlog(&self) -> (usize, usize) {
        (self.budget.taken(), self.budget.released())
    }

    /// The keys for status, with counters of the KME and the ledger.
    pub(crate) fn key_status(
        &self,
        kme: &keys::Statistics,
        used: &keys::UsedStatistics,
        now: Duration,
    ) -> Option<serde_json::Value> {
        Some(self.links.keyring.as_ref()?.status(now, kme, used))
    }

    /// Ends all links and counts what they did not carry.
    pub(crate) fn close(&mut self, now: Duration) {
        let texts = self.peers.iter().map(|(d, peer)| (*d, self.links.peer_text(peer.link)));
        let texts: Vec<_> = texts.collect();
        self.links.close_all(now);
        for (daemon, text) in texts {
            if let Some(mut peer) = self.peers.remove(&daemon) {
                self.count_lost(daemon, &text, &mut peer);
            }
        }
    }

    /// Counts and logs the samples that the last link of a peer did not carry.
    fn count_lost(&mut self, daemon: DaemonId, text: &str, peer: &mut Peer) {
        for (topic, samples) in peer.outbound.link_over() {
            tracing::warn!(topic = &*topic, peer = %daemon, samples,
                "the link ended before the peer acknowledged them: samples may be lost");
        }
        self.tell_lost(text, peer.counters.take_lost());
    }

    /// Whether all connections are over.
    pub(crate) fn is_idle(&self) -> bool {
        self.links.is_idle()
    }
}
