//! The engine: links, flows and their scheduling, as one state machine without I/O.
//!
//! It is on quinn-proto, which works the same way. The owner passes in datagrams, orders, answers of the KME and the
//! time, and takes out packets, effects and the time of the next deadline. Rings are [`rings::Rings`]. After inputs
//! the owner calls [`Engine::settle`] once, then takes out packets and effects: one pass for all that was ready.

#![forbid(unsafe_code)]

pub(crate) mod account;
pub(crate) mod compression;
mod congestion;
pub(crate) mod counters;
pub(crate) mod credentials;
mod effects;
mod graphs;
pub(crate) mod inbound;
pub(crate) mod keyring;
pub(crate) mod limits;
pub(crate) mod link;
pub(crate) mod links;
pub(crate) mod outbound;
pub(crate) mod peer;
mod peer_factory;
pub(crate) mod peer_graph;
mod peers;
pub(crate) mod quic;
pub(crate) mod rank;
pub(crate) mod refusal;
mod reports;
pub(crate) mod rings;
pub(crate) mod route;
pub(crate) mod sample;
#[cfg(test)]
mod sim;
pub(crate) mod stand_in;
mod streams;

use std::{
    net::{IpAddr, SocketAddr},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::DaemonId;
use axon_transport::access::AccessRules;
use bytes::BytesMut;
use quinn_proto::{Dir, EcnCodepoint, StreamEvent, Transmit};

pub(crate) use self::effects::Effect;
use self::{
    compression::CompressionAnswer,
    effects::Effects,
    link::target::DialTarget,
    links::{LinkEvent, LinkParts, Links},
    outbound::OutboundEvent,
    peer::{LocalEndpoints, Peer},
    peer_factory::{FirstLink, PeerFactory},
    peer_graph::GraphTaken,
    peers::LinkedPeers,
    reports::Reports,
    rings::Rings,
};
use crate::{
    bridge::{ToControl, ToGateway},
    discovery::Interface,
    error::GatewayError,
    keys,
    link::{GraphResync, LinkMessage},
    owner::SessionKeys,
};

/// Maximum number of stream bytes that one pass reads. The next pass reads the rest, after timers and packets that came
/// meanwhile.
const READ: usize = 8 << 20;

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
    access: AccessRules,
    links: Links,
    peers: LinkedPeers,
    factory: PeerFactory,
    session: [u8; 12],
    effects: Effects,
    /// A peer let go of endpoints that another one may have claimed.
    freed: bool,
    reports: Reports,
}

impl Engine {
    /// Creates an engine without peers.
    ///
    /// # Errors
    /// The settings are not valid for a TLS server.
    pub(crate) fn new(parts: EngineParts) -> Result<Self, GatewayError> {
        let EngineParts { links, rings, session_keys, session, epoch_nanos } = parts;
        let (config, daemon) = (Arc::clone(&links.config), links.hello.daemon);
        let access = config.access.clone();
        let mut links = Links::new(links)?;
        links.set_interface_rules(&access);
        Ok(Self {
            peers: LinkedPeers::new(Arc::clone(&config), rings),
            access,
            factory: PeerFactory::new(config, daemon, session_keys, epoch_nanos),
            links,
            session,
            effects: Effects::default(),
            freed: false,
            reports: Reports::new(),
        })
    }

    /// Handles a datagram that came to a bound address.
    pub(crate) fn handle_datagram(
        &mut self,
        now: Duration,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) {
        self.links.handle_datagram(now, endpoint, from, local, ecn, bytes);
    }

    /// Returns whether discovery datagrams are held back, because many came.
    pub(crate) fn holds_discovery(&self) -> bool {
        self.links.holds_discovery()
    }

