//! All links of this host: from a dial or an incoming handshake, over HELLO and election, to the hand-over to
//! a successor and the close.

mod admission;
mod connections;
mod dials;
mod draining;
mod election;
mod ending;
mod events;
mod handshake_failure;
mod identity;
mod inbox;
mod keys;
mod link;
mod opening;
mod paths;
mod silence;
#[cfg(test)]
pub(in crate::engine) mod simulated;
mod table;
mod unfinished;

use std::{
    collections::{BTreeSet, HashMap},
    net::{IpAddr, SocketAddr},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use axon_shm::ids::DaemonId;
use axon_transport::{
    access::{AccessRules, Permissions},
    config::Config,
};
use bytes::BytesMut;
use quinn_proto::{Dir, EcnCodepoint, Event, StreamEvent, Transmit, TransportConfig};
use rand::{SeedableRng, rngs::StdRng};

pub(crate) use self::admission::place;
pub(super) use self::events::{LinkEvent, LinkReport};
use self::{
    admission::AddressAdmission,
    connections::Connections,
    dials::Dials,
    events::LinkOutbox,
    inbox::DiscoveryInbox,
    link::{Link, LinkPhase, take_over::TakeOver, view::LinkView},
    paths::PeerPaths,
    silence::{CheckSchedule, Nonce, frames_came},
    table::LinkTable,
    unfinished::UnfinishedConnections,
};
use super::{
    credentials::Credentials,
    keyring::Keyring,
    quic::{
        connection::Connection,
        control_stream::{ControlError, ControlInput},
        endpoints::QuicEndpoints,
        qlog::{self, Qlogs},
    },
};
use crate::{
    daemon_key::DaemonKey,
    discovery::{Interface, is_discovery},
    engine::{
        account::{Accounts, Charge},
        refusal::Refusal,
    },
    error::GatewayError,
    link::{CloseCode, FrameError, LinkHello, LinkMessage, Side},
};

/// All links.
pub(super) struct Links {
    pub(super) config: Arc<Config>,
    pub(super) credentials: Credentials,
    pub(super) keyring: Option<Keyring>,
    hello: LinkHello,
    daemon_key: Option<Arc<DaemonKey>>,
    qlogs: Option<Rc<dyn Qlogs>>,
    epoch: Instant,
    wall: WallClock,
    /// The generator of link ids and of the nonces of probes.
    random: StdRng,
    accounts: Accounts,
    connections: Connections,
    table: LinkTable,
    dials: Dials,
    admission: AddressAdmission,
    next_election: u64,
    /// True if the daemon is shutting down, so that no new link is opened.
    closing: bool,
    unfinished: UnfinishedConnections,
    /// The silent links that are probed, by the nonces of the probes.
    nonces: HashMap<Nonce, u64>,
    inbox: DiscoveryInbox,
    outbox: LinkOutbox,
    looks: CheckSchedule,
    paths: PeerPaths,
}

/// Returns the wall-clock time.
pub(crate) type WallClock = Rc<dyn Fn() -> SystemTime>;

/// The parts of [`Links`] that the daemon or a simulation supplies.
pub(crate) struct LinkParts {
    /// The settings.
    pub(crate) config: Arc<Config>,
    /// Identity and TLS settings.
    pub(crate) credentials: Credentials,
    /// This side's HELLO.
    pub(crate) hello: LinkHello,
    /// The key from which this side's ID is derived.
    pub(crate) daemon_key: Option<Arc<DaemonKey>>,
    /// The addresses that the endpoints are bound to.
    pub(crate) addresses: Vec<SocketAddr>,
    /// The settings of the endpoints.
    pub(crate) endpoint: Arc<quinn_proto::EndpointConfig>,
    /// The destination of QUIC's event logs, if there is one.
    pub(crate) qlogs: Option<Rc<dyn Qlogs>>,
    /// The instant of the engine's time zero.
    pub(crate) epoch: Instant,
    /// The wall clock. It dates the beginnings of links and decides when a pin has ended, and nothing else.
    pub(crate) wall: WallClock,
    /// The seed of link ids and of the nonces of probes. A daemon takes it from the operating system.
    pub(crate) seed: [u8; 32],
}

impl Links {
    /// Creates a set without links.
    ///
    /// # Errors
    /// The settings do not give a TLS server.
    pub(super) fn new(parts: LinkParts) -> Result<Self, GatewayError> {
        let LinkParts { config, credentials, hello, daemon_key, .. } = parts;
        let (addresses, endpoint) = (parts.addresses, parts.endpoint);
        let (qlogs, epoch, wall) = (parts.qlogs, parts.epoch, parts.wall);
        let keyring = Keyring::new(&config);
        let unspecified = IpAddr::from([0, 0, 0, 0]);
        let resolver = keyring.as_ref().map(|keys| keys.resolver(Duration::ZERO, unspecified));
        let server = Arc::new(credentials.server(resolver, unspecified)?);
        Ok(Self {
            accounts: Accounts::new(config.link.graph, config.link.held),
            config,
            credentials,
            keyring,
            hello,
            daemon_key,
            qlogs,
            epoch,
            wall,
            random: StdRng::from_seed(parts.seed),
            connections: Connections::new(
                QuicEndpoints::new(&addresses, &endpoint, &server),
                epoch,
            ),
            table: LinkTable::default(),
            dials: Dials::default(),
            admission: AddressAdmission::new(),
            next_election: 1,
            closing: false,
            unfinished: UnfinishedConnections::default(),
            nonces: HashMap::new(),
            inbox: DiscoveryInbox::new(),
            outbox: LinkOutbox::default(),
            looks: CheckSchedule::new(),
            paths: PeerPaths::default(),
        })
    }

    /// Returns the transport settings of a new connection whose events are logged.
    fn logged(&self, side: Side, peer: SocketAddr, now: Duration) -> Option<Arc<TransportConfig>> {
        let stream = qlog::stream(self.qlogs.as_deref(), side, peer, self.instant(now))?;
        Some(self.credentials.logged(stream, peer.ip()))
    }

    fn instant(&self, now: Duration) -> Instant {
        self.epoch + now
    }

    /// Handles a datagram that arrived at an endpoint.
    pub(super) fn handle_datagram(
        &mut self,
        now: Duration,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) {
        if bytes.first().is_some_and(|first| is_discovery(*first)) {
            return self.handle_discovery(now, from, local, bytes);
        }
        if let Some(keyring) = &self.keyring {
            keyring.set_time(now);
        }
        self.credentials.set_time(now);
        let instant = self.instant(now);
        let incoming = self.connections.handle_datagram(instant, endpoint, from, local, ecn, bytes);
        if let Some(incoming) = incoming {
            self.accept(endpoint, incoming, now);
        }
    }

    /// Returns whether discovery datagrams are held back because many arrived.
    pub(super) fn holds_discovery(&self) -> bool {
        self.inbox.is_holding()
    }

    /// Schedules a connection for this pass.
    pub(super) fn touch(&mut self, number: u64) {
        self.connections.touch(number);
    }

    /// Sets the addresses of listed peers.
    pub(super) fn set_listed(&mut self, addresses: BTreeSet<IpAddr>) {
        self.admission.set_listed(addresses);
    }

    /// Sends a discovery datagram.
    pub(super) fn send_datagram(&mut self, to: SocketAddr, bytes: Vec<u8>) {
        self.connections.endpoints().send(to, bytes);
    }

    /// Returns the next report for the control plane.
    pub(super) fn poll_report(&mut self) -> Option<LinkReport> {
        self.outbox.poll_report()
    }

    /// Returns the next event for the peers.
    pub(super) fn poll_event(&mut self) -> Option<LinkEvent> {
        self.outbox.poll_event()
    }

    /// Processes the connections with work. Their events are available afterwards.
    pub(super) fn settle(&mut self, now: Duration) {
        for number in self.unfinished.take_unread() {
            self.connections.touch(number);
        }
        self.go_on_dialling(now);
        if let Some(datagrams) = self.inbox.take(now) {
            self.outbox.report(LinkReport::Datagrams(datagrams));
        }
        while let Some(number) = self.connections.poll_dirty() {
            self.drive(number, now);
        }
        self.pass_keys_on(now);
    }

    /// Handles the events of one connection.
    fn drive(&mut self, number: u64, now: Duration) {
        loop {
            let Some(connection) = self.connections.get_mut(number) else { return };
            match connection.quic.poll() {
                Some(Event::Connected) => self.handle_connected(now, number),
                Some(Event::ConnectionLost { reason }) => {
                    self.read_control(number, now);
                    match self.table.get(number) {
                        Some(Link { peer: Some(_), .. }) => {
                            self.unfinished.add_lost(number, reason)
                        }
                        _ => self.handle_lost(now, number, &reason),
                    }
                }
                Some(Event::Stream(event)) => self.handle_stream(number, event),
                Some(_) => {}
                None => break,
            }
        }
        self.read_control(number, now);
        self.note_heard(number, now);
        self.connections.note(number, self.unfinished.is_lost(number));
    }

    fn handle_stream(&mut self, number: u64, event: StreamEvent) {
        let Some(connection) = self.connections.get_mut(number) else { return };
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
                // Before the election a link carries no samples, for any identity that its peer claims.
                let carries = |link: &&Link| link.carries() || link.carries_copies();
                let link = self.table.get(number).filter(carries);
                let peer = link.and_then(|link| link.peer.as_ref());
                if let Some(daemon) = peer.map(|peer| peer.summary.hello.daemon) {
                    self.outbox.event(LinkEvent::Stream(number, daemon, event));
                }
            }
        }
    }

    /// Reads the messages that have arrived on a control stream.
    fn read_control(&mut self, number: u64, now: Duration) {
        loop {
            let (Some(connection), Some(link)) =
                (self.connections.get_mut(number), self.table.get_mut(number))
            else {
                return;
            };
            if let LinkPhase::Opening(opening) = &link.phase
                && !opening.reads()
            {
                return;
            }
            if matches!(link.phase, LinkPhase::Handshake(..)) || link.postponed.is_some() {
                return;
            }
            let account = link.peer.as_ref().map(|peer| Rc::clone(&peer.account));
            let owe = |cost| account.as_ref().map_or(Duration::ZERO, |a| a.owe(cost, now));
            match connection.control.read(&mut connection.quic, owe, now) {
                Ok(ControlInput::Message(message, room)) => {
                    self.handle_message(now, number, *message, room);
                }
                Ok(ControlInput::Nothing) => return,
                Ok(ControlInput::NoRoom) => return self.unfinished.add_blocked(number),
                Err(error) => return self.handle_control_error(now, number, error),
            }
            // Each message is handled before the next one is decoded, so that a peer fills no queue here.
            if self.outbox.has_events() {
                return self.unfinished.add_unread(number);
            }
        }
    }

    fn handle_control_error(&mut self, now: Duration, number: u64, error: ControlError) {
        let Some(link) = self.table.get_mut(number) else { return };
        if let LinkPhase::Opening(opening) = &mut link.phase {
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
            ControlError::Frame(FrameError::TooLarge { .. }) => {
                self.violation(number, CloseCode::TooLarge, &text, now);
            }
            ControlError::Frame(_) => self.violation(number, CloseCode::Malformed, &text, now),
            _ if matches!(link.phase, LinkPhase::Leaving(_)) => self.leaving_ended(number),
            _ => self.end_link(number, &text, None, now),
        }
    }

    fn handle_message(
        &mut self,
        now: Duration,
        number: u64,
        message: LinkMessage,
        room: Option<Charge>,
    ) {
        let Some(link) = self.table.get_mut(number) else { return };
        if let LinkPhase::Opening(opening) = &mut link.phase {
            opening.handle_message(now, &message, self.keyring.as_mut());
            return self.go_on_opening(number, now);
        }
        let Some(peer) = &mut link.peer else { return };
        if let Err(error) = peer.order.accept(&message) {
            return self.violation(number, CloseCode::OutOfOrder, &error.to_string(), now);
        }
        let daemon = peer.summary.hello.daemon;
        match message {
            LinkMessage::Elected(elected) => {
                self.handle_take_over(number, TakeOver::Elected(elected), now);
            }
            LinkMessage::SwitchOver => self.handle_take_over(number, TakeOver::SwitchOver, now),
            LinkMessage::Keys(keys) => {
                let Some(keyring) = self.keyring.as_mut().filter(|_| peer.seals) else { return };
                if let Err(error) = keyring.handle_message(now, number, &keys) {
                    let code = CloseCode::from_code(error.code()).unwrap_or(CloseCode::Internal);
                    self.violation(number, code, &error.to_string(), now);
                }
            }
            // The message counts on any link, because another link may have taken over meanwhile.
            LinkMessage::LinkClosed(closed) => self.closed_by_peer(daemon, closed),
            // Messages on a predecessor are out of date.
            _ if self.current(daemon) != Some(number) => {}
            message => {
                if let LinkMessage::Graph(_) = &message {
                    self.succeeded(daemon);
                }
                let message = Box::new(message);
                self.outbox.event(LinkEvent::Message(number, daemon, message, room));
            }
        }
    }

    /// Queues a control message.
    pub(super) fn send(&mut self, number: u64, message: &LinkMessage, now: Duration) {
        let Some(connection) = self.connections.get_mut(number) else { return };
        match connection.control.send(message) {
            Ok(()) => self.connections.touch(number),
            Err(error) => {
                tracing::error!(%error, "a control message could not be sent");
                self.violation(number, CloseCode::TooLarge, &error.to_string(), now);
            }
        }
    }

    /// Returns the connection of a link.
    pub(super) fn connection(&mut self, number: u64) -> Option<&mut Connection> {
        self.connections.get_mut(number)
    }

    /// Returns a view of a link whose connection exists.
    pub(super) fn view(&self, number: u64) -> Option<LinkView<'_>> {
        Some(LinkView::new(self.connections.get(number)?, self.table.peer(number)))
    }

    /// Returns the peer of a link as log and status name it.
    pub(super) fn peer_text(&self, number: u64) -> String {
        self.view(number).map_or_else(String::new, |link| link.peer_text())
    }

    /// Applies the access rules' limits to the data that a link sends.
    pub(super) fn limit_egress(&mut self, number: u64, permissions: &Permissions) {
        if let (Some(peer), Some(connection)) =
            (self.table.peer(number), self.connections.get_mut(number))
        {
            peer.account.limits.limit_egress(&mut connection.egress, permissions);
        }
    }

    /// Applies the access rules' limits to the data that leaves by network interfaces.
    pub(super) fn set_interface_rules(&mut self, rules: &AccessRules) {
        self.connections.limit_interfaces(|limits| limits.set_rules(rules));
    }

    /// Handles the list of this host's network interfaces.
    pub(super) fn set_interfaces(&mut self, interfaces: Vec<Interface>) {
        self.connections.limit_interfaces(|limits| limits.set_interfaces(interfaces));
    }

    /// Returns whether the owner must list this host's network interfaces.
    pub(super) fn asks_for_interfaces(&mut self) -> bool {
        self.connections.asks_for_interfaces()
    }

    /// Returns the number of frames that arrived over a link.
    pub(super) fn heard(&self, number: u64) -> u64 {
        self.connections.get(number).map_or(0, |c| frames_came(&c.quic.stats()))
    }

    /// Returns the link in use of a peer.
    pub(super) fn current(&self, daemon: DaemonId) -> Option<u64> {
        self.table.current(daemon)
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let keys = self.keyring.as_ref().map(Keyring::poll_timeout);
        let look = (!self.table.is_empty()).then(|| self.looks.poll_timeout());
        let parts = [
            self.connections.poll_timeout(),
            self.table.poll_timeout(),
            self.dials.poll_timeout(),
            keys,
            look,
            self.inbox.poll_timeout(),
            self.paths_timeout(),
        ];
        parts.into_iter().flatten().min()
    }

    /// Does the work that is due.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        self.connections.handle_timeout(now);
        if let Some(keyring) = &mut self.keyring
            && keyring.poll_timeout() <= now
        {
            keyring.handle_timeout(now);
        }
        self.dials.handle_timeout(now);
        self.table.due(now).into_iter().for_each(|number| self.link_timeout(number, now));
        if let Some(look) = self.looks.take_due(now) {
            self.close_untrusted(look.at_certificates, now);
            self.look_for_silence(now);
            self.choose_paths(now);
            self.widen_all(now);
        }
        self.look_at_paths(now);
    }

    fn link_timeout(&mut self, number: u64, now: Duration) {
        let Some(link) = self.table.get_mut(number) else { return };
        if let Some((_, reason)) = link.postponed.take_if(|(due, _)| *due <= now) {
            self.handle_take_over(number, reason, now);
            return self.connections.touch(number);
        }
        match &mut link.phase {
            LinkPhase::Handshake(..) => {
                let resolver = link.resolver.take();
                self.table.remove(number);
                let address = self.connections.address(number);
                self.close_connection(number, CloseCode::Goodbye, "", now);
                if let Some(address) = address {
                    let text = "the dialler did not finish its handshake within 10 s";
                    let (kind, refusal) =
                        (self.unauthenticated(address.ip()), Refusal::network(text));
                    self.refused_incoming(kind, address, resolver.as_deref(), refusal);
                }
            }
            LinkPhase::Opening(opening) => {
                opening.handle_timeout(now, self.keyring.as_mut());
                self.go_on_opening(number, now);
            }
            LinkPhase::Electing(until) if *until <= now => {
                self.close_connection(number, CloseCode::Duplicate, "not elected within 10 s", now);
                self.end_link(number, "not elected", None, now);
            }
            LinkPhase::Leaving(_) => self.leaving_timeout(number, now),
            LinkPhase::Electing(_) => {}
            LinkPhase::Standby => self.standby_timeout(number, now),
            LinkPhase::Open => self.open_timeout(number, now),
        }
    }

    /// Returns whether [`settle`](Self::settle) has work.
    pub(super) fn has_work(&self) -> bool {
        self.connections.has_work() || self.unfinished.has_unread() || self.outbox.has_events()
    }

    /// Returns the next packets and the endpoint that sends them. Clears and fills `buffer`.
    pub(super) fn poll_transmit(
        &mut self,
        max_datagrams: usize,
        buffer: &mut Vec<u8>,
        now: Duration,
    ) -> Option<(usize, Transmit)> {
        self.connections.poll_transmit(max_datagrams, buffer, self.instant(now))
    }
}
