//! The UDP sockets: batches of datagrams in and out, several to a system call.

use std::{
    io::{self, IoSliceMut},
    net::{IpAddr, SocketAddr, UdpSocket},
    os::fd::{AsFd, OwnedFd},
    task::{Context, Poll},
};

use axon_shm::internal::descriptors::PassedFd;
use axon_transport::config::Config;
use bytes::BytesMut;
use quinn_proto::{EcnCodepoint, Transmit};
use quinn_udp::{RecvMeta, UdpSockRef, UdpSocketState};
use tokio::io::{Interest, unix::AsyncFd};

use crate::{async_fd::watch_for, error::EndpointError, reactor::bind::bind_daemon};

/// Messages that one system call receives. Each holds as many datagrams as the kernel coalesced.
const MESSAGES: usize = 8;
/// The longest message.
const MESSAGE: usize = 64 << 10;
/// System calls that one pass receives with, for each socket.
const CALLS: usize = 8;
/// Bytes of one message that is sent: what an IP packet holds, less its headers.
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
    held: Option<HeldPackets>,
}

struct Socket {
    address: SocketAddr,
    /// Watched for datagrams alone. The kernel reports room in the send buffer after each packet, which would wake the
    /// thread for nothing.
    io: AsyncFd<PassedFd>,
    state: UdpSocketState,
}

/// Packets that found the buffer of their socket full.
struct HeldPackets {
    socket: usize,
    transmit: Transmit,
    bytes: Vec<u8>,
    /// The socket, watched for room in its buffer.
    room: AsyncFd<PassedFd>,
}

impl Sockets {
    /// Binds the first free port of the domain. Needs a tokio runtime.
    ///
    /// # Errors
    /// No port of the domain can be bound.
    pub(super) fn bind(config: &Config) -> Result<Self, EndpointError> {
        let (port, bound) = bind_daemon(config)?;
        let all = bound.into_iter().map(|(address, socket)| Socket::new(address, socket));
        Ok(Self {
            all: all.collect::<io::Result<_>>()?,
            port,
            buffer: vec![0; MESSAGES * MESSAGE],
            mtu: usize::from(config.link.mtu),
            held: None,
        })
    }

    /// The port.
    pub(super) fn port(&self) -> u16 {
        self.port
    }

    /// The bound addresses, in the order of the sockets.
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
        if is_full(&self.all[socket].send(&transmit, bytes)) {
            self.hold(socket, transmit, bytes);
        }
    }

    /// Keeps packets until their socket has room. If nothing tells of the room, they are lost, and QUIC repeats them.
    fn hold(&mut self, socket: usize, transmit: Transmit, bytes: &[u8]) {
        match self.all[socket].watch_for_room() {
            Ok(room) => {
                let bytes = bytes[..transmit.size].to_vec();
                self.held = Some(HeldPackets { socket, transmit, bytes, room });
            }
            Err(error) => {
                tracing::debug!(%error, "cannot watch a full UDP socket: its packets are lost")
            }
        }
    }

    /// Sends packets that were kept. Returns whether none is left.
    pub(super) fn flush(&mut self) -> bool {
        if let Some(HeldPackets { socket, transmit, bytes, room }) = &self.held {
            let send = |_: &PassedFd| self.all[*socket].send(transmit, bytes);
            if !is_full(&room.try_io(Interest::WRITABLE, send)) {
                self.held = None;
            }
        }
        self.held.is_none()
    }

    /// Ready once a socket can be read, or written to if packets were kept.
    pub(super) fn poll_ready(&self, cx: &mut Context<'_>) -> Poll<()> {
        let mut ready = Poll::Pending;
        for socket in &self.all {
            if socket.io.poll_read_ready(cx).is_ready() {
                ready = Poll::Ready(());
            }
        }
        if let Some(held) = &self.held
            && held.room.poll_write_ready(cx).is_ready()
        {
            ready = Poll::Ready(());
        }
        ready
    }
}

impl Socket {
    fn new(address: SocketAddr, socket: UdpSocket) -> io::Result<Self> {
        let state = UdpSocketState::new(UdpSockRef::from(&socket))?;
        Ok(Self { address, io: watch_for(OwnedFd::from(socket), Interest::READABLE)?, state })
    }

    /// A further descriptor of the socket, watched for room in its buffer.
    fn watch_for_room(&self) -> io::Result<AsyncFd<PassedFd>> {
        watch_for(self.io.get_ref().as_fd().try_clone_to_owned()?, Interest::WRITABLE)
    }