    /// Handles an order of the control plane.
    pub(crate) fn handle_order(&mut self, now: Duration, order: ToGateway) {
        match order {
            ToGateway::Dial { daemon, sae, addresses, listed, standing } => {
                // Discovery does not know yet that the peer has a link, or that its path works again.
                if self.links.stands(daemon) {
                    let failed = ToControl::DialFailed { daemon, standing, absent_at: None };
                    return self.effects.tell(failed);
                }
                let replaces = self.links.cut_link(daemon);
                let (daemon, standing) = (Some(daemon), Some(standing));
                let target =
                    DialTarget { daemon, sae, addresses, listed, standing, replaces, beside: None };
                self.links.dial(target, now);
            }
            ToGateway::Addresses { daemon, addresses } => {
                self.links.set_addresses(now, daemon, &addresses);
            }
            ToGateway::SendDatagram { to, bytes } => self.links.send_datagram(to, bytes),
            ToGateway::Rules(rules, number) => {
                self.set_rules(rules, now);
                self.effects.tell(ToControl::Rules(number));
            }
            ToGateway::CheckAccess { daemon, number, uses } => match self.peers.get_mut(daemon) {
                Some(peer) => peer.check_access(number, uses),
                None => self.effects.tell(ToControl::Decisions { number, decisions: None }),
            },
            ToGateway::Listed(addresses) => self.links.set_listed(addresses),
            // The owner looks at `backlog`.
            ToGateway::Finish | ToGateway::Shutdown => {}
        }
    }

    /// Handles a change of this host's graph.
    pub(crate) fn handle_local_graph(&mut self, now: Duration, local: LocalEndpoints) {
        self.peers.handle_local_graph(now, local);
        self.effects.tell_draining(self.peers.are_draining());
    }

    /// Returns when [`handle_local_graph`](Self::handle_local_graph) should be called next. The delay lets thousands of
    /// endpoints that come one after the other be handled together.
    pub(crate) fn follow_local_at(&self) -> Duration {
        self.peers.follow_local_at()
    }

    /// Handles the rings: samples wait in them, or readers made room.
    pub(crate) fn handle_rings(&mut self, now: Duration) {
        self.peers.handle_rings(now);
    }

    /// Handles an answer of the KME.
    pub(crate) fn handle_key_event(&mut self, now: Duration, event: keys::KmeAnswer) {
        self.links.handle_key_event(now, event);
    }

    /// Handles the ledger's record of a connection's key; `first` if the key was new.
    pub(crate) fn handle_recorded(&mut self, now: Duration, link: u64, first: bool) {
        self.links.handle_recorded(now, link, first);
    }

    /// Handles the compressor's answer: a sample was compressed, or does not become shorter.
    pub(crate) fn handle_compressed(&mut self, now: Duration, answer: CompressionAnswer) {
        for asker in self.factory.compression().handle_answer(now, &answer) {
            if let Some(peer) = self.peers.get_mut(asker.daemon) {
                let frame = answer.compressed.clone();
                peer.outbound.handle_compressed(asker.flow, answer.number, frame);
            }
        }
    }

    /// Handles the list of this host's network interfaces.
    pub(crate) fn handle_interfaces(&mut self, interfaces: Vec<Interface>) {
        self.links.set_interfaces(interfaces);
    }

    /// Handles a change of the identity's files.
    pub(crate) fn handle_identity(&mut self, now: Duration) {
        self.links.close_untrusted(true, now);
    }

    /// Does all that the inputs since the last call ask for. One call for all inputs that were ready.
    pub(crate) fn settle(&mut self, now: Duration) {
        let mut left = READ;
        loop {
            self.links.settle(now);
            let mut idle = true;
            while let Some(event) = self.links.poll_event() {
                idle = false;
                self.handle_link_event(now, event);
            }
            self.follow_graphs(now);
            if left > 0 {
                idle &= !self.read_streams(&mut left, now);
            }
            idle &= !self.say(now);
            // The engine reads everything that came over a lost connection before it ends the link.
            if idle && (left == 0 || !self.links.end_lost(now)) {
                break;
            }
        }
        self.pump(now);
        for (number, daemon) in self.links.leaving() {
            let reading = self.peers.get(daemon).map_or(0, |p| p.inbound.streams_of(number));
            self.links.look_at_leaving(number, reading, now);
        }
        self.say(now);
        self.links.settle(now);
        if self.links.asks_for_interfaces() {
            self.effects.push(Effect::Interfaces);
        }
        self.collect(now);
    }

