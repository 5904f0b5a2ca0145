//! The raw limit between two hosts: one stream of bare quinn, with AXON's key exchange and cipher, and with a daemon's
//! socket buffers and send window. A length precedes each message. In a stream, messages are written in batches of 64
//! KiB. They are always read in such batches.

use std::{
    net::{Ipv4Addr, UdpSocket},
    sync::Arc,
    time::Duration,
};

use axon_tls::{
    Cipher,
    identity::{Auth, SigningKey},
    quic::{ALPN, hybrid_client, hybrid_server},
};
use quinn::{
    Connection, Endpoint, EndpointConfig, RecvStream, SendStream, ServerConfig, TokioRuntime,
    TransportConfig, VarInt,
};
use rustix::net::sockopt;
use serde::{Deserialize, Serialize};
use tokio::runtime::Runtime;

use crate::bench::harness::{Channel, End, Error, Load, Medium, Result, Side, agree, stamp};

/// The bytes of one write in a stream, and of one read.
const BATCH: usize = 64 << 10;
const HEADER: usize = 4;
/// The time between two checks whether a turn is over.
const CHECK_INTERVAL: Duration = Duration::from_millis(1);
/// The size of a socket buffer, the same as a daemon's.
const SOCKET_BUFFER: usize = 8 << 20;
/// The send window, the same as a daemon's.
const SEND_WINDOW: u64 = 16 << 20;
/// The receive window of a stream. It is wider than a daemon's (at most 4 MiB), which has many peers; this stream has
/// one.
const STREAM_WINDOW: u32 = 32 << 20;
/// The receive window of the connection, also wider than a daemon's (1 MiB and a share of 64 MiB).
const CONNECTION_WINDOW: u32 = 256 << 20;

/// A medium of quinn alone.
pub(super) struct BareQuic;

impl Medium for BareQuic {
    fn name(&self) -> &'static str {
        "bare quinn"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        Ok(Box::new(BareEnd::open(load, side, channel, Threads::One)?))
    }
}

/// The threads that run quinn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Threads {
    /// The thread that waits for a message runs quinn, so no other thread has to be woken.
    One,
    /// A separate thread runs quinn. It encrypts while the application makes messages.
    Two,
}

/// One end of the stream.
pub(super) struct BareEnd {
    out: SendStream,
    into: RecvStream,
    /// Bytes that are queued and were not yet handed to quinn.
    unsent: Vec<u8>,
    unread: Unread,
    bytes: Vec<u8>,
    /// The load has a pace. After a message this end receives nothing, so no call would run quinn.
    is_paced: bool,
    _connection: Connection,
    endpoint: Endpoint,
    runtime: Runtime,
}

impl BareEnd {
    /// Connects to the other side.
    pub(super) fn open(
        load: &Load,
        side: Side,
        channel: &Channel,
        threads: Threads,
    ) -> Result<Self> {
        let mut runtime = match threads {
            Threads::One => tokio::runtime::Builder::new_current_thread(),
            Threads::Two => tokio::runtime::Builder::new_multi_thread(),
        };
        let runtime = runtime.worker_threads(1).enable_all().build()?;
        let (endpoint, connection, out, into) = match side {
            Side::Near => {
                let key = Auth::None(SigningKey::generate()?);
                let mut config = hybrid_server(&key, Cipher::default(), ALPN)?;
                config.transport_config(transport());
                let _entered = runtime.enter();
                let endpoint = endpoint(Some(config))?;
                channel.tell(&endpoint.local_addr()?)?;
                runtime.block_on(async {
                    let incoming = endpoint.accept().await.ok_or("nobody came")?;
                    let connection = incoming.await?;
                    let (out, mut into) = connection.open_bi().await?;
                    let out = greet(out).await?;
                    into.read_exact(&mut [0]).await?;
                    Ok::<_, Error>((endpoint, connection, out, into))
                })?
            }
            Side::Far => {
                let address = channel.hear()?;
                let key = Auth::None(SigningKey::generate()?);
                let mut config = hybrid_client(&key, Cipher::default(), ALPN)?;
                config.transport_config(transport());
                let _entered = runtime.enter();
                let endpoint = endpoint(None)?;
                runtime.block_on(async {
                    let connection = endpoint.connect_with(config, address, "axon")?.await?;
                    let (out, mut into) = connection.accept_bi().await?;
                    let out = greet(out).await?;
                    into.read_exact(&mut [0]).await?;
                    Ok::<_, Error>((endpoint, connection, out, into))
                })?
            }
        };
        let mut end = Self {
            out,
            into,
            unsent: Vec::with_capacity(BATCH + HEADER),
            unread: Unread { buffer: vec![0; BATCH], taken: 0, filled: 0 },
            bytes: vec![0x5a; load.size],
            is_paced: load.pace.is_some(),
            _connection: connection,
            endpoint,
            runtime,
        };
        // The far side's first byte is sent when its thread next runs quinn.
        match side {
            Side::Near => channel.tell(&())?,
            Side::Far => {
                end.idle(channel)?;
                channel.hear::<()>()?;
            }
        }
        Ok(end)
    }

