//! A peer without an engine. It completes the TLS handshake as any peer does, and then sends what a test demands:
//! frames out of order, streams of routes that no side asked for, bytes that are not a frame.

use std::{
    collections::VecDeque,
    net::{IpAddr, Ipv4Addr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, Security};
use bytes::{Bytes, BytesMut};
use quinn_proto::{
    Connection, ConnectionError, ConnectionHandle, DatagramEvent, Dir, EcnCodepoint, Endpoint,
    EndpointConfig, Event, Side, StreamEvent, StreamId, Transmit, TransportConfig, VarInt,
};
use rand::RngExt;

use super::{
    host::PORT,
    rng::{SimRng, Stream, stream},
};
use crate::{
    engine::{credentials::Credentials, peer::MAX_ROUTES, quic::transport::Transports},
    identity::Identity,
    link::{CloseCode, LinkHello, LinkMessage, MAX_FRAME, MAX_INFLATED, read_length},
};

/// A peer that a test controls, in classic mode.
pub(super) struct Raw {
    pub(super) address: Ipv4Addr,
    /// The address of the second interface, if it has one.
    pub(super) second: Option<Ipv4Addr>,
    pub(super) daemon: DaemonId,
    /// The peer's connections, in the order in which they began.
    pub(super) links: Vec<RawLink>,
    config: Arc<Config>,
    credentials: Credentials,
    transport: Arc<TransportConfig>,
    endpoint: Endpoint,
    responses: VecDeque<(Transmit, Vec<u8>)>,
    epoch: Instant,
}

/// A connection of a [`Raw`] peer.
pub(super) struct RawLink {
    pub(super) quic: Connection,
    handle: Option<ConnectionHandle>,
    /// The TLS handshake is complete.
    pub(super) connected: bool,
    /// The control stream.
    pub(super) control: Option<StreamId>,
    /// Bytes of the control stream that are not yet a whole frame.
    partial: Vec<u8>,
    /// The messages that came on the control stream.
    pub(super) messages: Vec<LinkMessage>,
    /// It reads nothing more of the control stream.
    pub(super) is_deaf: bool,
    /// The data streams that the other side opened. Only a test reads them.
    pub(super) opened: Vec<StreamId>,
    /// The close of the other side, or the reason why the connection was lost.
    pub(super) closed: Option<(Option<CloseCode>, String)>,
    /// Bytes that QUIC did not take.
    waiting: VecDeque<(StreamId, Bytes)>,
}

impl Raw {
    /// Creates a peer at the address of host number `host`.
    pub(super) fn new(host: usize, config: Config, daemon: DaemonId, epoch: Instant) -> Self {
        let [high, low] = (host as u16 + 1).to_be_bytes();
        let mut random: SimRng = stream(0, Stream::Host { host: host as u32, start: u32::MAX });
        let config = Arc::new(config);
        let Security::Classic(classic) = &config.security else { panic!("classic alone") };
        let identity = Arc::new(Identity::load(classic, "raw").unwrap());
        let credentials = Credentials::new(Arc::clone(&config), Some(identity));
        let address = Ipv4Addr::new(10, 0, high, low);
        let server = Arc::new(credentials.server(None, address.into()).unwrap());
        let mut endpoint = EndpointConfig::default();
        endpoint.rng_seed(Some(random.random())).grease_quic_bit(false);
        endpoint.supported_versions(vec![1]);
        Self {
            address,
            second: None,
            daemon,
            links: Vec::new(),
            transport: Transports::new(&config).towards(address.into()),
            config,
            credentials,
            endpoint: Endpoint::new(Arc::new(endpoint), Some(server), true, None),
            responses: VecDeque::new(),
            epoch,
        }
    }

    /// Uses these settings of QUIC for connections that it dials.
    pub(super) fn set_transport(&mut self, transport: TransportConfig) {
        self.transport = Arc::new(transport);
    }

    /// Begins a connection. Returns its number.
    pub(super) fn dial(&mut self, to: Ipv4Addr, now: Duration) -> usize {
        let mut client = self.credentials.client(None, to.into()).unwrap();
        client.transport_config(Arc::clone(&self.transport));
        let to = SocketAddr::from((to, PORT));
        let (handle, quic) = self.endpoint.connect(self.epoch + now, client, to, "axon").unwrap();
        self.add(handle, quic);
        self.links.len() - 1
    }

    fn add(&mut self, handle: ConnectionHandle, quic: Connection) {
        self.links.push(RawLink {
            quic,
            handle: Some(handle),
            connected: false,
            control: None,
            partial: Vec::new(),
            messages: Vec::new(),
            is_deaf: false,
            opened: Vec::new(),
            closed: None,
            waiting: VecDeque::new(),
        });
    }

    /// Returns the HELLO of an honest peer.
    pub(super) fn hello(&self) -> LinkHello {
        let routes = Some(MAX_ROUTES as u32);
        LinkHello { routes, host: "raw".into(), ..LinkHello::new(&self.config, self.daemon) }
    }

    /// Sends HELLO on a link.
    pub(super) fn say_hello(&mut self, link: usize) {
        let hello = self.hello();
        self.links[link].say(&LinkMessage::Hello(hello));
    }

    /// Closes a link.
    pub(super) fn close(&mut self, link: usize, now: Duration) {
        let quic = &mut self.links[link].quic;
        quic.close(self.epoch + now, VarInt::from_u32(0), Bytes::new());
    }

    /// Handles a datagram.
    pub(super) fn handle_datagram(
        &mut self,
        now: Duration,
        (from, to): (SocketAddr, IpAddr),
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) {
        let (now, mut buffer) = (self.epoch + now, Vec::new());
        match self.endpoint.handle(now, from, Some(to), ecn, bytes, &mut buffer) {
            Some(DatagramEvent::ConnectionEvent(handle, event)) => {
                if let Some(link) = self.links.iter_mut().find(|l| l.handle == Some(handle)) {
                    link.quic.handle_event(event);
                }
            }
            Some(DatagramEvent::NewConnection(incoming)) => {
                if let Ok((handle, quic)) = self.endpoint.accept(incoming, now, &mut buffer, None) {
                    self.add(handle, quic);
                }
            }
            Some(DatagramEvent::Response(transmit)) => {
                self.responses.push_back((transmit, buffer));
            }
            None => {}
        }
    }

    /// Returns when [`pass`](Self::pass) is due.
    pub(super) fn poll_timeout(&mut self) -> Option<Duration> {
        let due = self.links.iter_mut().filter_map(|link| link.quic.poll_timeout()).min()?;
        Some(due.saturating_duration_since(self.epoch))
    }

    /// Handles events and due timers.
    pub(super) fn pass(&mut self, now: Duration) {
        for link in &mut self.links {
            let Some(handle) = link.handle else { continue };
            if link.quic.poll_timeout().is_some_and(|due| due <= self.epoch + now) {
                link.quic.handle_timeout(self.epoch + now);
            }
            while let Some(event) = link.quic.poll_endpoint_events() {
                if let Some(event) = self.endpoint.handle_event(handle, event) {
                    link.quic.handle_event(event);
                }
            }
            if link.quic.is_drained() {
                link.handle = None;
            }
            link.pass();
        }
    }

    /// Returns the next packets.
    pub(super) fn poll_transmit(&mut self, now: Duration) -> Option<(Transmit, Vec<u8>)> {
        if let Some(response) = self.responses.pop_front() {
            return Some(response);
        }
        let mut buffer = Vec::new();
        let now = self.epoch + now;
        let links = self.links.iter_mut();
        let transmit = links.filter_map(|l| l.quic.poll_transmit(now, 10, &mut buffer)).next()?;
        Some((transmit, buffer))
    }
}

impl RawLink {
    fn pass(&mut self) {
        while let Some(event) = self.quic.poll() {
            match event {
                Event::Connected => {
                    self.connected = true;
                    // The client opens the control stream.
                    if self.quic.side() == Side::Client {
                        self.control = self.quic.streams().open(Dir::Bi);
                    }
                }
                Event::ConnectionLost { reason } => {
                    let code = match &reason {
                        ConnectionError::ApplicationClosed(closed) => {
                            CloseCode::from_code(closed.error_code.into_inner())
                        }
                        _ => None,
                    };
                    self.closed = Some((code, reason.to_string()));
                }
                Event::Stream(StreamEvent::Opened { dir: Dir::Bi }) => {
                    self.control = self.quic.streams().accept(Dir::Bi).or(self.control);
                }
                Event::Stream(StreamEvent::Opened { dir: Dir::Uni }) => {
                    while let Some(stream) = self.quic.streams().accept(Dir::Uni) {
                        self.opened.push(stream);
                    }
                }
                _ => {}
            }
        }
        self.read_control();
        self.write();
    }

    fn read_control(&mut self) {
        let Some(control) = self.control.filter(|_| self.closed.is_none() && !self.is_deaf) else {
            return;
        };
        let bytes = self.read(control);
        self.partial.extend_from_slice(&bytes);
        while let Some(prefix) = self.partial.first_chunk::<4>() {
            let length = read_length(*prefix, MAX_FRAME).expect("a frame of the engine");
            if self.partial.len() < 4 + length {
                return;
            }
            let frame: Vec<u8> = self.partial.drain(..4 + length).collect();
            let message = LinkMessage::from_frame(&frame[4..], MAX_INFLATED);
            self.messages.extend(message.expect("a message of the engine"));
        }
    }

    /// Reads all that has come of a stream.
    pub(super) fn read(&mut self, stream: StreamId) -> Vec<u8> {
        let mut all = Vec::new();
        let mut stream = self.quic.recv_stream(stream);
        let Ok(mut chunks) = stream.read(true) else { return all };
        while let Ok(Some(chunk)) = chunks.next(usize::MAX) {
            all.extend_from_slice(&chunk.bytes);
        }
        let _ = chunks.finalize();
        all
    }

    /// Sends a message on the control stream.
    pub(super) fn say(&mut self, message: &LinkMessage) {
        self.say_bytes(message.to_frame().unwrap().into());
    }

    /// Writes any bytes to the control stream.
    pub(super) fn say_bytes(&mut self, bytes: Bytes) {
        if let Some(control) = self.control {
            self.write_to(control, bytes);
        }
    }

    /// Opens a data stream that begins with these bytes.
    pub(super) fn open(&mut self, bytes: impl Into<Bytes>) -> Option<StreamId> {
        let stream = self.quic.streams().open(Dir::Uni)?;
        self.write_to(stream, bytes.into());
        Some(stream)
    }

    /// Writes bytes to a stream, as soon as QUIC takes them.
    pub(super) fn write_to(&mut self, stream: StreamId, bytes: Bytes) {
        self.waiting.push_back((stream, bytes));
        self.write();
    }

    fn write(&mut self) {
        let mut blocked = Vec::new();
        self.waiting.retain_mut(|(stream, bytes)| {
            if blocked.contains(stream) {
                return true;
            }
            match self.quic.send_stream(*stream).write(bytes) {
                Ok(taken) => drop(bytes.split_to(taken)),
                Err(quinn_proto::WriteError::Blocked) => {}
                // The other side accepts no more, so the rest is dropped.
                Err(_) => return false,
            }
            if !bytes.is_empty() {
                blocked.push(*stream);
            }
            !bytes.is_empty()
        });
    }

    /// Ends a data stream.
    pub(super) fn finish(&mut self, stream: StreamId) {
        let _ = self.quic.send_stream(stream).finish();
    }

    /// Resets a data stream.
    pub(super) fn reset(&mut self, stream: StreamId, code: u32) {
        let _ = self.quic.send_stream(stream).reset(VarInt::from_u32(code));
    }

    /// Returns whether the other side's HELLO came.
    pub(super) fn is_greeted(&self) -> bool {
        self.messages.iter().any(|message| matches!(message, LinkMessage::Hello(_)))
    }

    /// Returns whether the other side elected the link.
    pub(super) fn is_elected(&self) -> bool {
        self.messages.iter().any(|message| matches!(message, LinkMessage::Elected(_)))
    }
}
