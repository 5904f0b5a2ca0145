//! A simulated host: one engine with rings, a KME and a control plane that dials.

use std::{
    cell::Cell,
    collections::{BTreeMap, BTreeSet, VecDeque},
    net::{IpAddr, Ipv4Addr, SocketAddr},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    access::AccessRules,
    config::{Config, DiscoveryRange},
    internal::graph::{EndpointRange, RemoteEndpoint},
    internal::wire::session::CheckedUse,
    status::{LinkStatus, PeerDecision},
};
use bytes::BytesMut;
use quinn_proto::{EcnCodepoint, Transmit};
use rand::RngExt;

use super::{
    beacons::{BeaconDiscovery, MOST_BEACON_DIALS},
    discovery::SimDiscovery,
    rings::{SimRings, session_key},
    rng::{Stream, stream},
};
use crate::{
    bridge::{ToControl, ToGateway, TrafficRules},
    daemon_key::DaemonKey,
    discovery::{Arrival, Interface},
    engine::{
        Effect, Engine, EngineParts,
        compression::{CompressionAnswer, Compressor},
        credentials::Credentials,
        links::{LinkParts, Links},
        peer::MAX_ROUTES,
        quic::transport::endpoint_config,
    },
    identity::Identity,
    keys::{KmeRequest, RequestOrigin},
    link::LinkHello,
    owner::SessionKeys,
    wire::beacon::Datagram,
};

/// The port of QUIC on each host.
pub(super) const PORT: u16 = 61_300;
/// Datagrams that leave together at most.
pub(super) const BATCH: usize = 44;
/// Rate of the thread that compresses samples, in bytes a second.
const COMPRESSOR: f64 = 300e6;

/// A simulated host.
pub(super) struct Host {
    pub(super) number: usize,
    pub(super) address: Ipv4Addr,
    /// The address of the second interface, if it has one.
    pub(super) second: Option<Ipv4Addr>,
    pub(super) daemon: DaemonId,
    /// The daemon whose id the next one of this host claims.
    pub(super) poses_as: Option<DaemonId>,
    /// A test makes its daemon lie, and take more than an honest one.
    pub(super) lies: bool,
    pub(super) rings: SimRings,
    config: Arc<Config>,
    epoch: Instant,
    /// `None` while the daemon is dead.
    engine: Option<Engine>,
    seed: u64,
    starts: u32,
    discovery: SimDiscovery,
    /// The daemon's own discovery, in scenarios about dials.
    beacons: Option<BeaconDiscovery>,
    /// The endpoints of each peer, as reported to the control plane.
    pub(super) graph: BTreeMap<DaemonId, BTreeMap<Gid, RemoteEndpoint>>,
    pub(super) status: BTreeMap<String, LinkStatus>,
    pub(super) refusals: VecDeque<(Duration, String)>,
    pub(super) lost: BTreeMap<(String, &'static str), u64>,
    /// Requests to the KME that wait for an answer.
    pub(super) requests: Vec<(RequestOrigin, KmeRequest)>,
    records: Vec<(u64, String)>,
    /// The engine asked for the host's network interfaces.
    interfaces_asked: bool,
    /// Samples that were compressed, and when the answers are due.
    compressed: VecDeque<(Duration, CompressionAnswer)>,
    /// The number of compressed samples.
    pub(super) compressions: u64,
    used: BTreeSet<String>,
    graph_changed: bool,
    /// The range of all sessions.
    range: DiscoveryRange,
    /// Questions about the access rules of peers, as orders.
    questions: Vec<ToGateway>,
    /// The answers, by number.
    pub(super) decisions: BTreeMap<u64, Option<Vec<PeerDecision>>>,
    /// Rules that came.
    rules: Option<TrafficRules>,
    rings_rang: bool,
    /// When the host has something to do, while nothing changed since that was asked.
    due: Cell<Option<Option<Duration>>>,
}

impl Host {
    /// Creates a host whose daemon is not started.
    pub(super) fn new(number: usize, config: Config, seed: u64, epoch: Instant) -> Self {
        let [high, low] = (number as u16 + 1).to_be_bytes();
        Self {
            number,
            address: Ipv4Addr::new(10, 0, high, low),
            second: None,
            daemon: DaemonId::default(),
            poses_as: None,
            lies: false,
            rings: SimRings::new(number),
            config: Arc::new(config),
            epoch,
            engine: None,
            seed,
            starts: 0,
            discovery: SimDiscovery::default(),
            beacons: None,
            graph: BTreeMap::new(),
            status: BTreeMap::new(),
            refusals: VecDeque::new(),
            lost: BTreeMap::new(),
            requests: Vec::new(),
            records: Vec::new(),
            interfaces_asked: false,
            compressed: VecDeque::new(),
            compressions: 0,
            used: BTreeSet::new(),
            graph_changed: false,
            range: DiscoveryRange::Subnet,
            questions: Vec::new(),
            decisions: BTreeMap::new(),
            rules: None,
            rings_rang: false,
            due: Cell::new(None),
        }
    }

