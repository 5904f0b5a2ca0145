//! A QUIC client and server without sockets: datagrams go from memory to memory, and time passes
//! only when it is told to.
//!
//! Tests and benchmarks include this file, and so does the fuzzer.
#![allow(dead_code, reason = "each of them uses its own part")]

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use quinn_proto::{
    ClientConfig, Connection, ConnectionError, ConnectionHandle, DatagramEvent, Endpoint,
    EndpointConfig, EndpointEvent, Event, ServerConfig, Side,
};

/// One end: an endpoint with at most one connection.
pub(crate) struct End {
    endpoint: Endpoint,
    pub(crate) address: SocketAddr,
    pub(crate) conn: Option<(ConnectionHandle, Connection)>,
    /// Datagrams to the other end.
    outbox: VecDeque<Vec<u8>>,
    /// Whether a server answers unknown addresses with a Retry.
    pub(crate) retries: bool,
    /// Whether the handshake was completed, as the connection itself reports.
    pub(crate) connected: bool,
    /// Why there is no connection any more.
    pub(crate) lost: Option<ConnectionError>,
}

/// Both ends.
pub(crate) struct Pair {
    /// Dials.
    pub(crate) client: End,
    /// Accepts.
    pub(crate) server: End,
    pub(crate) now: Instant,
}

impl Pair {
    /// Creates two endpoints without a connection.
    pub(crate) fn new(server: ServerConfig) -> Self {
        let end = |port, server| End {
            // probes for a larger MTU would add to what a handshake sends
            endpoint: Endpoint::new(Arc::new(EndpointConfig::default()), server, false, None),
            address: SocketAddr::from((Ipv4Addr::LOCALHOST, port)),
            conn: None,
            outbox: VecDeque::new(),
            retries: false,
            connected: false,
            lost: None,
        };
        let server = end(2, Some(Arc::new(server)));
        Self { client: end(1, None), server, now: Instant::now() }
    }

    /// Begins a handshake; [`Pair::run()`] does it.
    pub(crate) fn dial(&mut self, config: ClientConfig) {
        let (client, server) = (&mut self.client, self.server.address);
        client.conn = Some(client.endpoint.connect(self.now, config, server, "axon").unwrap());
    }

    /// Carries datagrams until neither end has any left. `tap` sees each, and may change it: an
    /// empty one is lost.
    pub(crate) fn run(&mut self, mut tap: impl FnMut(Side, &mut Vec<u8>)) {
        while self.step(&mut tap) {}
    }

    /// Carries what each end has to send now; whether there was anything.
    pub(crate) fn step(&mut self, mut tap: impl FnMut(Side, &mut Vec<u8>)) -> bool {
        let now = self.now;
        let sent = self.client.send(now) | self.server.send(now);
        let mut carry = |side, from: &mut End, to: &mut End| {
            for mut datagram in from.outbox.drain(..) {
                tap(side, &mut datagram);
                to.receive(now, from.address, &datagram);
            }
        };
        carry(Side::Client, &mut self.client, &mut self.server);
        carry(Side::Server, &mut self.server, &mut self.client);
        sent
    }

    /// Lets time pass for both ends.
    pub(crate) fn pass(&mut self, time: Duration) {
        self.now += time;
        for end in [&mut self.client, &mut self.server] {
            end.conn().handle_timeout(self.now);
        }
    }

    /// Forgets the connection on both ends, so that there can be another.
    pub(crate) fn hang_up(&mut self) {
        for end in [&mut self.client, &mut self.server] {
            if let Some((handle, _)) = end.conn.take() {
                end.endpoint.handle_event(handle, EndpointEvent::drained());
            }
            (end.connected, end.lost) = (false, None);
        }
    }

    /// Returns whether both ends completed the handshake and still have their connection.
    pub(crate) fn is_up(&self) -> bool {
        [&self.client, &self.server].into_iter().all(|end| end.connected && end.lost.is_none())
    }
}

impl End {
    /// Returns the connection, which must exist.
    pub(crate) fn conn(&mut self) -> &mut Connection {
        &mut self.conn.as_mut().expect("there is a connection").1
    }

    /// Takes a datagram as if it had come from `from`.
    pub(crate) fn receive(&mut self, now: Instant, from: SocketAddr, datagram: &[u8]) {
        let mut answer = Vec::new();
        let data = BytesMut::from(datagram);
        match self.endpoint.handle(now, from, None, None, data, &mut answer) {
            Some(DatagramEvent::ConnectionEvent(handle, event)) => {
                if let Some((_, conn)) = self.conn.as_mut().filter(|(ours, _)| *ours == handle) {
                    conn.handle_event(event);
                }
            }
            Some(DatagramEvent::NewConnection(incoming)) if self.conn.is_some() => {
                self.endpoint.ignore(incoming);
            }
            Some(DatagramEvent::NewConnection(incoming))
                if self.retries && incoming.may_retry() =>
            {
                let retry = self.endpoint.retry(incoming, &mut answer).unwrap();
                answer.truncate(retry.size);
                self.outbox.push_back(answer);
            }
            Some(DatagramEvent::NewConnection(incoming)) => {
                match self.endpoint.accept(incoming, now, &mut answer, None) {
                    Ok(accepted) => self.conn = Some(accepted),
                    Err(refused) => {
                        self.lost = Some(refused.cause);
                        self.outbox.extend(refused.response.map(|_| answer));
                    }
                }
            }
            Some(DatagramEvent::Response(_)) => self.outbox.push_back(answer),
            None => {}
        }
    }

    /// Puts the packets of the connection into the outbox. Returns whether the outbox has any.
    fn send(&mut self, now: Instant) -> bool {
        let Some((handle, conn)) = &mut self.conn else { return !self.outbox.is_empty() };
        loop {
            while let Some(event) = conn.poll_endpoint_events() {
                if let Some(event) = self.endpoint.handle_event(*handle, event) {
                    conn.handle_event(event);
                }
            }
            let mut datagram = Vec::new();
            match conn.poll_transmit(now, 1, &mut datagram) {
                Some(_) => self.outbox.push_back(datagram),
                None => break,
            }
        }
        while let Some(event) = conn.poll() {
            match event {
                Event::Connected => self.connected = true,
                Event::ConnectionLost { reason } => self.lost = Some(reason),
                _ => {}
            }
        }
        !self.outbox.is_empty()
    }
}
