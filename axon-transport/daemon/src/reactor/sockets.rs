//! The UDP sockets: batches of datagrams in and out, several to a system call.

use std::{
    io::{self, IoSliceMut},
    net::{IpAddr, SocketAddr},
    task::{Context, Poll},
};

use axon_transport::config::Config;
use bytes::BytesMut;
use quinn_proto::{EcnCodepoint, Transmit};
use quinn_udp::{RecvMeta, UdpSockRef, UdpSocketState};
use tokio::{io::Interest, net::UdpSocket};

use crate::{error::EndpointError, reactor::bind::bind_daemon};

/// Number of messages that one system call receives. Each holds as many datagrams as the kernel coalesced.
const MESSAGES: usize = 8;
/// The longest message.
const MESSAGE: usize = 64 << 10;
/// Maximum number of receiving system calls of one pass, for each socket.
const CALLS: usize = 8;
/// Maximum number of bytes of one sent message: the largest IP packet less its headers.
const MAX_SENT: usize = 65_000;

/// A datagram that was received.
pub(super) struct ReceivedDatagram {
    /// The index of the socket.
    pub(super) socket: usize,
    pub(super) from: SocketAddr,
    /// The local address that it came to.
    pub(super) local: Option<IpAddr>,
    pub(super) ecn: Option<EcnCodepoint>,
    pub(super) bytes: BytesMut,
}

/// The sockets of a daemon: one for each address, all with the same port.
pub(super) struct Sockets {
    all: Vec<Socket>,
    port: u16,
    buffer: Vec<u8>,
    mtu: usize,
    /// Packets that found the buffer of their socket full.
    held: Option<(usize, Transmit, Vec<u8>)>,
}

struct Socket {
    address: SocketAddr,
    io: UdpSocket,
    state: UdpSocketState,
}

impl Sockets {
    /// Binds the first free port of the domain. Needs a tokio runtime.
    ///
    /// # Errors
    /// No port of the domain can be bound.
    pub(super) fn bind(config: &Config) -> Result<Self, EndpointError> {
        let (port, bound) = bind_daemon(config)?;
        let all = bound.into_iter().map(|(address, socket)| {
            let state = UdpSocketState::new(UdpSockRef::from(&socket))?;
            Ok(Socket { address, io: UdpSocket::from_std(socket)?, state })
        });
        Ok(Self {
            all: all.collect::<io::Result<_>>()?,
            port,
            buffer: vec![0; MESSAGES * MESSAGE],
            mtu: usize::from(config.link.mtu),
            held: None,
        })
    }

    /// Returns the port.
    pub(super) fn port(&self) -> u16 {
        self.port
    }

    /// Returns the bound addresses, in the order of the sockets.
    pub(super) fn addresses(&self) -> Vec<SocketAddr> {
        self.all.iter().map(|socket| socket.address).collect()
    }

    /// Receives datagrams that have arrived, up to a bound. Returns whether there was any, and whether there are no more.
    pub(super) fn receive(&mut self, mut each: impl FnMut(ReceivedDatagram)) -> (bool, bool) {
        let (mut any, mut drained) = (false, true);
        for (index, socket) in self.all.iter().enumerate() {
            for call in 1..=CALLS {
                let mut metas = [RecvMeta::default(); MESSAGES];
                let received = socket.receive(&mut self.buffer, &mut metas);
                if received == 0 {
                    break;
                }
                any = true;
                drained &= call < CALLS;
                for (meta, message) in metas[..received].iter().zip(self.buffer.chunks(MESSAGE)) {
                    let mut bytes = BytesMut::from(&message[..meta.len]);
                    while !bytes.is_empty() {
                        let one = bytes.split_to(meta.stride.clamp(1, bytes.len()));
                        each(ReceivedDatagram {
                            socket: index,
                            from: meta.addr,
                            local: meta.dst_ip,
                            ecn: meta.ecn.and_then(|ecn| EcnCodepoint::from_bits(ecn as u8)),
                            bytes: one,
                        });
                    }
                }
            }
        }
        (any, drained)
    }

    /// Datagrams that may be sent together.
    pub(super) fn max_datagrams(&self) -> usize {
        let segments = self.all.iter().map(|socket| socket.state.max_gso_segments()).min();
        segments.unwrap_or(1).min(MAX_SENT / self.mtu).max(1)
    }

    /// Sends packets. If the socket takes none now, they are kept, and nothing more may be sent until
    /// [`flush`](Self::flush) returns true.
    pub(super) fn send(&mut self, socket: usize, transmit: Transmit, bytes: &[u8]) {
        if !self.all[socket].send(&transmit, bytes) {
            let bytes = bytes[..transmit.size].to_vec();
            self.held = Some((socket, transmit, bytes));
        }
    }

    /// Sends packets that were kept. Returns whether none is left.
    pub(super) fn flush(&mut self) -> bool {
        if let Some((socket, transmit, bytes)) = &self.held
            && self.all[*socket].send(transmit, bytes)
        {
            self.held = None;
        }
        self.held.is_none()
    }

    /// Polls the sockets: ready once one can be read, or written to if packets were kept.
    pub(super) fn poll_ready(&self, cx: &mut Context<'_>) -> Poll<()> {
        let mut ready = Poll::Pending;
        for socket in &self.all {
            if socket.io.poll_recv_ready(cx).is_ready() {
                ready = Poll::Ready(());
            }
        }
        if let Some((socket, ..)) = &self.held
            && self.all[*socket].io.poll_send_ready(cx).is_ready()
        {
            ready = Poll::Ready(());
        }
        ready
    }
}

impl Socket {
    /// Receives messages. Returns how many.
    fn receive(&self, buffer: &mut [u8], metas: &mut [RecvMeta; MESSAGES]) -> usize {
        let mut chunks = buffer.chunks_mut(MESSAGE);
        let mut slices: [IoSliceMut<'_>; MESSAGES] =
            std::array::from_fn(|_| IoSliceMut::new(chunks.next().unwrap_or_default()));
        let received = self.io.try_io(Interest::READABLE, || {
            // An error is of one packet that was sent. It must not have the loop read again and again.
            self.state.recv(UdpSockRef::from(&self.io), &mut slices, metas).map_err(would_block)
        });
        received.unwrap_or(0)
    }

    /// Sends packets. Returns false if the socket takes none now.
    fn send(&self, transmit: &Transmit, bytes: &[u8]) -> bool {
        let transmit = quinn_udp::Transmit {
            destination: transmit.destination,
            ecn: transmit.ecn.and_then(|ecn| quinn_udp::EcnCodepoint::from_bits(ecn as u8)),
            contents: &bytes[..transmit.size],
            segment_size: transmit.segment_size,
            src_ip: transmit.src_ip,
        };
        let sent = self
            .io
            .try_io(Interest::WRITABLE, || self.state.send(UdpSockRef::from(&self.io), &transmit));
        // Any other error is a lost packet.
        !sent.is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
    }
}

fn would_block(error: io::Error) -> io::Error {
    if error.kind() != io::ErrorKind::WouldBlock {
        tracing::debug!(%error, "the UDP socket reports an error");
    }
    io::ErrorKind::WouldBlock.into()
}
