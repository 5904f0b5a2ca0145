//! QUIC endpoints: which addresses and port they bind, and the transport settings of every link.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket},
    path::Path,
    sync::Arc,
    time::Duration,
};

use aws_lc_rs::hmac;
use axon_transport::config::Config;
use quinn::{
    Endpoint, EndpointConfig, IdleTimeout, MtuDiscoveryConfig, TokioRuntime, TransportConfig,
    VarInt,
};
use quinn_proto::{
    HashedConnectionIdGenerator,
    crypto::{CryptoError, HmacKey},
};
use tokio::sync::mpsc;

use super::socket::{Datagram, DemuxSocket};
use crate::discovery::quic_ports;

/// A silent peer is given up after this.
const IDLE_TIMEOUT_MS: u32 = 20_000;
/// Data streams a peer may open before its HELLO is checked; quinn allocates each of them.
const STREAMS_BEFORE_HELLO: u32 = 128;
/// Data streams of an open link: one per publisher and route, and best-effort messages in flight.
pub(crate) const STREAMS_OPEN: u32 = 4096;
const SOCKET_BUFFER: usize = 8 << 20;
const SEND_WINDOW: u64 = 16 << 20;
const STREAM_WINDOW: (u64, u64) = (1 << 20, 4 << 20);
/// What a link may have under way before it is elected, and each link has then beside its share of what
/// its peer may have.
pub(crate) const LINK_WINDOW: u32 = 1 << 20;

/// The endpoints of a daemon: one per bound address, all on the same port.
#[derive(Debug)]
pub(crate) struct Endpoints {
    /// One per bound address.
    pub(crate) all: Vec<Endpoint>,
    /// The port that all of them have.
    pub(crate) port: u16,
    senders: Vec<(SocketAddr, UdpSocket)>,
}

/// Why no endpoint could be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EndpointError {
    /// Every port of the domain's range is taken or refused.
    #[error(
        "no QUIC port of {first}..={last} can be bound on {addresses}: {source}; another daemon \
         holds it, or AXON_BIND_ADDRS names an address that this host does not have"
    )]
    NoPort {
        /// First port tried.
        first: u16,
        /// Last port tried.
        last: u16,
        /// The addresses, for people.
        addresses: String,
        /// What the last attempt said.
        source: io::Error,
    },
    /// quinn refused the socket.
    #[error("the QUIC endpoint could not be started: {0}")]
    Start(#[from] io::Error),
}

impl Endpoints {
    /// Binds the first free port of the domain on every address of `AXON_BIND_ADDRS` (every
    /// address when it is empty). `server` is what answers; quinn tasks run on this runtime.
    pub(crate) fn bind(
        config: &Config,
        reset_key: &[u8; 32],
        server: Option<quinn::ServerConfig>,
        discovery: &mpsc::Sender<Datagram>,
    ) -> Result<Self, EndpointError> {
        let (port, sockets) = bind_daemon(config)?;
        let mut all = Vec::new();
        let mut senders = Vec::new();
        for (address, socket) in sockets {
            senders.push((address, socket.try_clone()?));
            let demux = DemuxSocket::new(socket, discovery.clone())?;
            all.push(Endpoint::new_with_abstract_socket(
                endpoint_config(reset_key),
                server.clone(),
                demux,
                Arc::new(TokioRuntime),
            )?);
        }
        Ok(Self { all, port, senders })
    }

    /// The endpoint from which `to` can be dialled.
    pub(crate) fn towards(&self, to: SocketAddr) -> Option<&Endpoint> {
        self.index_towards(to).map(|i| &self.all[i])
    }

    /// Sends a discovery datagram from the QUIC port; a failure is a lost datagram.
    pub(crate) fn send(&self, to: SocketAddr, bytes: &[u8]) {
        if let Some(i) = self.index_towards(to) {
            let _ = self.senders[i].1.send_to(bytes, to);
        }
    }

    /// A bound address of the peer's family; a loopback one only for loopback peers and, unless
    /// all are, any other for the rest.
    fn index_towards(&self, to: SocketAddr) -> Option<usize> {
        let family = |a: &SocketAddr| a.is_ipv4() == to.is_ipv4();
        let local = |a: &SocketAddr| a.ip().is_loopback() == to.ip().is_loopback();
        self.senders.iter().position(|(a, _)| family(a) && (local(a) || a.ip().is_unspecified()))
    }
}

/// Binds the first free port of the domain on every address of `AXON_BIND_ADDRS`, or on the unspecified
/// address if it is empty.
///
/// # Errors
/// No port of the domain can be bound.
pub(crate) fn bind_daemon(
    config: &Config,
) -> Result<(u16, Vec<(SocketAddr, UdpSocket)>), EndpointError> {
    let addresses = if config.bind_addrs.is_empty() {
        vec![IpAddr::V4(Ipv4Addr::UNSPECIFIED)]
    } else {
        config.bind_addrs.clone()
    };
    let ports = quic_ports(config.domain);
    let (first, last) = (*ports.start(), *ports.end());
    bind_first(&addresses, ports).map_err(|source| {
        let list: Vec<_> = addresses.iter().map(ToString::to_string).collect();
        EndpointError::NoPort { first, last, addresses: list.join(", "), source }
    })
}