    /// Starts the daemon.
    pub(super) fn start(&mut self, now: Duration) {
        self.due.set(None);
        self.starts += 1;
        let host = Stream::Host { host: self.number as u32, start: self.starts };
        let mut random = stream(self.seed, host);
        let key = DaemonKey::from(session_key(&random.random()));
        self.daemon = self.poses_as.unwrap_or(key.id());
        let key = self.poses_as.is_none().then(|| Arc::new(key));
        // All daemons of the host have the key of resets, as they find it in its runtime folder.
        let resets = Stream::Host { host: self.number as u32, start: 0 };
        let mut endpoint = endpoint_config(&stream(self.seed, resets).random());
        endpoint.rng_seed(Some(random.random()));
        let links_seed = random.random();
        let identity = match &self.config.security {
            axon_transport::config::Security::Classic(classic) => {
                Some(Arc::new(Identity::load(classic, "host").unwrap()))
            }
            axon_transport::config::Security::Qkd(_) => None,
        };
        let hello = LinkHello {
            routes: Some(MAX_ROUTES as u32),
            host: format!("host{}", self.number),
            ..LinkHello::new(&self.config, self.daemon)
        };
        let links = LinkParts {
            config: Arc::clone(&self.config),
            credentials: Credentials::new(Arc::clone(&self.config), identity),
            hello,
            daemon_key: key,
            addresses: vec![SocketAddr::from(([0, 0, 0, 0], PORT))],
            endpoint: Arc::new(endpoint),
            qlogs: None,
            epoch: self.epoch,
            seed: links_seed,
            wall: {
                let wall = Rc::clone(&self.rings.wall);
                Rc::new(move || wall.get())
            },
        };
        let session_keys = SessionKeys::default();
        session_keys.insert(self.rings.key());
        let parts = EngineParts {
            links,
            rings: Rc::new(self.rings.clone()),
            session_keys: Arc::new(session_keys),
            session: [0xee; 12],
            epoch_nanos: 1_000_000_000,
        };
        self.engine = Some(Engine::new(parts).unwrap());
        self.graph.clear();
        (self.requests, self.records) = (Vec::new(), Vec::new());
        self.interfaces_asked = false;
        self.compressed.clear();
        self.status.clear();
        self.discovery.start(self.daemon, now);
        if self.beacons.is_some() {
            self.use_beacons(now);
        }
        self.graph_changed = true;
    }

    /// Returns the linked peers.
    pub(super) fn linked(&self) -> BTreeSet<DaemonId> {
        self.discovery.linked()
    }

    /// Returns the number of superseded links.
    pub(super) fn leaving(&self) -> usize {
        self.engine.as_ref().map_or(0, |engine| engine.links.leaving().len())
    }

    /// Kills the daemon: it sends nothing more, and its state is gone.
    pub(super) fn kill(&mut self) {
        self.due.set(None);
        self.rings.kill(|| self.engine = None);
        self.discovery.kill();
        self.graph.clear();
    }

    /// Returns whether the daemon runs.
    pub(super) fn is_running(&self) -> bool {
        self.engine.is_some()
    }

    /// Ends the daemon in order. Its packets leave with the next transmit.
    pub(super) fn close(&mut self, now: Duration) {
        self.due.set(None);
        if let Some(engine) = &mut self.engine {
            engine.close(now);
            engine.settle(now);
        }
    }

    /// Returns the host's SAE ID, in qkd.
    pub(super) fn sae(&self) -> Option<String> {
        match &self.config.security {
            axon_transport::config::Security::Classic(_) => None,
            axon_transport::config::Security::Qkd(qkd) => Some(qkd.sae_id.clone()),
        }
    }

    /// Makes the host find its peers by beacons from now on, with the daemon's own discovery.
    pub(super) fn use_beacons(&mut self, now: Duration) {
        self.due.set(None);
        let address = IpAddr::V4(self.address);
        self.beacons = Some(BeaconDiscovery::new(&self.config, self.daemon, address, now));
    }