    /// Writes a message. It is sent once 64 KiB have accumulated.
    pub(super) fn queue(&mut self, number: u64) -> Result<()> {
        stamp(&mut self.bytes, number);
        let length = u32::try_from(self.bytes.len())?.to_be_bytes();
        self.unsent.extend_from_slice(&length);
        if self.unsent.len() + self.bytes.len() <= BATCH {
            self.unsent.extend_from_slice(&self.bytes);
            return Ok(());
        }
        if self.bytes.len() < BATCH {
            self.unsent.extend_from_slice(&self.bytes);
            return self.flush();
        }
        // A copy of this message into the queue would gain nothing.
        self.flush()?;
        Ok(self.runtime.block_on(self.out.write_all(&self.bytes))?)
    }

    fn flush(&mut self) -> Result<()> {
        self.runtime.block_on(self.out.write_all(&self.unsent))?;
        self.unsent.clear();
        Ok(())
    }
}

/// Writes one byte, because the peer learns of a stream only when data arrives on it.
async fn greet(mut out: SendStream) -> Result<SendStream> {
    out.write_all(&[0]).await?;
    Ok(out)
}

fn endpoint(config: Option<ServerConfig>) -> Result<Endpoint> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    // These are a daemon's sizes. With the system's defaults a stream on loopback loses packets.
    sockopt::set_socket_recv_buffer_size(&socket, SOCKET_BUFFER)?;
    sockopt::set_socket_send_buffer_size(&socket, SOCKET_BUFFER)?;
    Ok(Endpoint::new(EndpointConfig::default(), config, socket, Arc::new(TokioRuntime))?)
}

fn transport() -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    transport
        .stream_receive_window(VarInt::from_u32(STREAM_WINDOW))
        .receive_window(VarInt::from_u32(CONNECTION_WINDOW))
        .send_window(SEND_WINDOW);
    Arc::new(transport)
}

impl End for BareEnd {
    fn send(&mut self, number: u64) -> Result<()> {
        self.queue(number)?;
        self.flush()?;
        if self.is_paced {
            // Each yield lets quinn's tasks run once. The first sends, and the second processes acknowledgements.
            self.runtime.block_on(async {
                tokio::task::yield_now().await;
                tokio::task::yield_now().await;
            });
        }
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        let mut length = [0; HEADER];
        self.unread.take(&self.runtime, &mut self.into, &mut length)?;
        if u32::from_be_bytes(length) as usize != self.bytes.len() {
            return Err("a message of another length".into());
        }
        self.unread.take(&self.runtime, &mut self.into, &mut self.bytes)?;
        let [first, last] = [self.bytes.first_chunk(), self.bytes.last_chunk()];
        agree(*first.ok_or("too short")?, *last.ok_or("too short")?)
    }

    fn idle(&mut self, channel: &Channel) -> Result<()> {
        // This polls instead of registering the channel with the reactor: it happens between turns, and the channel is
        // a blocking socket.
        self.runtime.block_on(async {
            while !channel.is_readable()? {
                tokio::time::sleep(CHECK_INTERVAL).await;
            }
            Ok(())
        })
    }
}

impl Drop for BareEnd {
    fn drop(&mut self) {
        self.endpoint.close(VarInt::from_u32(0), b"");
        self.runtime.block_on(self.endpoint.wait_idle());
    }
}

/// Bytes that were read from the stream and not yet taken: those of `buffer` from `taken` to `filled`.
struct Unread {
    buffer: Vec<u8>,
    taken: usize,
    filled: usize,
}

impl Unread {
    /// Fills `into` with the next bytes. Waits only for bytes that are not in the buffer.
    fn take(&mut self, runtime: &Runtime, stream: &mut RecvStream, into: &mut [u8]) -> Result<()> {
        let mut done = 0;
        loop {
            let here = (self.filled - self.taken).min(into.len() - done);
            let bytes = &self.buffer[self.taken..self.taken + here];
            into[done..done + here].copy_from_slice(bytes);
            self.taken += here;
            done += here;
            if done == into.len() {
                return Ok(());
            }
            if into.len() - done >= BATCH {
                return Ok(runtime.block_on(stream.read_exact(&mut into[done..]))?);
            }
            let read = runtime.block_on(stream.read(&mut self.buffer))?;
            (self.taken, self.filled) = (0, read.ok_or("the stream has ended")?);
        }
    }
}