    fn handle_link_event(&mut self, now: Duration, event: LinkEvent) {
        match event {
            LinkEvent::Up { number, daemon, old, closed } => {
                self.link_up(number, daemon, old, now);
                self.peers.with(daemon, |peer, with| {
                    peer.say_closed(closed);
                    peer.send_graph(with.local, true);
                });
                self.reports.hurry(now);
                // This handles streams that the peer opened before this host knew it: QUIC reports them only once.
                let opened = StreamEvent::Opened { dir: Dir::Uni };
                self.handle_stream(now, number, daemon, opened);
            }
            LinkEvent::Message(number, daemon, message, _room) => {
                self.handle_message(now, number, daemon, *message);
            }
            LinkEvent::Stream(number, daemon, event) => {
                self.handle_stream(now, number, daemon, event)
            }
            LinkEvent::Keys(daemon) => {
                if let Some(peer) = self.peers.get_mut(daemon) {
                    peer.outbound.handle_keys();
                }
            }
            LinkEvent::Silent(daemon) => {
                if let Some(peer) = self.peers.get_mut(daemon) {
                    tracing::info!(peer = %daemon, "the peer is silent: its endpoints are taken for gone");
                    peer.silent = true;
                    self.effects.tell(ToControl::Silent { daemon });
                }
            }
            LinkEvent::Back(daemon) => self.back(daemon, now),
            LinkEvent::Closed(daemon, closed) => {
                if let Some(peer) = self.peers.get_mut(daemon) {
                    peer.say_closed(Some(closed));
                }
            }
            LinkEvent::Gone(number, daemon) => {
                if let Some(peer) = self.peers.get_mut(daemon) {
                    peer.inbound.link_over(number, now);
                }
            }
            LinkEvent::Down { number, daemon, peer: text, reason, restarted } => {
                if let Some(mut peer) = self.peers.remove(daemon) {
                    peer.inbound.link_over(number, now);
                    if restarted {
                        self.peers.keep_relays(&mut peer, now);
                    }
                    self.count_lost(daemon, &text, &mut peer);
                    self.effects.push(Effect::ReturnMemory);
                }
                self.freed = true;
                self.effects.tell_draining(self.peers.are_draining());
                self.effects.tell(ToControl::LinkDown { daemon, reason });
            }
        }
    }

    /// Handles the return of a silent peer.
    fn back(&mut self, daemon: DaemonId, now: Duration) {
        let Some(peer) = self.peers.get_mut(daemon) else { return };
        if std::mem::take(&mut peer.silent) {
            tracing::info!(peer = %daemon, "the peer is back");
            peer.remote.tell_anew();
            peer.stirred = true;
            self.reports.hurry(now);
        }
    }

    /// Handles the election of a peer's link, the first or a successor.
    fn link_up(&mut self, number: u64, daemon: DaemonId, old: Option<u64>, now: Duration) {
        let Some(link) = self.links.view(number) else { return };
        let binding = link.binding();
        let Some(permissions) = link.permissions(&self.access) else { return };
        self.links.limit_egress(number, &permissions);
        if let Some(superseded) = old.filter(|_| self.peers.get(daemon).is_some()) {
            // The ends of its streams leave in this pass: samples on the new link wait for them.
            self.links.touch(superseded);
            let old = self.links.connection(superseded).map(|connection| &mut connection.quic);
            self.peers.with(daemon, |peer, with| {
                // The permissions are set before any part of this host's graph is sent.
                peer.set_permissions(permissions, with.config, now);
                peer.succeed(number, binding, with.local);
                peer.outbound.succeed(old);
            });
            self.back(daemon, now);
            return;
        }
        let Some(link) = self.links.view(number) else { return };
        let (Some(summary), Some(account)) = (link.summary(), link.account()) else { return };
        let link = FirstLink {
            number,
            daemon,
            identity: link.identity().unwrap_or_default(),
            account,
            permissions,
            binding,
            routes: summary.hello.routes,
            needs_proofs: self.links.credentials.authenticates(),
        };
        self.peers.insert(daemon, self.factory.make(link, now));
    }