    /// Returns the number of dials that discovery ordered since the daemon's start, if the host uses beacons.
    pub(super) fn dials(&self) -> u64 {
        self.beacons.as_ref().map_or(0, |beacons| beacons.dials)
    }

    /// Makes the host link with a peer. The lower id dials.
    pub(super) fn want(
        &mut self,
        daemon: DaemonId,
        address: Ipv4Addr,
        sae: Option<String>,
        now: Duration,
    ) {
        self.due.set(None);
        let address = SocketAddr::from((address, PORT));
        match &mut self.beacons {
            Some(beacons) => beacons.hear(now, daemon, address, sae),
            None => self.discovery.want(daemon, address, sae, now),
        }
    }

    /// Forgets a peer that is gone.
    pub(super) fn unwant(&mut self, daemon: DaemonId) {
        self.due.set(None);
        self.discovery.unwant(daemon);
    }

    /// Returns the links of the host's daemon.
    pub(super) fn links(&self) -> Option<&Links> {
        self.engine.as_ref().map(|engine| &engine.links)
    }

    /// Returns the links of the host's daemon, for lies.
    pub(super) fn links_mut(&mut self) -> Option<&mut Links> {
        self.due.set(None);
        self.engine.as_mut().map(|engine| &mut engine.links)
    }

    /// Returns the bytes of the samples that wait for peers, and the number of bytes that have left the queues.
    pub(super) fn backlog(&self) -> (usize, usize) {
        self.engine.as_ref().map_or((0, 0), Engine::backlog)
    }

    /// Returns the bytes of all peers' samples that were read from QUIC and are not in a ring.
    pub(super) fn held_of_messages(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.inbound.held().1).sum()
    }