fn bind_first(
    addresses: &[IpAddr],
    ports: std::ops::RangeInclusive<u16>,
) -> io::Result<(u16, Vec<(SocketAddr, UdpSocket)>)> {
    let mut last = io::Error::from(io::ErrorKind::AddrInUse);
    for port in ports {
        match addresses.iter().map(|a| bind_one(SocketAddr::new(*a, port))).collect() {
            Ok(sockets) => return Ok((port, sockets)),
            Err(e) => last = e,
        }
    }
    Err(last)
}

fn bind_one(address: SocketAddr) -> io::Result<(SocketAddr, UdpSocket)> {
    // No SO_REUSEADDR: the port is this daemon's alone.
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    // The kernel clamps these to its limits; a smaller buffer only costs throughput.
    let _ = rustix::net::sockopt::set_socket_recv_buffer_size(&socket, SOCKET_BUFFER);
    let _ = rustix::net::sockopt::set_socket_send_buffer_size(&socket, SOCKET_BUFFER);
    Ok((address, socket))
}

/// The key of stateless resets. quinn-proto takes aws-lc's own type only while no crate in the program
/// enables its feature `ring`.
struct ResetKey(hmac::Key);

impl HmacKey for ResetKey {
    fn sign(&self, data: &[u8], signature_out: &mut [u8]) {
        signature_out.copy_from_slice(hmac::sign(&self.0, data).as_ref());
    }

    fn signature_len(&self) -> usize {
        hmac::HMAC_SHA256.digest_algorithm().output_len()
    }

    fn verify(&self, data: &[u8], signature: &[u8]) -> Result<(), CryptoError> {
        hmac::verify(&self.0, data, signature).map_err(|_| CryptoError)
    }
}

pub(crate) fn endpoint_config(reset_key: &[u8; 32]) -> EndpointConfig {
    let key = hmac::Key::new(hmac::HMAC_SHA256, reset_key);
    // Connection ids are checked before a stateless reset is sent, so those of the predecessor must
    // pass: their key is derived from the one that is kept.
    let tag = hmac::sign(&key, b"connection ids");
    let mut config = EndpointConfig::new(Arc::new(ResetKey(key)));
    let mut seed = [0; 8];
    seed.copy_from_slice(&tag.as_ref()[..8]);
    let seed = u64::from_be_bytes(seed);
    config.cid_generator(move || Box::new(HashedConnectionIdGenerator::from_key(seed)));
    // The first two bits tell QUIC from discovery, so the fixed bit stays what it is.
    config.grease_quic_bit(false);
    config.supported_versions(vec![1]);
    config
}

/// The transport settings of a link, for either end.
pub(crate) fn transport(config: &Config) -> Arc<TransportConfig> {
    let mut transport = TransportConfig::default();
    let window = (config.max_message * 2).clamp(STREAM_WINDOW.0, STREAM_WINDOW.1);
    let mut mtu = MtuDiscoveryConfig::default();
    mtu.upper_bound(config.link.mtu);
    transport
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(STREAMS_BEFORE_HELLO))
        .max_idle_timeout(Some(IdleTimeout::from(VarInt::from_u32(IDLE_TIMEOUT_MS))))
        .keep_alive_interval(Some(Duration::from_secs(4)))
        .stream_receive_window(VarInt::from_u64(window).unwrap_or(VarInt::MAX))
        .receive_window(VarInt::from_u32(LINK_WINDOW))
        .send_window(SEND_WINDOW)
        .initial_mtu(1200)
        .mtu_discovery_config(Some(mtu));
    Arc::new(transport)
}

/// The link was elected: its peer may open as many streams as a link may have.
pub(crate) fn open_streams(connection: &quinn::Connection) {
    connection.set_max_concurrent_uni_streams(VarInt::from_u32(STREAMS_OPEN));
}

/// Lets the peer of a link have `share` bytes under way over it beside what each link has.
pub(crate) fn open_window(connection: &quinn::Connection, share: usize) {
    let share = u32::try_from(share).unwrap_or(u32::MAX);
    connection.set_receive_window(VarInt::from_u32(LINK_WINDOW.saturating_add(share)));
}

/// The key of stateless resets: kept in the runtime directory, so that the daemon that takes over
/// after a kill tells the peers of its predecessor at once that their links are gone.
pub(crate) fn reset_key(runtime_dir: Option<&Path>, domain: u32) -> [u8; 32] {
    use std::{fs, io::Write, os::unix::fs::OpenOptionsExt};

    let Some(dir) = runtime_dir else { return rand::random() };
    let path = dir.join(format!("reset-{domain}.key"));
    if let Ok(bytes) = fs::read(&path)
        && let Ok(key) = bytes.try_into()
    {
        return key;
    }
    let key: [u8; 32] = rand::random();
    let written = fs::OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(0o600)
        .open(&path)
        .and_then(|mut f| f.write_all(&key));
    if let Err(e) = written {
        tracing::warn!(path = %path.display(), error = %e,
            "the reset key cannot be kept: after a restart peers notice only by their idle timeout");
    }
    key
}
