//! The QUIC connections of this host. Tracks which of them have work, when each is due, and which transmits next.

use std::{
    collections::{BTreeSet, HashMap, VecDeque},
    net::{IpAddr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::{Bytes, BytesMut};
use quinn_proto::{
    ClientConfig, ConnectError, ConnectionError, ConnectionHandle, EcnCodepoint, Incoming,
    ServerConfig, Transmit, VarInt,
};

use crate::{
    engine::{
        limits::InterfaceLimits,
        link::failure::close_text,
        quic::{
            connection::Connection,
            endpoints::{EndpointInput, EndpointPacket, QuicEndpoints},
        },
    },
    link::CloseCode,
};

/// All connections of all endpoints. Each has a number that is unique in this daemon.
pub(super) struct Connections {
    epoch: Instant,
    endpoints: QuicEndpoints,
    all: HashMap<u64, Connection>,
    handles: HashMap<(usize, ConnectionHandle), u64>,
    next_number: u64,
    /// Connections with work.
    dirty: VecDeque<u64>,
    /// Connections that may have something to transmit.
    transmitting: VecDeque<u64>,
    /// Connections that a limit keeps from transmitting, by the time at which a packet may leave. Among
    /// connections with the same limit, the one that began to wait first goes first: the second part is a
    /// rising number.
    limited: BTreeSet<(Duration, u64, u64)>,
    next_wait: u64,
    deadlines: BTreeSet<(Instant, u64)>,
    /// The limits on packets that leave by each network interface.
    interfaces: InterfaceLimits,
}

impl Connections {
    /// Creates an empty set. The engine's time was zero at `epoch`.
    pub(super) fn new(endpoints: QuicEndpoints, epoch: Instant) -> Self {
        Self {
            epoch,
            endpoints,
            all: HashMap::new(),
            handles: HashMap::new(),
            next_number: 1,
            dirty: VecDeque::new(),
            transmitting: VecDeque::new(),
            limited: BTreeSet::new(),
            next_wait: 0,
            deadlines: BTreeSet::new(),
            interfaces: InterfaceLimits::default(),
        }
    }

    /// Returns the endpoints.
    pub(super) fn endpoints(&mut self) -> &mut QuicEndpoints {
        &mut self.endpoints
    }

    /// Returns a connection.
    pub(super) fn get(&self, number: u64) -> Option<&Connection> {
        self.all.get(&number)
    }

    /// Returns a connection.
    pub(super) fn get_mut(&mut self, number: u64) -> Option<&mut Connection> {
        self.all.get_mut(&number)
    }

    /// Returns the address of the other end.
    pub(super) fn address(&self, number: u64) -> Option<SocketAddr> {
        Some(self.get(number)?.quic.remote_address())
    }

    /// Returns whether there is a connection to this address.
    pub(super) fn has(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        self.all.values().any(|c| c.quic.remote_address().ip().to_canonical() == address)
    }

    /// Returns the numbers of all connections.
    pub(super) fn numbers(&self) -> Vec<u64> {
        self.all.keys().copied().collect()
    }

    /// Returns the number of connections that began.
    #[cfg(test)]
    pub(super) fn begun(&self) -> u64 {
        self.next_number - 1
    }

    /// Returns whether all connections have ended.
    pub(super) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Handles a QUIC datagram. Returns the connection that the datagram opens, if it opens one.
    pub(super) fn handle_datagram(
        &mut self,
        now: Instant,
        endpoint: usize,
        from: SocketAddr,
        local: Option<IpAddr>,
        ecn: Option<EcnCodepoint>,
        bytes: BytesMut,
    ) -> Option<Incoming> {
        match self.endpoints.handle(now, endpoint, from, local, ecn, bytes) {
            EndpointInput::Connection(handle, event) => {
                let number = self.handles.get(&(endpoint, handle)).copied()?;
                if let Some(connection) = self.all.get_mut(&number) {
                    connection.ecn_marks += u64::from(ecn == Some(EcnCodepoint::Ce));
                    connection.quic.handle_event(event);
                    connection.set_local(local, &mut self.interfaces);
                    self.touch(number);
                }
                None
            }
            EndpointInput::Incoming(incoming) => Some(incoming),
            EndpointInput::Done => None,
        }
    }

    /// Opens a connection to an address. Returns its number.
    ///
    /// # Errors
    /// QUIC refuses; `None` if no endpoint reaches the address.
    pub(super) fn connect(
        &mut self,
        to: SocketAddr,
        config: ClientConfig,
        now: Instant,
    ) -> Result<u64, Option<ConnectError>> {
        let (endpoint, handle, quic) = self.endpoints.connect(now, to, config)?;
        Ok(self.insert(endpoint, handle, quic))
    }

    /// Accepts a connection. Returns its number.
    ///
    /// # Errors
    /// The connection failed at once. The peer has been informed.
    pub(super) fn accept(
        &mut self,
        endpoint: usize,
        incoming: Incoming,
        config: Arc<ServerConfig>,
        now: Instant,
    ) -> Result<u64, ConnectionError> {
        let (handle, quic) = self.endpoints.accept(now, endpoint, incoming, config)?;
        Ok(self.insert(endpoint, handle, quic))
    }

    fn insert(
        &mut self,
        endpoint: usize,
        handle: ConnectionHandle,
        quic: quinn_proto::Connection,
    ) -> u64 {
        let number = self.next_number;
        self.next_number += 1;
        self.handles.insert((endpoint, handle), number);
        let mut connection = Connection::new(endpoint, handle, quic);
        connection.set_local(None, &mut self.interfaces);
        self.all.insert(number, connection);
        self.touch(number);
        number
    }

    /// Schedules a connection for this pass.
    pub(super) fn touch(&mut self, number: u64) {
        if let Some(connection) = self.all.get_mut(&number)
            && !std::mem::replace(&mut connection.is_dirty, true)
        {
            self.dirty.push_back(number);
        }
    }

    /// Returns whether a connection has work.
    pub(super) fn has_work(&self) -> bool {
        !self.dirty.is_empty()
    }

    /// Returns the next connection with work, after processing its events for its endpoint.
    pub(super) fn poll_dirty(&mut self) -> Option<u64> {
        while let Some(number) = self.dirty.pop_front() {
            let Some(connection) = self.all.get_mut(&number) else { continue };
            connection.is_dirty = false;
            while let Some(event) = connection.quic.poll_endpoint_events() {
                let (endpoint, handle) = (connection.endpoint, connection.handle);
                if let Some(event) = self.endpoints.handle_event(endpoint, handle, event) {
                    connection.quic.handle_event(event);
                }
            }
            return Some(number);
        }
        None
    }

    /// Writes the waiting data of the control stream, and records the connection's deadline and that it may
    /// transmit. Removes a drained connection unless it `stays`.
    pub(super) fn note(&mut self, number: u64, stays: bool) {
        let Some(connection) = self.all.get_mut(&number) else { return };
        if connection.control.has_output() {
            connection.control.write(&mut connection.quic);
        }
        if connection.quic.is_drained() && !stays {
            return self.remove(number);
        }
        if !std::mem::replace(&mut connection.is_transmitting, true) {
            self.transmitting.push_back(number);
        }
        self.note_deadline(number);
    }

    fn remove(&mut self, number: u64) {
        let Some(connection) = self.all.remove(&number) else { return };
        let handle = (connection.endpoint, connection.handle);
        // QUIC may have reused the handle for another connection.
        if self.handles.get(&handle) == Some(&number) {
            self.handles.remove(&handle);
        }
        self.deadlines.remove(&(connection.deadline.unwrap_or(self.epoch), number));
    }

    fn note_deadline(&mut self, number: u64) {
        let Some(connection) = self.all.get_mut(&number) else { return };
        let due = connection.quic.poll_timeout();
        if due != connection.deadline {
            if let Some(before) = std::mem::replace(&mut connection.deadline, due) {
                self.deadlines.remove(&(before, number));
            }
            self.deadlines.extend(due.map(|due| (due, number)));
        }
    }

    /// Closes a connection. Its last packets leave in this pass.
    pub(super) fn close(&mut self, number: u64, code: CloseCode, reason: &str, now: Instant) {
        let Some(connection) = self.all.get_mut(&number) else { return };
        connection.control.close();
        let code = VarInt::from_u32(code.code());
        let reason = Bytes::copy_from_slice(close_text(reason));
        connection.quic.close(now, code, reason);
        self.touch(number);
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let quic = self.deadlines.first().map(|(due, _)| due.saturating_duration_since(self.epoch));
        let control = self.all.values().filter_map(|c| c.control.poll_timeout()).min();
        let limited = self.limited.first().map(|(due, ..)| *due);
        [quic, control, limited].into_iter().flatten().min()
    }

    /// Runs QUIC's timers, and schedules the connections whose control streams may be read again.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        let instant = self.epoch + now;
        while let Some((due, number)) = self.deadlines.first().copied()
            && due <= instant
        {
            self.deadlines.pop_first();
            if let Some(connection) = self.all.get_mut(&number) {
                connection.deadline = None;
                connection.quic.handle_timeout(instant);
                self.touch(number);
            }
        }
        while let Some((due, _, number)) = self.limited.first().copied()
            && due <= now
        {
            self.limited.pop_first();
            self.transmitting.push_back(number);
        }
        let paused =
            self.all.iter().filter(|(_, c)| c.control.poll_timeout().is_some_and(|t| t <= now));
        let paused: Vec<u64> = paused.map(|(number, _)| *number).collect();
        paused.into_iter().for_each(|number| self.touch(number));
    }

    /// Changes the limits of network interfaces, and applies them to all connections.
    pub(super) fn limit_interfaces(&mut self, change: impl FnOnce(&mut InterfaceLimits)) {
        change(&mut self.interfaces);
        for connection in self.all.values_mut() {
            connection.limit_interface(&self.interfaces);
        }
    }

    /// Returns whether the owner must list this host's network interfaces.
    pub(super) fn asks_for_interfaces(&mut self) -> bool {
        self.interfaces.asks()
    }

    /// Returns the next packets and the endpoint that sends them. Clears and fills `buffer`.
    pub(super) fn poll_transmit(
        &mut self,
        max_datagrams: usize,
        buffer: &mut Vec<u8>,
        now: Instant,
    ) -> Option<(usize, Transmit)> {
        buffer.clear();
        if let Some(EndpointPacket { endpoint, to, from, ecn, bytes }) =
            self.endpoints.poll_packet()
        {
            let size = bytes.len();
            *buffer = bytes;
            let transmit =
                Transmit { destination: to, ecn, size, segment_size: None, src_ip: from };
            return Some((endpoint, transmit));
        }
        let since = now.saturating_duration_since(self.epoch);
        while let Some(number) = self.transmitting.pop_front() {
            let Some(connection) = self.all.get_mut(&number) else { continue };
            if let Some(until) = connection.egress.closed_until(since) {
                self.limited.insert((until, self.next_wait, number));
                self.next_wait += 1;
                continue;
            }
            let most = max_datagrams.min(connection.egress.packets(since));
            let most = most.min(connection.burst.most());
            let transmit = connection.quic.poll_transmit(now, most, buffer).map(|transmit| {
                connection.count_sent(&transmit, since);
                (connection.endpoint, transmit)
            });
            // Connections take turns.
            self.note_deadline(number);
            if let Some(transmit) = transmit {
                self.transmitting.push_back(number);
                return Some(transmit);
            }
            if let Some(connection) = self.all.get_mut(&number) {
                connection.burst.handle_pass(since);
                connection.is_transmitting = false;
            }
        }
        None
    }
}