    /// Returns the bytes of all peers' refused routes that are remembered.
    pub(super) fn held_of_refusals(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.held_of_refusals()).sum()
    }

    /// Returns the maximum number of bytes that decompressed and unhandled control messages of one peer took.
    pub(super) fn most_decoded(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.remote.account().decoded.peak()).max().unwrap_or(0)
    }

    /// Returns the number of bytes that control messages of all peers took while they were decompressed and handled,
    /// since their links began.
    pub(super) fn handled(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.remote.account().decoded.released()).sum()
    }

    /// Returns the number of endpoints of all peers that are known, or left out.
    pub(super) fn heard_endpoints(&self) -> u64 {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.remote.len() as u64 + peer.remote.left_out()).sum()
    }

    /// Returns the maximum number of bytes of control messages that waited until one peer read them.
    pub(super) fn most_unsent(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.remote.account().unsent.peak()).max().unwrap_or(0)
    }

    /// Returns the number of publishers, servers and clients of all peers that are shown here.
    pub(super) fn shown(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.stand_ins()).sum()
    }

    /// Relays that are kept for daemons that were restarted.
    pub(super) fn kept(&self) -> usize {
        self.engine.iter().map(|engine| engine.peers.kept()).sum()
    }

    /// Checks that the host holds no more than it may.
    pub(super) fn check_held(&mut self, now: Duration) {
        let of_beacons = if self.beacons.is_some() { MOST_BEACON_DIALS } else { 0 };
        let dials = self.discovery.most_dials(now) + of_beacons;
        if let Some(engine) = self.engine.as_ref().filter(|_| !self.lies) {
            super::held::check(engine, self.config.reliable_queue as usize, dials);
        }
    }

    /// Passes the addresses of a peer to discovery, as its beacons would.
    pub(super) fn hear_addresses(&mut self, daemon: DaemonId, addresses: &[Ipv4Addr]) {
        self.due.set(None);
        let addresses = addresses.iter().map(|a| SocketAddr::from((*a, PORT))).collect();
        self.discovery.hear_addresses(daemon, addresses);
    }

    /// Sets a new address of a peer.
    pub(super) fn moved(&mut self, daemon: DaemonId, address: Ipv4Addr) {
        self.due.set(None);
        self.discovery.set_address(daemon, SocketAddr::from((address, PORT)));
    }

    /// Marks the endpoints of the host as changed.
    pub(super) fn touch_graph(&mut self) {
        self.due.set(None);
        self.graph_changed = true;
    }

    /// Sets the range of all sessions.
    pub(super) fn set_range(&mut self, range: DiscoveryRange) {
        self.range = range;
        self.touch_graph();
    }

    /// Returns the number of routes that all peers are served.
    pub(super) fn served_routes(&self) -> usize {
        let peers = self.engine.iter().flat_map(|engine| engine.peers.iter());
        peers.map(|(_, peer)| peer.served_routes()).sum()
    }

    /// Sets other access rules.
    pub(super) fn set_access(&mut self, rules: &str) {
        let access = AccessRules::parse(rules, "access.toml").unwrap();
        self.set_rules(TrafficRules { access, ..TrafficRules::of(&self.config) });
    }

    /// Sets other traffic rules.
    pub(super) fn set_rules(&mut self, rules: TrafficRules) {
        self.due.set(None);
        self.rules = Some(rules);
    }

    /// Returns whether the host knows all endpoints of another one, and no others of it.
    pub(super) fn knows(&self, other: &Self) -> bool {
        let shown = other.rings.endpoints();
        self.graph.get(&other.daemon).is_some_and(|known| {
            known.len() == shown.len() && shown.iter().all(|e| known.contains_key(&e.gid))
        })
    }

    /// Asks, for a tool, what a peer lets this host do.
    pub(super) fn check_access(&mut self, daemon: DaemonId, number: u64, uses: Vec<CheckedUse>) {
        self.due.set(None);
        self.questions.push(ToGateway::CheckAccess { daemon, number, uses });
    }

    /// Rings the host's doorbell.
    pub(super) fn ring(&mut self) {
        self.due.set(None);
        self.rings_rang = true;
    }

    /// Handles a datagram.
    pub(super) fn handle_datagram(
        &mut self,
        now: Duration,
        from: SocketAddr,
        to: IpAddr,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) {
        self.due.set(None);
        if let Some(engine) = &mut self.engine {
            engine.handle_datagram(now, 0, from, Some(to), ecn, bytes);
        }
    }

    /// Handles an answer of the KME.
    pub(super) fn handle_key_event(&mut self, now: Duration, event: crate::keys::KmeAnswer) {
        self.due.set(None);
        if let Some(engine) = &mut self.engine {
            engine.handle_key_event(now, event);
        }
    }

    /// Returns when the host has something to do.
    pub(super) fn poll_timeout(&self, now: Duration) -> Option<Duration> {
        let due = self.due.get().unwrap_or_else(|| self.look_when_due(now));
        self.due.set(Some(due));
        due
    }

    fn look_when_due(&self, now: Duration) -> Option<Duration> {
        let engine = self.engine.as_ref()?;
        let ready = {
            let came = self.graph_changed || self.rings_rang || self.rules.is_some();
            let came = came || !self.questions.is_empty();
            (came || self.interfaces_asked || !self.records.is_empty()).then_some(now)
        };
        let compressed = self.compressed.front().map(|(due, _)| *due);
        let beacons = self.beacons.as_ref().and_then(|beacons| beacons.peers.poll_timeout());
        let discovery = [self.discovery.poll_timeout(), beacons].into_iter().flatten().min();
        let parts = [engine.poll_timeout(now), ready, compressed, discovery];
        parts.into_iter().flatten().min()
    }

    /// Runs one pass of the host.
    pub(super) fn pass(&mut self, now: Duration) {
        self.due.set(None);
        let Some(engine) = &mut self.engine else { return };
        if std::mem::take(&mut self.graph_changed) {
            let range = EndpointRange { range: self.range, lists: Vec::new() };
            let endpoints = self.rings.endpoints().into_iter();
            let local = endpoints.map(|e| (e.gid, (e, range.clone()))).collect();
            engine.handle_local_graph(now, local);
        }
        if let Some(rules) = self.rules.take() {
            engine.handle_order(now, ToGateway::Rules(rules, 0));
        }
        for question in std::mem::take(&mut self.questions) {
            engine.handle_order(now, question);
        }
        if std::mem::take(&mut self.rings_rang) {
            engine.handle_rings(now);
        }
        if std::mem::take(&mut self.interfaces_asked) {
            engine.handle_interfaces(vec![Interface {
                name: "wlan0".into(),
                index: 1,
                address: IpAddr::V4(self.address),
                prefix: 16,
                broadcast: None,
                loopback: false,
            }]);
        }
        while let Some((_, answer)) = self.compressed.pop_front_if(|(due, _)| *due <= now) {
            engine.handle_compressed(now, answer);
        }
        for (link, key_id) in std::mem::take(&mut self.records) {
            let first = self.used.insert(key_id);
            engine.handle_recorded(now, link, first);
        }
        let ordered = self.beacons.iter_mut().flat_map(|beacons| beacons.take_orders(now));
        let ordered: Vec<_> = self.discovery.take_due(now).into_iter().chain(ordered).collect();
        for order in ordered {
            engine.handle_order(now, order);
        }
        if engine.poll_timeout(now).is_some_and(|due| due <= now) {
            engine.handle_timeout(now);
        }
        engine.settle(now);
        assert!(!self.rings.has_unannounced(), "readers are woken for all that was written");
        let mut effects = Vec::new();
        while let Some(effect) = engine.poll_effect() {
            effects.push(effect);
        }
        for effect in effects {
            self.apply(effect, now);
        }
    }

    fn apply(&mut self, effect: Effect, now: Duration) {
        match effect {
            Effect::Tell(what) => self.told(what, now),
            Effect::Kme(origin, request) => self.requests.push((origin, request)),
            Effect::Record { link, key_id } => self.records.push((link, key_id)),
            Effect::Interfaces => self.interfaces_asked = true,
            Effect::ReturnMemory => {}
            Effect::Compress(order) => {
                let took = Duration::from_secs_f64(order.payload.len() as f64 / COMPRESSOR);
                let answer = Compressor::new().compress(&order, || Duration::ZERO);
                // One after the other.
                let begun = self.compressed.back().map_or(now, |(due, _)| now.max(*due));
                self.compressed.push_back((begun + took, CompressionAnswer { took, ..answer }));
                self.compressions += 1;
            }
        }
    }

    fn told(&mut self, what: ToControl, now: Duration) {
        match what {
            ToControl::RemoteGraph { daemon, reset, added, removed } => {
                let graph = self.graph.entry(daemon).or_default();
                if reset {
                    graph.clear();
                }
                removed.iter().for_each(|gid| drop(graph.remove(gid)));
                graph.extend(added.into_iter().map(|e| (e.endpoint.gid, e)));
            }
            ToControl::Silent { daemon } => {
                self.graph.remove(&daemon);
                self.refusals.push_back((now, "silent".into()));
            }
            ToControl::LinkUp { daemon, address, proven } => {
                self.discovery.handle_link_up(daemon, address);
                if let Some(beacons) = &mut self.beacons {
                    beacons.peers.handle_link_up(now, daemon, address, proven);
                }
            }
            ToControl::Path { daemon, works } => {
                self.discovery.handle_path(now, daemon, works);
                if let Some(beacons) = &mut self.beacons {
                    beacons.peers.handle_path(now, daemon, works);
                }
            }
            ToControl::LinkDown { daemon, reason } => {
                self.graph.remove(&daemon);
                self.refusals.push_back((now, format!("down: {reason}")));
                self.discovery.handle_link_down(now, daemon);
                if let Some(beacons) = &mut self.beacons {
                    beacons.peers.handle_link_down(now, daemon);
                }
            }
            ToControl::DialFailed { daemon, standing, absent_at } => {
                self.discovery.handle_dial_failed(now, daemon);
                if let Some(beacons) = &mut self.beacons {
                    beacons.handle_dial_failed(now, daemon, standing, absent_at);
                }
            }
            ToControl::Refusal { peer, what, reason, .. } => {
                self.refusals.push_back((now, format!("{peer}: {what}: {reason}")));
            }
            ToControl::Lost { topic, cause, samples } => {
                *self.lost.entry((topic, cause)).or_default() += samples;
            }
            // Answers a probe as the control plane does.
            ToControl::Datagrams(datagrams) => {
                for (to, bytes) in datagrams.iter() {
                    if let Some(beacons) = &mut self.beacons {
                        beacons.peers.handle_datagram(now, to, Arrival::Quic, bytes);
                    } else if let (Ok(Datagram::Probe { nonce, .. }), Some(engine)) =
                        (Datagram::decode(bytes), &mut self.engine)
                    {
                        let bytes = Datagram::Echo { daemon: self.daemon, nonce }.encode();
                        engine.handle_order(now, ToGateway::SendDatagram { to, bytes });
                    }
                }
            }
            ToControl::Decisions { number, decisions } => {
                let before = self.decisions.insert(number, decisions);
                assert_eq!(before, None, "a question has one answer");
            }
            ToControl::Link(status, _) => {
                self.status.insert(status.peer.clone(), *status);
            }
            _ => {}
        }
    }

    /// Returns the next packets.
    pub(super) fn poll_transmit(
        &mut self,
        buffer: &mut Vec<u8>,
        now: Duration,
    ) -> Option<Transmit> {
        self.due.set(None);
        Some(self.engine.as_mut()?.poll_transmit(BATCH, buffer, now)?.1)
    }
}