    /// Receives messages. Returns how many.
    fn receive(&self, buffer: &mut [u8], metas: &mut [RecvMeta; MESSAGES]) -> usize {
        let mut chunks = buffer.chunks_mut(MESSAGE);
        let mut slices: [IoSliceMut<'_>; MESSAGES] =
            std::array::from_fn(|_| IoSliceMut::new(chunks.next().unwrap_or_default()));
        let received = self.io.try_io(Interest::READABLE, |socket| {
            // An error is of one packet that was sent. It must not have the loop read again and again.
            self.state.recv(UdpSockRef::from(socket), &mut slices, metas).map_err(would_block)
        });
        received.unwrap_or(0)
    }

    /// Sends packets.
    fn send(&self, transmit: &Transmit, bytes: &[u8]) -> io::Result<()> {
        let transmit = quinn_udp::Transmit {
            destination: transmit.destination,
            ecn: transmit.ecn.and_then(|ecn| quinn_udp::EcnCodepoint::from_bits(ecn as u8)),
            contents: &bytes[..transmit.size],
            segment_size: transmit.segment_size,
            src_ip: transmit.src_ip,
        };
        self.state.send(UdpSockRef::from(self.io.get_ref()), &transmit)
    }
}

/// Whether a socket takes no packets now. Any other error is a lost packet.
fn is_full(sent: &io::Result<()>) -> bool {
    sent.as_ref().is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
}

fn would_block(error: io::Error) -> io::Error {
    if error.kind() != io::ErrorKind::WouldBlock {
        tracing::debug!(%error, "the UDP socket reports an error");
    }
    io::ErrorKind::WouldBlock.into()
}

#[cfg(test)]
mod tests {
    use std::{fs, future::poll_fn, os::fd::AsRawFd, time::Duration};

    use tokio::time::timeout;

    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(10);

    fn bind() -> Sockets {
        let socket = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
        socket.set_nonblocking(true).unwrap();
        let address = socket.local_addr().unwrap();
        Sockets {
            all: vec![Socket::new(address, socket).unwrap()],
            port: address.port(),
            buffer: vec![0; MESSAGES * MESSAGE],
            mtu: 1452,
            held: None,
        }
    }

    /// Returns the events for which epoll watches a descriptor of this process.
    fn watched_events(fd: &impl AsRawFd) -> Vec<u32> {
        let fd = fd.as_raw_fd().to_string();
        let of_line = |line: &str| {
            let mut words = line.strip_prefix("tfd:")?.split_whitespace();
            let is_this = words.next()? == fd;
            let events = words.nth(1).filter(|_| is_this)?;
            Some(u32::from_str_radix(events, 16).unwrap())
        };
        let mut all = Vec::new();
        for info in fs::read_dir("/proc/self/fdinfo").unwrap() {
            // A descriptor may be closed meanwhile.
            let text = info.and_then(|info| fs::read_to_string(info.path())).unwrap_or_default();
            all.extend(text.lines().filter_map(of_line));
        }
        all
    }

    #[tokio::test]
    async fn room_in_the_send_buffer_wakes_nobody_unless_packets_wait_for_it() {
        const IN: u32 = 1;
        const OUT: u32 = 4;
        let mut sockets = bind();
        let peer = UdpSocket::bind(("127.0.0.1", 0)).unwrap();
        peer.set_read_timeout(Some(TIMEOUT)).unwrap();
        let transmit = |size| Transmit {
            destination: peer.local_addr().unwrap(),
            ecn: None,
            size,
            segment_size: None,
            src_ip: None,
        };
        let events = watched_events(sockets.all[0].io.get_ref());
        assert!(events.iter().all(|events| events & (IN | OUT) == IN), "{events:x?}");
        assert_eq!(events.len(), 1);

        sockets.send(0, transmit(3), b"one");
        assert!(sockets.held.is_none());
        sockets.hold(0, transmit(3), b"two and more");
        let room = sockets.held.as_ref().map(|held| &held.room).unwrap();
        let events = watched_events(room.get_ref());
        assert!(events.iter().all(|events| events & (IN | OUT) == OUT), "{events:x?}");
        assert_eq!(events.len(), 1);
        timeout(TIMEOUT, poll_fn(|cx| sockets.poll_ready(cx))).await.unwrap();
        assert!(sockets.flush());
        for expected in [b"one", b"two"] {
            let mut bytes = [0; 8];
            let length = peer.recv(&mut bytes).unwrap();
            assert_eq!(&bytes[..length], expected);
        }
    }
}
