//! All links of this host: from a dial, or an incoming handshake, over HELLO and election to the hand-over to a
//! successor and the close.

mod election;
mod explained;
#[cfg(test)]
mod held;
mod leaving;
mod link;
mod prober;
mod shares;
mod silence;
mod who;

use std::{
    collections::{BTreeSet, HashMap, HashSet, VecDeque},
    net::{IpAddr, SocketAddr},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::DaemonId;
use axon_tls::quic::from_handshake_data;
use axon_transport::{config::Config, status::LinkStatus};
use bytes::BytesMut;
use quinn_proto::{
    ConnectionError, ConnectionHandle, Dir, EcnCodepoint, Event, Incoming, StreamEvent, Transmit,
    VarInt,
};

use self::link::{Link, Phase};
use super::{
    connection::{Carrier, Connection},
    control::ControlError,
    credentials::Credentials,
    endpoints::{Endpoints, Packet, Received},
    keyring::Keyring,
    link::{
        dialling::{Action, Dialling},
        opening::{Handshake, Opening, Refused},
    },
    protection::{Open, Seal},
};
use crate::{
    discovery::{AddressConfidence, is_discovery},
    engine::{
        account::{Account, Accounts},
        link::{
            failure::{close_text, peer_text},
            target::Target,
        },
        links::{
            explained::explained,
            link::Summary,
            shares::{Handshakes, Said},
        },
        refusal::{Refusal, RefusedBy},
    },
    keys::{self, Exporters},
    link::{CloseCode, Hello, LinkClosed, Message, Side},
    owner::{Binding, EXPORTER},
};

/// Handshakes under way at once, but for those of listed peers; further dials are refused and come again.
const MAX_HANDSHAKES: usize = 64;

/// A dialler that has its Retry is given this long for the rest of the handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// What came of the links, for the owner of the peers.
#[derive(Debug)]
pub(super) enum LinkEvent {
    /// A link of this peer is elected. It takes over from another one, if that is named.
    Up {
        number: u64,
        daemon: DaemonId,
        old: Option<u64>,
        /// To be said over the new link.
        closed: Option<LinkClosed>,
    },
    /// A message on the link in use.
    Message(u64, DaemonId, Message),
    /// An event of a data stream of any link of this peer.
    Stream(u64, DaemonId, StreamEvent),
    /// The keys of this link changed.
    Keys(DaemonId),
    /// A link that was not in use is over: nothing more of its streams can be read.
    Gone(u64, DaemonId),
    /// The last link of a peer is over.
    Down { number: u64, daemon: DaemonId, peer: String, reason: String },
}

/// What the links say to the control plane.
#[derive(Debug)]
pub(super) enum LinkReport {
    /// A link, or an attempt at one, was refused.
    Refused(String, Refusal),
    /// A dial failed.
    DialFailed { daemon: DaemonId, standing: AddressConfidence },
    /// A link of this daemon is up at this address.
    Up { daemon: DaemonId, address: SocketAddr },
    /// A datagram of discovery.
    Datagram { from: SocketAddr, bytes: Vec<u8> },
}

/// All links.
pub(super) struct Links {
    pub(super) config: Arc<Config>,
    pub(super) credentials: Credentials,
    pub(super) keyring: Option<Keyring>,
    hello: Hello,
    epoch: Instant,
    accounts: Accounts,
    endpoints: Endpoints,
    handles: HashMap<(usize, ConnectionHandle), u64>,
    connections: HashMap<u64, Connection>,
    links: HashMap<u64, Link>,
    /// The link in use of each peer.
    current: HashMap<DaemonId, u64>,
    dials: HashMap<u64, (Dialling, Option<u64>)>,
    /// For whom connections were dialled that are being opened.
    dialled: HashMap<u64, (DaemonId, AddressConfidence)>,
    next_number: u64,
    next_election: u64,
    handshakes: Rc<Handshakes>,
    /// Addresses of listed peers.
    listed: BTreeSet<IpAddr>,
    crowded: Said,
    /// Whether the daemon ends: no link begins any more.
    closing: bool,
    /// Connections with something to do.
    dirty: VecDeque<u64>,
    /// Links whose connection was lost, and that are not read to the end.
    lost: VecDeque<(u64, ConnectionError)>,
    /// Connections whose control stream has more, once the events that came are handled.
    later: Vec<u64>,
    /// Connections that may have something to transmit.
    transmitting: VecDeque<u64>,
    deadlines: BTreeSet<(Instant, u64)>,
    nonces: HashMap<[u8; 8], u64>,
    events: VecDeque<LinkEvent>,
    reports: VecDeque<LinkReport>,
    /// Dials that may go on.
    stirred_dials: HashSet<u64>,
    /// When links are looked at for silence and trust.
    next_second: Duration,
    seconds: u32,
}

/// The parts of [`Links`] that the daemon, or a simulation, makes.
pub(crate) struct LinkParts {
    /// The settings.
    pub(crate) config: Arc<Config>,
    /// Identity and TLS settings.
    pub(crate) credentials: Credentials,
    /// This side's HELLO.
    pub(crate) hello: Hello,
    /// The addresses that the endpoints are bound to.
    pub(crate) addresses: Vec<SocketAddr>,
    /// The settings of the endpoints.
    pub(crate) endpoint: Arc<quinn_proto::EndpointConfig>,
    /// When the engine's time was zero.
    pub(crate) epoch: Instant,
}

impl Links {
    /// No links yet.
    ///
    /// # Errors
    /// The settings make no TLS server.
    pub(super) fn new(parts: LinkParts) -> Result<Self, crate::error::GatewayError> {
        let LinkParts { config, credentials, hello, addresses, endpoint, epoch } = parts;
        let keyring = Keyring::new(&config);
        let unspecified = IpAddr::from([0, 0, 0, 0]);
        let resolver = keyring.as_ref().map(|keys| keys.resolver(Duration::ZERO, unspecified));
        let server = Arc::new(credentials.server(resolver)?);
        Ok(Self {
            accounts: Accounts::new(config.link.graph),
            config,
            credentials,
            keyring,
            hello,
            epoch,
            endpoints: Endpoints::new(&addresses, &endpoint, &server),
            handles: HashMap::new(),
            connections: HashMap::new(),
            links: HashMap::new(),
            current: HashMap::new(),
            dials: HashMap::new(),
            dialled: HashMap::new(),
            next_number: 1,
            next_election: 1,
            handshakes: Handshakes::new(MAX_HANDSHAKES),
            listed: BTreeSet::new(),
            crowded: Said::default(),
            dirty: VecDeque::new(),
            lost: VecDeque::new(),
            later: Vec::new(),
            closing: false,
            transmitting: VecDeque::new(),
            deadlines: BTreeSet::new(),
            nonces: HashMap::new(),
            events: VecDeque::new(),
            reports: VecDeque::new(),
            stirred_dials: HashSet::new(),
            next_second: Duration::from_secs(1),
            seconds: 0,
        })
    }

    fn instant(&self, now: Duration) -> Instant {
        self.epoch + now
    }

    fn number(&mut self) -> u64 {
        self.next_number += 1;
        self.next_number - 1
    }

    /// Handles a datagram that came to an endpoint.
    pub(super) fn handle_datagram(
        &mut self,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
        now: Duration,
    ) {
        if bytes.first().is_some_and(|first| is_discovery(*first)) {
            return self.handle_discovery(from, bytes, now);
        }
        if let Some(keyring) = &self.keyring {
            keyring.set_time(now);
        }
        self.credentials.set_time(now);
        let instant = self.instant(now);
        match self.endpoints.handle(instant, endpoint, from, local, ecn, bytes) {
            Received::Connection(handle, event) => {
                let Some(number) = self.handles.get(&(endpoint, handle)).copied() else { return };
                if let Some(connection) = self.connections.get_mut(&number) {
                    connection.quic.handle_event(event);
                    self.touch(number);
                }
            }
            Received::Incoming(incoming) => self.accept(endpoint, incoming, now),
            Received::Done => {}
        }
    }

    /// Has a connection looked at in this pass.
    pub(super) fn touch(&mut self, number: u64) {
        if let Some(connection) = self.connections.get_mut(&number)
            && !std::mem::replace(&mut connection.is_dirty, true)
        {
            self.dirty.push_back(number);
        }
    }

    /// Begins to dial a peer.
    pub(super) fn dial(&mut self, target: Target, now: Duration) {
        if self.closing {
            return;
        }
        let number = self.number();
        let dialling = Dialling::new(now, target, self.keyring.as_ref());
        self.dials.insert(number, (dialling, None));
        self.stirred_dials.insert(number);
    }

    /// The addresses of listed peers.
    pub(super) fn set_listed(&mut self, addresses: BTreeSet<IpAddr>) {
        self.listed = addresses;
    }

    /// Sends a datagram of discovery.
    pub(super) fn send_datagram(&mut self, to: SocketAddr, bytes: Vec<u8>) {
        self.endpoints.send(to, bytes);
    }

    fn accept(&mut self, endpoint: usize, incoming: Incoming, now: Duration) {
        if self.closing {
            return self.endpoints.refuse(endpoint, incoming);
        }
        if !incoming.remote_address_validated() {
            return self.endpoints.retry(endpoint, incoming);
        }
        let source = incoming.remote_address();
        let listed = self.listed.contains(&source.ip().to_canonical());
        let Some(place) = self.handshakes.enter(source.ip(), listed) else {
            self.endpoints.refuse(endpoint, incoming);
            let instant = self.instant(now);
            if self.crowded.is_news(source.ip(), instant) {
                let text = "hosts at this address have as many handshakes under way as they may";
                let refusal = Refusal::here(CloseCode::NotAllowed, text);
                self.report(LinkReport::Refused(peer_text(None, source), refusal));
            }
            return;
        };
        let resolver = self.keyring.as_ref().map(|keys| keys.resolver(now, source.ip()));
        let server = match self.credentials.server(resolver.clone()) {
            Ok(server) => Arc::new(server),
            Err(error) => {
                self.endpoints.refuse(endpoint, incoming);
                let refusal = Refusal::here(CloseCode::Internal, error);
                return self.report(LinkReport::Refused(peer_text(None, source), refusal));
            }
        };
        let instant = self.instant(now);
        match self.endpoints.accept(instant, endpoint, incoming, server) {
            Ok((handle, quic)) => {
                let number = self.number();
                let mut link = Link::new(Side::Server, now + HANDSHAKE_TIMEOUT, None);
                (link.place, link.resolver) = (Some(place), resolver);
                self.insert(number, endpoint, handle, quic, link);
            }
            Err(error) => {
                if let Some(refusal) = explained(&error, resolver.as_deref(), source) {
                    self.refused_incoming(source, resolver.as_deref(), refusal);
                }
            }
        }
    }

    fn insert(
        &mut self,
        number: u64,
        endpoint: usize,
        handle: ConnectionHandle,
        quic: quinn_proto::Connection,
        link: Link,
    ) {
        self.handles.insert((endpoint, handle), number);
        self.connections.insert(number, Connection::new(endpoint, handle, quic));
        self.links.insert(number, link);
        self.touch(number);
    }

    fn refused_incoming(
        &mut self,
        source: SocketAddr,
        resolver: Option<&keys::Resolver>,
        refusal: Refusal,
    ) {
        let claimed = resolver.and_then(keys::Resolver::identity);
        let peer = peer_text(claimed.as_ref().map(|i| i.client_sae()), source);
        self.report(LinkReport::Refused(peer, refusal));
    }

    fn report(&mut self, report: LinkReport) {
        self.reports.push_back(report);
    }

    /// The next report for the control plane.
    pub(super) fn poll_report(&mut self) -> Option<LinkReport> {
        self.reports.pop_front()
    }

    /// The next event for the peers.
    pub(super) fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// Looks at the connections with something to do. Their events follow.
    pub(super) fn settle(&mut self, now: Duration) {
        for number in std::mem::take(&mut self.later) {
            self.touch(number);
        }
        self.go_on_dialling(now);
        while let Some(number) = self.dirty.pop_front() {
            self.drive(number, now);
        }
        self.pass_keys_on(now);
    }

    /// Handles the events of one connection.
    fn drive(&mut self, number: u64, now: Duration) {
        let Some(connection) = self.connections.get_mut(&number) else { return };
        connection.is_dirty = false;
        while let Some(event) = connection.quic.poll_endpoint_events() {
            let (endpoint, handle) = (connection.endpoint, connection.handle);
            if let Some(event) = self.endpoints.handle_event(endpoint, handle, event) {
                connection.quic.handle_event(event);
            }
        }
        loop {
            let Some(connection) = self.connections.get_mut(&number) else { return };
            match connection.quic.poll() {
                Some(Event::Connected) => self.handle_connected(number, now),
                Some(Event::ConnectionLost { reason }) => {
                    self.read_control(number, now);
                    match self.links.get(&number) {
                        Some(Link { peer: Some(_), .. }) => self.lost.push_back((number, reason)),
                        _ => self.handle_lost(number, &reason, now),
                    }
                }
                Some(Event::Stream(event)) => self.handle_stream(number, event),
                Some(_) => {}
                None => break,
            }
        }
        self.read_control(number, now);
        self.note_heard(number);
        self.note_connection(number);
    }

    /// Writes what waits on the control stream, and notes when the connection is due and that it may transmit.
    fn note_connection(&mut self, number: u64) {
        let Some(connection) = self.connections.get_mut(&number) else { return };
        if connection.control.has_output() {
            connection.control.write(&mut connection.quic);
        }
        if connection.quic.is_drained() && !self.lost.iter().any(|(lost, _)| *lost == number) {
            if let Some(connection) = self.connections.remove(&number) {
                let handle = (connection.endpoint, connection.handle);
                // QUIC may have given it to another connection since.
                if self.handles.get(&handle) == Some(&number) {
                    self.handles.remove(&handle);
                }
                self.deadlines.remove(&(connection.deadline.unwrap_or(self.epoch), number));
            }
            return;
        }
        if !std::mem::replace(&mut connection.is_transmitting, true) {
            self.transmitting.push_back(number);
        }
        self.note_deadline(number);
    }

    fn note_deadline(&mut self, number: u64) {
        let Some(connection) = self.connections.get_mut(&number) else { return };
        let due = connection.quic.poll_timeout();
        if due != connection.deadline {
            if let Some(before) = std::mem::replace(&mut connection.deadline, due) {
                self.deadlines.remove(&(before, number));
            }
            self.deadlines.extend(due.map(|due| (due, number)));
        }
    }

    /// The TLS handshake of a connection is complete.
    fn handle_connected(&mut self, number: u64, now: Duration) {
        let Some(link) = self.links.get_mut(&number) else { return };
        let Phase::Handshake(_, dial) = link.phase else { return };
        match dial {
            Some(dial) => {
                if let Some((dialling, _)) = self.dials.get_mut(&dial) {
                    dialling.handle_connected();
                    self.stirred_dials.insert(dial);
                }
            }
            None => {
                let ours = self.hello.clone();
                self.begin_opening(number, ours, None, now);
            }
        }
    }

    /// Begins HELLO on a connection whose handshake is complete.
    fn begin_opening(&mut self, number: u64, ours: Hello, dialled: Option<String>, now: Duration) {
        let (Some(connection), Some(link)) =
            (self.connections.get_mut(&number), self.links.get_mut(&number))
        else {
            return;
        };
        let session = connection.quic.crypto_session();
        let exporters = Exporters::derive(|out, label| {
            session.export_keying_material(out, label, b"").map_err(|_| ())
        });
        let handshake = Handshake {
            connection: number,
            side: link.side,
            remote: connection.quic.remote_address(),
            negotiated: session.handshake_data().and_then(from_handshake_data),
            exporters: exporters.ok(),
            chain: chain(&connection.quic),
            dialled,
        };
        if link.side == Side::Client
            && let Some(stream) = connection.quic.streams().open(Dir::Bi)
        {
            connection.control.open(stream, &mut connection.quic);
        }
        let closed = self.credentials.closed();
        let opening =
            Opening::new(now, handshake, ours, &self.config, closed, self.keyring.as_mut());
        link.phase = Phase::Opening(Box::new(opening));
        self.go_on_opening(number, now);
        self.touch(number);
    }

    /// Passes on what an opening says, and what came of it.
    fn go_on_opening(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(link)) =
            (self.connections.get_mut(&number), self.links.get_mut(&number))
        else {
            return;
        };
        let Phase::Opening(opening) = &mut link.phase else { return };
        let outcome = opening.poll_outcome(now, self.keyring.as_mut());
        while let Some(message) = opening.poll_message() {
            // HELLO and proofs always fit.
            let _ = connection.control.send(&message);
        }
        connection.control.set_limits(opening.limits());
        self.touch(number);
        match outcome {
            Some(Ok(opened)) => self.established(number, opened, now),
            Some(Err(refused)) => self.opening_refused(number, refused, now),
            None => {}
        }
    }

    fn opening_refused(&mut self, number: u64, refused: Refused, now: Duration) {
        let Some(link) = self.links.remove(&number) else { return };
        let Refused { refusal, close } = refused;
        let address = self.connections.get(&number).map(|c| c.quic.remote_address());
        if let Some((code, told)) = close {
            self.close_connection(number, code, &told, now);
        }
        let Some(address) = address else { return };
        match link.side {
            Side::Server => self.refused_incoming(address, link.resolver.as_deref(), refusal),
            Side::Client => {
                self.report(LinkReport::Refused(peer_text(None, address), refusal));
                self.failed_after_dial(number);
            }
        }
    }

    /// Ends the links whose connection was lost. Returns whether there were any.
    pub(super) fn end_lost(&mut self, now: Duration) -> bool {
        let any = !self.lost.is_empty();
        while let Some((number, reason)) = self.lost.pop_front() {
            self.handle_lost(number, &reason, now);
            self.touch(number);
        }
        any
    }

    /// A connection was lost.
    fn handle_lost(&mut self, number: u64, reason: &ConnectionError, now: Duration) {
        let Some(link) = self.links.get_mut(&number) else { return };
        match &mut link.phase {
            Phase::Handshake(_, Some(dial)) => {
                let dial = *dial;
                if let Some((dialling, _)) = self.dials.get_mut(&dial) {
                    dialling.handle_failed(reason);
                    self.stirred_dials.insert(dial);
                }
                self.links.remove(&number);
            }
            Phase::Handshake(_, None) => {
                let link = self.links.remove(&number);
                let resolver = link.and_then(|link| link.resolver);
                let address = self.connections.get(&number).map(|c| c.quic.remote_address());
                if let Some(address) = address
                    && let Some(refusal) = explained(reason, resolver.as_deref(), address)
                {
                    self.refused_incoming(address, resolver.as_deref(), refusal);
                }
            }
            Phase::Opening(opening) => {
                opening.handle_lost(now, reason, self.keyring.as_mut());
                self.go_on_opening(number, now);
            }
            Phase::Electing(_) | Phase::Open | Phase::Leaving(_) => {
                let refusal = Refusal::of(reason);
                let text = refusal.to_string();
                self.end_link(number, &text, Some(refusal), now);
            }
        }
    }

    fn handle_stream(&mut self, number: u64, event: StreamEvent) {
        let Some(connection) = self.connections.get_mut(&number) else { return };
        match event {
            StreamEvent::Opened { dir: Dir::Bi } => {
                let stream = connection.quic.streams().accept(Dir::Bi);
                if let (Some(stream), None) = (stream, connection.control.stream()) {
                    connection.control.open(stream, &mut connection.quic);
                }
            }
            StreamEvent::Readable { id } if connection.control.stream() == Some(id) => {
                connection.control.handle_readable();
            }
            StreamEvent::Writable { id }
            | StreamEvent::Finished { id }
            | StreamEvent::Stopped { id, .. }
                if connection.control.stream() == Some(id) => {}
            // Data is sent over unidirectional streams.
            StreamEvent::Readable { id } if id.dir() == Dir::Bi => {}
            event => {
                // Before the election a link carries nothing, whoever its peer says to be.
                let link = self.links.get(&number).filter(|link| link.carries());
                let peer = link.and_then(|link| link.peer.as_ref());
                if let Some(daemon) = peer.map(|peer| peer.summary.hello.daemon) {
                    self.events.push_back(LinkEvent::Stream(number, daemon, event));
                }
            }
        }
    }

    /// Reads the messages of a control stream that have come.
    fn read_control(&mut self, number: u64, now: Duration) {
        loop {
            let (Some(connection), Some(link)) =
                (self.connections.get_mut(&number), self.links.get_mut(&number))
            else {
                return;
            };
            if let Phase::Opening(opening) = &link.phase
                && !opening.reads()
            {
                return;
            }
            if matches!(link.phase, Phase::Handshake(..)) {
                return;
            }
            let (instant, account) =
                (self.epoch + now, link.peer.as_ref().map(|peer| Rc::clone(&peer.account)));
            let owe = |cost| account.as_ref().map_or(Duration::ZERO, |a| a.owe(cost, instant));
            match connection.control.read(&mut connection.quic, owe, now) {
                Ok(Some(message)) => self.handle_message(number, message, now),
                Ok(None) => return,
                Err(error) => return self.handle_control_error(number, error, now),
            }
            // A message is handled before the next is decoded, so that a peer fills no queue here.
            if !self.events.is_empty() {
                return self.later.push(number);
            }
        }
    }

    fn handle_control_error(&mut self, number: u64, error: ControlError, now: Duration) {
        let Some(link) = self.links.get_mut(&number) else { return };
        if let Phase::Opening(opening) = &mut link.phase {
            match error {
                ControlError::Frame(error) => {
                    opening.handle_unreadable(now, error, self.keyring.as_mut());
                }
                other => opening.handle_ended(now, &other.to_string(), self.keyring.as_mut()),
            }
            return self.go_on_opening(number, now);
        }
        let text = error.to_string();
        match error {
            ControlError::Frame(crate::link::FrameError::TooLarge { .. }) => {
                self.violation(number, CloseCode::TooLarge, &text, now);
            }
            ControlError::Frame(_) => self.violation(number, CloseCode::Malformed, &text, now),
            _ if matches!(link.phase, Phase::Leaving(_)) => self.leaving_ended(number),
            _ => self.end_link(number, &text, None, now),
        }
    }

    fn handle_message(&mut self, number: u64, message: Message, now: Duration) {
        let Some(link) = self.links.get_mut(&number) else { return };
        if let Phase::Opening(opening) = &mut link.phase {
            opening.handle_message(now, &message, self.keyring.as_mut());
            return self.go_on_opening(number, now);
        }
        let Some(peer) = &mut link.peer else { return };
        if let Err(error) = peer.order.accept(&message) {
            return self.violation(number, CloseCode::OutOfOrder, &error.to_string(), now);
        }
        let daemon = peer.summary.hello.daemon;
        match message {
            Message::Elected(elected) => {
                peer.order.elected();
                self.open(number, elected, now);
            }
            Message::Keys(keys) => {
                let Some(keyring) = self.keyring.as_mut().filter(|_| peer.seals) else { return };
                if let Err(error) = keyring.handle_message(now, number, &keys) {
                    let code = CloseCode::from_code(error.code()).unwrap_or(CloseCode::Internal);
                    self.violation(number, code, &error.to_string(), now);
                }
            }
            // A predecessor's are old.
            _ if self.current.get(&daemon) != Some(&number) => {}
            message => {
                match &message {
                    Message::Graph(_) => self.succeeded(daemon),
                    Message::LinkClosed(closed) => self.closed_by_peer(daemon, *closed),
                    _ => {}
                }
                self.events.push_back(LinkEvent::Message(number, daemon, message));
            }
        }
    }

    /// Goes on with the dials that have something to do.
    fn go_on_dialling(&mut self, now: Duration) {
        for dial in std::mem::take(&mut self.stirred_dials) {
            while let Some((dialling, _)) = self.dials.get_mut(&dial) {
                let Some(action) = dialling.poll_action(now, self.keyring.as_mut()) else { break };
                self.act(dial, action, now);
            }
        }
    }

    fn act(&mut self, dial: u64, action: Action, now: Duration) {
        let instant = self.instant(now);
        let Some((dialling, under_way)) = self.dials.get_mut(&dial) else { return };
        match action {
            Action::Connect { address, attempt } => {
                let client = match self.credentials.client(attempt.as_deref()) {
                    Ok(client) => client,
                    Err(error) => return dialling.handle_unusable(error),
                };
                match self.endpoints.connect(instant, address, client) {
                    Ok((endpoint, handle, quic)) => {
                        let number = self.next_number;
                        self.next_number += 1;
                        *under_way = Some(number);
                        let mut link = Link::new(Side::Client, Duration::MAX, Some(dial));
                        link.replaces = dialling.target().replaces;
                        self.insert(number, endpoint, handle, quic, link);
                    }
                    Err(error) => dialling.handle_unreachable(error.as_ref()),
                }
            }
            Action::Close { code, reason } => {
                if let Some(number) = under_way.take() {
                    self.links.remove(&number);
                    self.close_connection(number, code, reason, now);
                }
            }
            Action::Open => {
                let Some((dialling, Some(number))) = self.dials.remove(&dial) else { return };
                let target = dialling.target();
                let hello = target.hello(&self.hello);
                let sae = target.sae.clone();
                self.note_dialled(number, target.daemon.zip(target.standing));
                self.begin_opening(number, hello, sae, now);
                if !self.links.contains_key(&number) {
                    self.failed_after_dial(number);
                }
            }
            Action::Failed(refusal) => {
                let Some((dialling, _)) = self.dials.remove(&dial) else { return };
                let target = dialling.target();
                self.reports.push_back(LinkReport::Refused(target.text(), refusal));
                if let (Some(daemon), Some(standing)) = (target.daemon, target.standing) {
                    self.reports.push_back(LinkReport::DialFailed { daemon, standing });
                }
            }
        }
    }

    /// Passes on what the keyring says.
    fn pass_keys_on(&mut self, now: Duration) {
        let mut changed = HashSet::new();
        while let Some(keyring) = &mut self.keyring {
            if let Some((connection, message)) = keyring.poll_message(now) {
                self.send(connection, &Message::Keys(message), now);
            } else if let Some(connection) = keyring.poll_changed(now) {
                changed.insert(connection);
            } else {
                break;
            }
        }
        for number in changed {
            self.go_on_opening(number, now);
            let peer = self.links.get(&number).and_then(|link| link.peer.as_ref());
            if let Some(daemon) = peer.map(|peer| peer.summary.hello.daemon) {
                self.events.push_back(LinkEvent::Keys(daemon));
            }
        }
    }

    /// The KME answered, or the ledger of used keys.
    pub(super) fn handle_key_event(&mut self, event: keys::Event, now: Duration) {
        let Some(keyring) = &mut self.keyring else { return };
        match keyring.handle_answer(now, event) {
            super::keyring::Answered::Here => {}
            super::keyring::Answered::Dialler => {
                for (dial, (dialling, _)) in &mut self.dials {
                    dialling.handle_key();
                    self.stirred_dials.insert(*dial);
                }
            }
            super::keyring::Answered::Opening(number, answer) => {
                if let Some(Link { phase: Phase::Opening(opening), .. }) =
                    self.links.get_mut(&number)
                {
                    opening.handle_answer(now, answer, self.keyring.as_mut());
                    self.go_on_opening(number, now);
                }
            }
        }
    }

    /// The ledger of used keys recorded the key of a connection; `first` if it was new.
    pub(super) fn handle_recorded(&mut self, number: u64, first: bool, now: Duration) {
        if let Some(Link { phase: Phase::Opening(opening), .. }) = self.links.get_mut(&number) {
            opening.handle_recorded(now, first, self.keyring.as_mut());
            self.go_on_opening(number, now);
        }
    }

    /// The next request to the KME.
    pub(super) fn poll_request(&mut self, now: Duration) -> Option<(keys::Origin, keys::Request)> {
        self.keyring.as_mut()?;
        for link in self.links.values_mut() {
            if let Phase::Opening(opening) = &mut link.phase
                && let Some(request) = opening.poll_request(now)
            {
                return Some(request);
            }
        }
        self.keyring.as_mut()?.poll_request(now)
    }

    /// Queues a control message.
    pub(super) fn send(&mut self, number: u64, message: &Message, now: Duration) {
        let Some(connection) = self.connections.get_mut(&number) else { return };
        match connection.control.send(message) {
            Ok(()) => self.touch(number),
            Err(error) => {
                tracing::error!(%error, "a control message could not be sent");
                self.violation(number, CloseCode::TooLarge, &error.to_string(), now);
            }
        }
    }

    /// The connection of a link as a carrier of samples.
    pub(super) fn carrier(&mut self, number: u64) -> Option<Carrier<'_>> {
        let connection = self.connections.get_mut(&number)?;
        let seals = self.links.get(&number)?.peer.as_ref()?.seals;
        let seal = match self.keyring.as_mut().filter(|_| seals) {
            Some(keyring) => match keyring.sender(number) {
                Some(sender) => Seal::Envelope { sender, connection: number },
                None => return None,
            },
            None => Seal::Link,
        };
        Some(connection.carrier(seal))
    }

    /// The connection of a link, and what opens its messages.
    pub(super) fn reader(
        &mut self,
        number: u64,
    ) -> Option<(&mut quinn_proto::Connection, Open<'_>)> {
        let connection = self.connections.get_mut(&number)?;
        let link = self.links.get(&number).filter(|link| link.carries())?;
        let seals = link.peer.as_ref()?.seals;
        let open = match self.keyring.as_mut().filter(|_| seals) {
            Some(keyring) => {
                let receiver = keyring.receiver(number)?;
                Open::Envelope { receiver, connection: number }
            }
            None => Open::Link,
        };
        Some((&mut connection.quic, open))
    }

    /// The connection of a link.
    pub(super) fn connection(&mut self, number: u64) -> Option<&mut Connection> {
        self.connections.get_mut(&number)
    }

    /// The flow of a stream of a link.
    pub(super) fn flow_of(
        &self,
        number: u64,
        stream: quinn_proto::StreamId,
    ) -> Option<super::outbound::FlowId> {
        self.connections.get(&number)?.flows.get(&stream).copied()
    }

    /// The summary of a link.
    pub(super) fn summary(&self, number: u64) -> Option<&Summary> {
        Some(&self.links.get(&number)?.peer.as_ref()?.summary)
    }

    /// The account of a link's peer.
    pub(super) fn account(&self, number: u64) -> Option<Rc<Account>> {
        Some(Rc::clone(&self.links.get(&number)?.peer.as_ref()?.account))
    }

    /// Who the peer of a link proved to be, beyond its daemon id.
    pub(super) fn identity(&self, number: u64) -> Option<String> {
        let address = self.connections.get(&number)?.quic.remote_address();
        Some(self.summary(number)?.who.host_identity(address))
    }

    /// The status of a link.
    pub(super) fn status(&self, number: u64) -> Option<LinkStatus> {
        let quic = &self.connections.get(&number)?.quic;
        let peer = self.links.get(&number)?.peer.as_ref()?;
        Some(who::link(&peer.summary, quic, peer.since_unix_ms))
    }

    /// Datagrams that came over a link.
    pub(super) fn heard(&self, number: u64) -> u64 {
        self.connections.get(&number).map_or(0, |c| c.quic.stats().udp_rx.datagrams)
    }

    /// Ends a link since its host has another one.
    pub(super) fn replace(&mut self, number: u64, why: &str, now: Duration) {
        self.close_connection(number, CloseCode::Replaced, why, now);
        self.end_link(number, why, None, now);
    }

    /// The next key to record in the ledger of used keys, and its connection.
    pub(super) fn poll_record(&mut self) -> Option<(u64, String)> {
        self.keyring.as_mut()?.poll_record()
    }

    /// The peer of a link, as log and status name it.
    pub(super) fn peer_text(&self, number: u64) -> String {
        let sae = self.summary(number).and_then(|summary| summary.hello.sae.as_deref());
        let address = self.connections.get(&number).map(|c| c.quic.remote_address());
        address.map_or_else(String::new, |address| peer_text(sae, address))
    }

    /// Bytes that both ends of a connection share and no other connection has.
    pub(super) fn binding(&self, number: u64) -> Option<Binding> {
        let mut binding = [0; 32];
        let session = self.connections.get(&number)?.quic.crypto_session();
        session.export_keying_material(&mut binding, EXPORTER, b"").ok()?;
        Some(binding)
    }

    /// The link in use of a peer.
    pub(super) fn current(&self, daemon: DaemonId) -> Option<u64> {
        self.current.get(&daemon).copied()
    }

    /// Ends a link whose peer broke a rule.
    pub(super) fn violation(&mut self, number: u64, code: CloseCode, why: &str, now: Duration) {
        self.violation_told(number, code, why, why, now);
    }

    /// As [`violation`](Self::violation), with another text for the peer.
    pub(super) fn violation_told(
        &mut self,
        number: u64,
        code: CloseCode,
        why: &str,
        told: &str,
        now: Duration,
    ) {
        if self.links.contains_key(&number) {
            let peer = self.peer_text(number);
            self.report(LinkReport::Refused(peer, Refusal::here(code, why)));
            self.close_connection(number, code, told, now);
        }
        self.end_link(number, why, None, now);
    }

    /// Closes a connection. Its last packets leave with the pass.
    fn close_connection(&mut self, number: u64, code: CloseCode, reason: &str, now: Duration) {
        let instant = self.instant(now);
        if let Some(keyring) = &mut self.keyring {
            keyring.forget_connection(now, number);
        }
        self.failed_after_dial(number);
        let Some(connection) = self.connections.get_mut(&number) else { return };
        connection.control.close();
        let code = VarInt::from_u32(code.code());
        let reason = bytes::Bytes::copy_from_slice(close_text(reason));
        connection.quic.close(instant, code, reason);
        self.touch(number);
    }

    /// A link is over.
    pub(super) fn end_link(
        &mut self,
        number: u64,
        reason: &str,
        refusal: Option<Refusal>,
        now: Duration,
    ) {
        let Some(link) = self.links.get(&number) else { return };
        let peer = self.peer_text(number);
        let daemon = link.peer.as_ref().map(|peer| peer.summary.hello.daemon);
        self.links.remove(&number);
        self.close_connection(number, CloseCode::Goodbye, "the control stream ended", now);
        self.nonces.retain(|_, link| *link != number);
        let Some(daemon) = daemon else { return };
        if self.current.get(&daemon) != Some(&number) {
            return self.events.push_back(LinkEvent::Gone(number, daemon));
        }
        self.current.remove(&daemon);
        self.abandon_leaving(daemon, now);
        tracing::info!(peer = %daemon, reason, "link down");
        if let Some(refusal) = refusal.filter(|refusal| refusal.by == RefusedBy::Peer)
            && !["GOODBYE", "DUPLICATE", "REPLACED"].contains(&refusal.name.as_str())
        {
            self.report(LinkReport::Refused(peer.clone(), refusal));
        }
        let reason = reason.to_owned();
        self.events.push_back(LinkEvent::Down { number, daemon, peer, reason });
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let quic = self.deadlines.first().map(|(due, _)| due.saturating_duration_since(self.epoch));
        let links = self.links.values().filter_map(Link::poll_timeout).min();
        let control = self.connections.values().filter_map(|c| c.control.poll_timeout()).min();
        let dials = self.dials.values().filter_map(|(dialling, _)| dialling.poll_timeout()).min();
        let keys = self.keyring.as_ref().map(Keyring::poll_timeout);
        let second = (!self.links.is_empty()).then_some(self.next_second);
        [quic, links, control, dials, keys, second].into_iter().flatten().min()
    }

    /// Does what is due.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        let instant = self.instant(now);
        while let Some((due, number)) = self.deadlines.first().copied()
            && due <= instant
        {
            self.deadlines.pop_first();
            if let Some(connection) = self.connections.get_mut(&number) {
                connection.deadline = None;
                connection.quic.handle_timeout(instant);
                self.touch(number);
            }
        }
        if let Some(keyring) = &mut self.keyring
            && keyring.poll_timeout() <= now
        {
            keyring.handle_timeout(now);
        }
        let dials =
            self.dials.iter().filter(|(_, (d, _))| d.poll_timeout().is_some_and(|t| t <= now));
        self.stirred_dials.extend(dials.map(|(dial, _)| *dial));
        let paused = self
            .connections
            .iter()
            .filter(|(_, c)| c.control.poll_timeout().is_some_and(|t| t <= now));
        let paused: Vec<u64> = paused.map(|(number, _)| *number).collect();
        paused.into_iter().for_each(|number| self.touch(number));
        let due = self.links.iter().filter(|(_, l)| l.poll_timeout().is_some_and(|t| t <= now));
        let due: Vec<u64> = due.map(|(number, _)| *number).collect();
        due.into_iter().for_each(|number| self.link_timeout(number, now));
        if now >= self.next_second {
            self.next_second = now + Duration::from_secs(1);
            self.seconds = self.seconds.wrapping_add(1);
            self.close_untrusted(self.seconds.is_multiple_of(60), now);
            self.look_for_silence(now);
            self.widen_all();
        }
    }

    fn link_timeout(&mut self, number: u64, now: Duration) {
        let Some(link) = self.links.get_mut(&number) else { return };
        match &mut link.phase {
            Phase::Handshake(..) => {
                let resolver = link.resolver.take();
                self.links.remove(&number);
                let address = self.connections.get(&number).map(|c| c.quic.remote_address());
                self.close_connection(number, CloseCode::Goodbye, "", now);
                if let Some(address) = address {
                    let text = "the dialler did not finish its handshake within 10 s";
                    self.refused_incoming(address, resolver.as_deref(), Refusal::network(text));
                }
            }
            Phase::Opening(opening) => {
                opening.handle_timeout(now, self.keyring.as_mut());
                self.go_on_opening(number, now);
            }
            Phase::Electing(until) if *until <= now => {
                self.close_connection(number, CloseCode::Duplicate, "not elected within 10 s", now);
                self.end_link(number, "not elected", None, now);
            }
            Phase::Leaving(_) => self.leaving_timeout(number, now),
            Phase::Electing(_) => {}
            Phase::Open => self.open_timeout(number, now),
        }
    }

    /// Whether [`settle`](Self::settle) has something to do.
    pub(super) fn has_work(&self) -> bool {
        !self.dirty.is_empty() || !self.later.is_empty() || !self.events.is_empty()
    }

    /// The next packets. `buffer` is cleared and filled.
    pub(super) fn poll_transmit(
        &mut self,
        max_datagrams: usize,
        buffer: &mut Vec<u8>,
        now: Duration,
    ) -> Option<(usize, Transmit)> {
        buffer.clear();
        if let Some(Packet { endpoint, to, from, ecn, bytes }) = self.endpoints.poll_packet() {
            let size = bytes.len();
            *buffer = bytes;
            let transmit =
                Transmit { destination: to, ecn, size, segment_size: None, src_ip: from };
            return Some((endpoint, transmit));
        }
        let instant = self.instant(now);
        while let Some(number) = self.transmitting.front().copied() {
            let transmit = self.connections.get_mut(&number).and_then(|connection| {
                let transmit = connection.quic.poll_transmit(instant, max_datagrams, buffer)?;
                Some((connection.endpoint, transmit))
            });
            // Connections take turns.
            self.transmitting.pop_front();
            self.note_deadline(number);
            if let Some(transmit) = transmit {
                self.transmitting.push_back(number);
                return Some(transmit);
            }
            if let Some(connection) = self.connections.get_mut(&number) {
                connection.is_transmitting = false;
            }
        }
        None
    }

    /// Whether all connections are over.
    pub(super) fn is_idle(&self) -> bool {
        self.connections.is_empty()
    }

    /// Closes all links: this host's daemon ends.
    pub(super) fn close_all(&mut self, now: Duration) {
        self.closing = true;
        self.dials.clear();
        let numbers: Vec<u64> = self.connections.keys().copied().collect();
        for number in numbers {
            self.close_connection(number, CloseCode::Goodbye, "the daemon ends", now);
        }
    }
}

/// The certificates, or the raw public key, that the peer of a connection showed.
fn chain(quic: &quinn_proto::Connection) -> Vec<rustls_pki_types::CertificateDer<'static>> {
    let shown = quic.crypto_session().peer_identity().and_then(|shown| shown.downcast().ok());
    shown.map(|shown| *shown).unwrap_or_default()
}
