//! The raw limit between two hosts: one stream of bare quinn, under AXON's key exchange and cipher, with a
//! daemon's socket buffers and send window. Messages have a length before them; in a stream they are written 64 KiB at a time,
//! and always read so.

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

/// Bytes of a write in a stream, and of a read.
const BATCH: usize = 64 << 10;
const HEADER: usize = 4;
/// Between two looks at whether a turn is over.
const CHECK_INTERVAL: Duration = Duration::from_millis(1);
/// As a daemon's.
const SOCKET_BUFFER: usize = 8 << 20;
/// As a daemon's.
const SEND_WINDOW: u64 = 16 << 20;
/// Wider than a daemon's (at most 4 MiB), which has many peers: a user of quinn alone has one.
const STREAM_WINDOW: u32 = 32 << 20;
/// Wider than a daemon's too (1 MiB and a share of 64 MiB).
const CONNECTION_WINDOW: u32 = 256 << 20;

/// quinn and nothing else.
pub(super) struct BareQuic;

impl Medium for BareQuic {
    fn name(&self) -> &'static str {
        "bare quinn"
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        Ok(Box::new(BareEnd::open(load, side, channel, Threads::One)?))
    }
}

/// Which threads run quinn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Threads {
    /// The one that waits for a message: no other has to be woken.
    One,
    /// One of its own: it encrypts while the application makes messages.
    Two,
}

/// One end of the stream.
pub(super) struct BareEnd {
    out: SendStream,
    into: RecvStream,
    /// Queued and not handed to quinn yet.
    unsent: Vec<u8>,
    unread: Unread,
    bytes: Vec<u8>,
    /// Nothing is received after a message that would run quinn.
    is_paced: bool,
    _connection: Connection,
    endpoint: Endpoint,
    runtime: Runtime,
}

impl BareEnd {
    /// Meets the other side.
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
        // The far side's first byte goes once its thread runs quinn again.
        match side {
            Side::Near => channel.tell(&())?,
            Side::Far => {
                end.idle(channel)?;
                channel.hear::<()>()?;
            }
        }
        Ok(end)
    }

    /// Writes a message, which goes once 64 KiB are together.
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
        // Nothing is gained by a copy of this one.
        self.flush()?;
        Ok(self.runtime.block_on(self.out.write_all(&self.bytes))?)
    }

    fn flush(&mut self) -> Result<()> {
        self.runtime.block_on(self.out.write_all(&self.unsent))?;
        self.unsent.clear();
        Ok(())
    }
}

/// A stream that nothing was written to nobody hears of.
async fn greet(mut out: SendStream) -> Result<SendStream> {
    out.write_all(&[0]).await?;
    Ok(out)
}

fn endpoint(config: Option<ServerConfig>) -> Result<Endpoint> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    // As a daemon's. With the system's own a stream on loopback loses packets.
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
            // Each lets quinn's tasks run once: the first sends, the second takes in acknowledgements.
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
        // Not in the reactor: this is between turns, and the channel is one that blocks.
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

/// What was read from the stream and not taken yet: the buffer's bytes from `taken` to `filled`.
struct Unread {
    buffer: Vec<u8>,
    taken: usize,
    filled: usize,
}

impl Unread {
    /// Fills `into` with what comes next. Waits only where that is not here.
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