    fn handle_message(
        &mut self,
        now: Duration,
        number: u64,
        daemon: DaemonId,
        message: LinkMessage,
    ) {
        let Some(peer) = self.peers.get_mut(daemon).filter(|peer| peer.link == number) else {
            return;
        };
        match message {
            LinkMessage::Graph(graph) => match peer.take_graph(graph) {
                GraphTaken::Changed { whole } => {
                    peer.stirred = true;
                    if whole {
                        self.peers.with(daemon, |peer, with| peer.unserve_unrepeated(with, now));
                    }
                }
                GraphTaken::Part => {}
                GraphTaken::Gap => {
                    let version = peer.remote.version();
                    peer.say(LinkMessage::GraphResync(GraphResync { version }));
                }
            },
            LinkMessage::Owners(owners) => {
                if let Some(binding) = self.links.view(number).and_then(|link| link.binding()) {
                    peer.remote.prove(&owners.proofs, &binding, daemon, now);
                }
            }
            LinkMessage::AccessDecisions(answer) => {
                let number = answer.number;
                if let Some(decisions) = peer.take_decisions(answer) {
                    self.effects.tell(ToControl::Decisions { number, decisions: Some(decisions) });
                }
            }
            message => {
                if let LinkMessage::Subscribe(asks) = &message {
                    self.take_over_route(daemon, asks, now);
                }
                let handled =
                    self.peers.with(daemon, |p, with| p.handle_message(now, message, with));
                if let Some(Err((code, why))) = handled {
                    self.links.violation(number, code, &why, now);
                }
            }
        }
    }

