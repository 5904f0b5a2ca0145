//! The QUIC endpoints of this host, one for each address that it is bound to.

use std::{
    collections::VecDeque,
    net::{IpAddr, SocketAddr},
    sync::Arc,
    time::Instant,
};

use bytes::BytesMut;
use quinn_proto::{
    ClientConfig, ConnectError, Connection, ConnectionEvent, ConnectionHandle, DatagramEvent,
    EcnCodepoint, Endpoint, EndpointConfig, EndpointEvent, Incoming, ServerConfig, Transmit,
};

/// A packet of an endpoint, not of a connection.
pub(in crate::engine) struct EndpointPacket {
    /// The endpoint that sends it.
    pub(in crate::engine) endpoint: usize,
    /// The receiver's address.
    pub(in crate::engine) to: SocketAddr,
    /// The local address, if it matters.
    pub(in crate::engine) from: Option<IpAddr>,
    pub(in crate::engine) ecn: Option<EcnCodepoint>,
    pub(in crate::engine) bytes: Vec<u8>,
}

/// The result of a datagram that an endpoint handled.
pub(in crate::engine) enum EndpointInput {
    /// The datagram belongs to this connection.
    Connection(ConnectionHandle, ConnectionEvent),
    /// The datagram begins a connection.
    Incoming(Incoming),
    /// The datagram is handled.
    Done,
}

/// Returns whether a socket bound to `local` reaches the address `to`.
pub(crate) fn reaches(local: SocketAddr, to: SocketAddr) -> bool {
    // A socket at 127.0.0.1 alone must not be asked to reach another host.
    let same_reach = local.ip().is_loopback() == to.ip().is_loopback();
    local.is_ipv4() == to.is_ipv4() && (same_reach || local.ip().is_unspecified())
}

/// The endpoints.
pub(in crate::engine) struct QuicEndpoints {
    all: Vec<(SocketAddr, Endpoint)>,
    packets: VecDeque<EndpointPacket>,
}

/// Most packets of endpoints that wait; further packets are dropped, like at a full socket.
const MAX_PACKETS: usize = 1024;

impl QuicEndpoints {
    /// Creates endpoints at these local addresses. `server` has the settings for answers to packets of unknown
    /// connections; each connection has its own settings.
    pub(in crate::engine) fn new(
        addresses: &[SocketAddr],
        config: &Arc<EndpointConfig>,
        server: &Arc<ServerConfig>,
    ) -> Self {
        let endpoint = |address: &SocketAddr| {
            let server = Some(Arc::clone(server));
            (*address, Endpoint::new(Arc::clone(config), server, true, None))
        };
        Self { all: addresses.iter().map(endpoint).collect(), packets: VecDeque::new() }
    }

    /// Returns the endpoint that reaches an address.
    pub(in crate::engine) fn towards(&self, to: SocketAddr) -> Option<usize> {
        self.all.iter().position(|(address, _)| reaches(*address, to))
    }

    /// Handles a datagram.
    pub(in crate::engine) fn handle(
        &mut self,
        now: Instant,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) -> EndpointInput {
        let mut buffer = Vec::new();
        let Some((_, quic)) = self.all.get_mut(endpoint) else { return EndpointInput::Done };
        match quic.handle(now, from, local, ecn, bytes, &mut buffer) {
            Some(DatagramEvent::ConnectionEvent(handle, event)) => {
                EndpointInput::Connection(handle, event)
            }
            Some(DatagramEvent::NewConnection(incoming)) => EndpointInput::Incoming(incoming),
            Some(DatagramEvent::Response(transmit)) => {
                self.respond(endpoint, &transmit, buffer);
                EndpointInput::Done
            }
            None => EndpointInput::Done,
        }
    }

    /// Starts a connection to an address.
    ///
    /// # Errors
    /// QUIC refuses the connection; `None` if no endpoint reaches the address.
    pub(in crate::engine) fn connect(
        &mut self,
        now: Instant,
        to: SocketAddr,
        config: ClientConfig,
    ) -> Result<(usize, ConnectionHandle, Connection), Option<ConnectError>> {
        let endpoint = self.towards(to).ok_or(None)?;
        let (handle, quic) = self.all[endpoint].1.connect(now, config, to, "axon").map_err(Some)?;
        Ok((endpoint, handle, quic))
    }

    /// Accepts a connection.
    ///
    /// # Errors
    /// Returns the reason if the connection failed at once. The peer has been informed.
    pub(in crate::engine) fn accept(
        &mut self,
        now: Instant,
        endpoint: usize,
        incoming: Incoming,
        config: Arc<ServerConfig>,
    ) -> Result<(ConnectionHandle, Connection), quinn_proto::ConnectionError> {
        let mut buffer = Vec::new();
        match self.all[endpoint].1.accept(incoming, now, &mut buffer, Some(config)) {
            Ok(accepted) => Ok(accepted),
            Err(error) => {
                if let Some(transmit) = &error.response {
                    self.respond(endpoint, transmit, buffer);
                }
                Err(error.cause)
            }
        }
    }

    /// Refuses a connection.
    pub(in crate::engine) fn refuse(&mut self, endpoint: usize, incoming: Incoming) {
        let mut buffer = Vec::new();
        let transmit = self.all[endpoint].1.refuse(incoming, &mut buffer);
        self.respond(endpoint, &transmit, buffer);
    }

    /// Asks the peer to prove that it receives at its address. Refuses the connection if that is not possible.
    pub(in crate::engine) fn retry(&mut self, endpoint: usize, incoming: Incoming) {
        if !incoming.may_retry() {
            return self.refuse(endpoint, incoming);
        }
        let mut buffer = Vec::new();
        if let Ok(transmit) = self.all[endpoint].1.retry(incoming, &mut buffer) {
            self.respond(endpoint, &transmit, buffer);
        }
    }

    /// Handles an event of a connection.
    pub(in crate::engine) fn handle_event(
        &mut self,
        endpoint: usize,
        handle: ConnectionHandle,
        event: EndpointEvent,
    ) -> Option<ConnectionEvent> {
        self.all[endpoint].1.handle_event(handle, event)
    }

    /// Sends a datagram that is not QUIC's from the port of QUIC. The datagram is dropped if no endpoint reaches the
    /// address.
    pub(in crate::engine) fn send(&mut self, to: SocketAddr, bytes: Vec<u8>) {
        if let Some(endpoint) = self.towards(to) {
            self.push(EndpointPacket { endpoint, to, from: None, ecn: None, bytes });
        }
    }

    fn respond(&mut self, endpoint: usize, transmit: &Transmit, mut bytes: Vec<u8>) {
        bytes.truncate(transmit.size);
        let Transmit { destination: to, ecn, src_ip: from, .. } = *transmit;
        self.push(EndpointPacket { endpoint, to, from, ecn, bytes });
    }

    fn push(&mut self, packet: EndpointPacket) {
        if self.packets.len() < MAX_PACKETS {
            self.packets.push_back(packet);
        }
    }

    /// Returns the next packet that does not belong to a connection.
    pub(in crate::engine) fn poll_packet(&mut self) -> Option<EndpointPacket> {
        self.packets.pop_front()
    }
}
