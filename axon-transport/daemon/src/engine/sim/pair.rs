//! Two ends of one QUIC connection, for tests of code that writes to streams. No packet is lost on the way.

use std::{
    net::{Ipv4Addr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_transport::config::{Config, Security};
use bytes::BytesMut;
use quinn_proto::{ConnectionHandle, DatagramEvent, Endpoint, EndpointConfig, StreamId, VarInt};

use crate::{
    engine::{
        credentials::Credentials,
        quic::connection::{Carrier, Connection},
        sample::protection::Seal,
    },
    identity::Identity,
};

/// One round of [`Pair::exchange`], longer than QUIC delays an acknowledgement.
const ROUND: Duration = Duration::from_millis(30);

/// A client whose handshake with a server is complete.
pub(crate) struct Pair {
    epoch: Instant,
    now: Duration,
    ends: [End; 2],
}

struct End {
    address: SocketAddr,
    endpoint: Endpoint,
    connection: Option<Connection>,
}

impl End {
    fn add(&mut self, (handle, quic): (ConnectionHandle, quinn_proto::Connection)) {
        self.connection = Some(Connection::new(0, handle, quic));
    }
}

impl Pair {
    /// Creates two ends that have completed the handshake.
    pub(crate) fn new() -> Self {
        let config = Arc::new(Config::default());
        let Security::Classic(classic) = &config.security else { panic!("classic alone") };
        let identity = Arc::new(Identity::load(classic, "pair").unwrap());
        let credentials = Credentials::new(Arc::clone(&config), Some(identity));
        let end = |number: u8| {
            let address = Ipv4Addr::new(10, 0, 0, number);
            let server = Arc::new(credentials.server(None, address.into()).unwrap());
            let settings = Arc::new(EndpointConfig::default());
            let endpoint = Endpoint::new(settings, Some(server), true, None);
            End { address: (address, 1).into(), endpoint, connection: None }
        };
        let (epoch, mut ends) = (Instant::now(), [end(1), end(2)]);
        let to = ends[1].address;
        let client = credentials.client(None, to.ip()).unwrap();
        let dialled = ends[0].endpoint.connect(epoch, client, to, "axon").unwrap();
        ends[0].add(dialled);
        let mut pair = Self { epoch, now: Duration::ZERO, ends };
        pair.exchange();
        assert!(!pair.client().is_handshaking(), "the handshake is complete");
        pair
    }

    /// Returns the time.
    pub(crate) fn now(&self) -> Duration {
        self.now
    }

    /// Returns the client's end.
    pub(crate) fn client(&mut self) -> &mut quinn_proto::Connection {
        &mut self.ends[0].connection.as_mut().unwrap().quic
    }

    /// Returns the client's end as a carrier of samples that TLS alone protects.
    pub(crate) fn carrier(&mut self) -> Carrier<'_> {
        self.ends[0].connection.as_mut().unwrap().carrier(Seal::Link, self.now)
    }

    fn server(&mut self) -> &mut quinn_proto::Connection {
        &mut self.ends[1].connection.as_mut().unwrap().quic
    }

    /// Lets the packets of a second go to and fro.
    pub(crate) fn exchange(&mut self) {
        let until = self.now + Duration::from_secs(1);
        while self.now < until {
            while self.carry(0) | self.carry(1) {}
            self.now += ROUND;
            let now = self.epoch + self.now;
            for end in &mut self.ends {
                if let Some(connection) = &mut end.connection
                    && connection.quic.poll_timeout().is_some_and(|due| due <= now)
                {
                    connection.quic.handle_timeout(now);
                }
            }
        }
        while self.client().poll().is_some() {}
    }

    /// Carries the packets of one end to the other. Returns whether there were any.
    fn carry(&mut self, from: usize) -> bool {
        let (now, mut buffer) = (self.epoch + self.now, Vec::new());
        let End { address, endpoint, connection } = &mut self.ends[from];
        let Some(Connection { quic, handle, .. }) = connection else { return false };
        while let Some(event) = quic.poll_endpoint_events() {
            if let Some(event) = endpoint.handle_event(*handle, event) {
                quic.handle_event(event);
            }
        }
        let Some(transmit) = quic.poll_transmit(now, 1, &mut buffer) else { return false };
        let (from, to) = (*address, &mut self.ends[1 - from]);
        let (bytes, mut response) = (BytesMut::from(&buffer[..transmit.size]), Vec::new());
        let local = Some(to.address.ip());
        match to.endpoint.handle(now, from, local, None, bytes, &mut response) {
            Some(DatagramEvent::ConnectionEvent(_, event)) => {
                to.connection.as_mut().unwrap().quic.handle_event(event);
            }
            Some(DatagramEvent::NewConnection(incoming)) => {
                let accepted = to.endpoint.accept(incoming, now, &mut response, None);
                to.add(accepted.map_err(|error| error.cause).unwrap());
            }
            Some(DatagramEvent::Response(_)) => panic!("a response without a connection"),
            None => {}
        }
        true
    }

    /// Reads the bytes that the server has of a stream of the client. Also returns whether the stream is finished.
    /// `None`: it was reset.
    pub(crate) fn read(&mut self, stream: StreamId) -> Option<(Vec<u8>, bool)> {
        let mut stream = self.server().recv_stream(stream);
        let (mut all, mut chunks) = (Vec::new(), stream.read(true).ok()?);
        loop {
            match chunks.next(usize::MAX) {
                Ok(Some(chunk)) => all.extend_from_slice(&chunk.bytes),
                Ok(None) => return Some((all, true)),
                Err(quinn_proto::ReadError::Blocked) => break,
                Err(quinn_proto::ReadError::Reset(_)) => return None,
            }
        }
        let _ = chunks.finalize();
        Some((all, false))
    }

    /// Makes the server stop a stream of the client, and tells the client.
    pub(crate) fn stop(&mut self, stream: StreamId) {
        self.server().recv_stream(stream).stop(VarInt::from_u32(0)).unwrap();
        self.exchange();
    }
}