    /// Passes the peers' control messages to their links. Returns whether there was any.
    fn say(&mut self, now: Duration) -> bool {
        let mut messages = Vec::new();
        for peer in self.peers.values_mut() {
            while let Some(receipt) = peer.inbound.poll_receipt(now) {
                peer.say(LinkMessage::Received(receipt));
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
        for (daemon, peer) in self.peers.iter_mut() {
            if peer.outbound.has_work() {
                let batch = self.links.copy_batch(daemon, now);
                if let Some(mut carrier) = self.links.carrier(peer.link, now) {
                    carrier.copies = batch;
                    peer.outbound.pump(&mut carrier, now);
                    let copies = carrier.copies.take();
                    self.links.touch(peer.link);
                    self.links.send_copies(daemon, copies, now);
                }
            }
            while let Some(event) = peer.outbound.poll_event() {
                events.push((daemon, event));
            }
        }
        for (daemon, event) in events {
            self.handle_outbound_event(now, daemon, event);
        }
    }

    fn handle_outbound_event(&mut self, now: Duration, daemon: DaemonId, event: OutboundEvent) {
        match event {
            OutboundEvent::Drained(gid) => {
                self.peers.with(daemon, |peer, with| peer.handle_drained(&gid, with.local));
                self.effects.tell_draining(self.peers.are_draining());
            }
            OutboundEvent::Lost { topic, cause, samples } => {
                self.effects.tell(ToControl::Lost { topic: topic.to_string(), cause, samples });
            }
            OutboundEvent::Stalled(route, why) => {
                let Some(Some(stalled)) = self
                    .peers
                    .with(daemon, |peer, with| peer.handle_stalled(now, route, why, with))
                else {
                    return;
                };
                let Some(peer) = self.peers.get(daemon) else { return };
                peer.counters.dropped("stalled", stalled.samples);
                let (kind, text) = (self.links.kind(peer.link), self.links.peer_text(peer.link));
                self.effects.tell_stalled(kind, text, stalled);
            }
        }
    }

    /// Collects reports, KME requests, compression orders, and key_IDs to record as used.
    fn collect(&mut self, now: Duration) {
        while let Some(report) = self.links.poll_report() {
            self.effects.tell_report(report);
        }
        while let Some((origin, request)) = self.links.poll_request(now) {
            self.effects.push(Effect::Kme(origin, request));
        }
        while let Some(order) = self.factory.compression().poll_order() {
            self.effects.push(Effect::Compress(order));
        }
        while let Some((link, key_id)) = self.links.poll_record() {
            self.effects.push(Effect::Record { link, key_id });
        }
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(crate) fn poll_timeout(&self, now: Duration) -> Option<Duration> {
        let report = (!self.peers.is_empty()).then(|| self.reports.poll_timeout());
        // This covers the results of the last packets of a pass.
        let work = self.links.has_work().then_some(now);
        let parts = [self.links.poll_timeout(), self.peers.poll_timeout(now), report, work];
        parts.into_iter().flatten().min()
    }

    /// Handles all due timers. The caller must call [`settle`](Self::settle) afterwards.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        self.links.handle_timeout(now);
        self.peers.handle_timeout(now);
        self.give_up_relays(now);
        for peer in self.peers.values_mut() {
            if peer.outbound.poll_timeout().is_none_or(|due| due > now) {
                continue;
            }
            let heard = self.links.heard(peer.link);
            let mut carrier = self.links.carrier(peer.link, now);
            peer.outbound.handle_timeout(now, carrier.as_mut(), heard);
            self.links.touch(peer.link);
        }
        if self.reports.take_due(now) {
            self.resync();
            self.peers.values_mut().for_each(|peer| peer.outbound.count_overwritten());
            reports::report(&mut self.peers, &self.links, &mut self.effects, now);
        }
    }

    /// Returns the next packets: the number of the endpoint that sends them, and how. `buffer` has their bytes.
    pub(crate) fn poll_transmit(
        &mut self,
        max_datagrams: usize,
        buffer: &mut Vec<u8>,
        now: Duration,
    ) -> Option<(usize, Transmit)> {
        self.links.poll_transmit(max_datagrams, buffer, now)
    }

    /// Returns the next effect.
    pub(crate) fn poll_effect(&mut self) -> Option<Effect> {
        self.effects.poll()
    }

    /// Returns the bytes of the samples that wait for peers, and the number of bytes that have left the queues since
    /// the start.
    pub(crate) fn backlog(&self) -> (usize, usize) {
        self.factory.backlog()
    }

    /// Returns the keys for status, with counters of the KME and the ledger.
    pub(crate) fn key_status(
        &self,
        kme: &keys::Statistics,
        used: &keys::UsedStatistics,
        now: Duration,
    ) -> Option<serde_json::Value> {
        Some(self.links.keyring.as_ref()?.status(now, kme, used))
    }

    /// Ends all links and counts the samples that they did not carry.
    pub(crate) fn close(&mut self, now: Duration) {
        let texts = self.peers.iter().map(|(d, peer)| (d, self.links.peer_text(peer.link)));
        let texts: Vec<_> = texts.collect();
        self.links.close_all(now);
        for (daemon, text) in texts {
            if let Some(mut peer) = self.peers.remove(daemon) {
                self.count_lost(daemon, &text, &mut peer);
            }
        }
        self.give_up_relays(Duration::MAX);
    }

    /// Counts and logs the samples that the last link of a peer did not carry.
    fn count_lost(&mut self, daemon: DaemonId, text: &str, peer: &mut Peer) {
        let unacknowledged = peer.outbound.link_over();
        let counted = peer.counters.take_lost();
        self.effects.tell_link_over(daemon, text, &unacknowledged, counted);
    }

    /// Gives up kept relays whose peers did not come back by this time: counts and logs their samples.
    fn give_up_relays(&mut self, now: Duration) {
        let given_up = self.peers.give_up_relays(now);
        self.effects.tell_relays_given_up(given_up);
    }

    /// Returns whether all connections are over.
    pub(crate) fn is_idle(&self) -> bool {
        self.links.is_idle()
    }
}
