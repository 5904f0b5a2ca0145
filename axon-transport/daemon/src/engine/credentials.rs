//! The TLS settings of both sides of a handshake, and whether a peer is trusted.

use std::{
    net::IpAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, SystemTime},
};

use axon_tls::{
    Negotiated,
    identity::Auth,
    quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server},
};
use axon_transport::config::{Config, Security};
use quinn_proto::{QlogStream, TimeSource, TransportConfig};
use rustls_pki_types::CertificateDer;

use super::quic::{
    tls_settings::{psk_kex, tls_cipher},
    transport::Transports,
};
use crate::{
    error::GatewayError,
    identity::Identity,
    keys::{DialKey, Resolver},
    link::Side,
};

/// Handshakes of unvalidated addresses that QUIC keeps.
const MAX_INCOMING: usize = 256;

/// The engine's time, in seconds, as QUIC dates the tokens that validate addresses. QUIC's own default is the wall clock:
/// one that jumps would refuse a handshake that is under way. Another daemon does not see these tokens.
#[derive(Debug, Default)]
struct TokenTime(AtomicU64);

impl TimeSource for TokenTime {
    fn now(&self) -> SystemTime {
        // Relaxed: the engine's thread alone writes and reads it.
        SystemTime::UNIX_EPOCH + Duration::from_secs(self.0.load(Ordering::Relaxed))
    }
}

/// This host's identity and settings for handshakes.
pub(crate) struct Credentials {
    config: Arc<Config>,
    /// The classic identity; `None` in qkd.
    identity: Option<Arc<Identity>>,
    transports: Transports,
    time: Arc<TokenTime>,
}

impl Credentials {
    /// The settings of `config`, with the identity that its files say.
    pub(crate) fn new(config: Arc<Config>, identity: Option<Arc<Identity>>) -> Self {
        Self { transports: Transports::new(&config), config, identity, time: Arc::default() }
    }

    /// The engine's time goes on.
    pub(super) fn set_time(&self, now: Duration) {
        // Relaxed: see `TokenTime`.
        self.time.0.store(now.as_secs(), Ordering::Relaxed);
    }

    /// The classic identity in force; `None` in qkd.
    pub(crate) fn auth(&self) -> Option<Auth> {
        self.identity.as_ref().map(|identity| identity.auth())
    }

    /// Whether peers prove who they are.
    pub(crate) fn authenticates(&self) -> bool {
        !matches!(self.auth(), Some(Auth::None(_)))
    }

    /// Why no new peer is accepted, if so: a file of the identity cannot be used.
    pub(crate) fn closed(&self) -> Option<String> {
        self.identity.as_ref().and_then(|identity| identity.closed())
    }

    /// The transport settings of one connection with a peer at `address`, whose events are written.
    pub(crate) fn logged(&self, stream: QlogStream, address: IpAddr) -> Arc<TransportConfig> {
        Transports::logged(&self.config, stream, address)
    }

    /// The client's side of a handshake with a server at `address`, in qkd on one PSK.
    ///
    /// # Errors
    /// The settings, or the key, make no TLS client.
    pub(crate) fn client(
        &self,
        attempt: Option<&DialKey>,
        address: IpAddr,
    ) -> Result<quinn_proto::ClientConfig, GatewayError> {
        let mut client = match (&self.config.security, attempt, self.auth()) {
            (Security::Qkd(qkd), Some(attempt), _) => {
                qkd_client(Arc::clone(&attempt.psk), psk_kex(qkd.kex), ALPN)?
            }
            (Security::Classic(_), None, Some(auth)) => {
                hybrid_client(&auth, tls_cipher(self.config.cipher), ALPN)?
            }
            _ => return Err(GatewayError::WrongMode),
        };
        client.transport_config(self.transports.towards(address));
        Ok(client)
    }

    /// The server's side of a handshake with a client at `address`, in qkd with the resolver of PSKs.
    ///
    /// # Errors
    /// The settings make no TLS server.
    pub(crate) fn server(
        &self,
        resolver: Option<Arc<Resolver>>,
        address: IpAddr,
    ) -> Result<quinn_proto::ServerConfig, GatewayError> {
        let cipher = tls_cipher(self.config.cipher);
        let mut server = match (&self.config.security, resolver, self.auth()) {
            (Security::Qkd(qkd), Some(resolver), _) => {
                qkd_server(resolver, cipher, psk_kex(qkd.kex), ALPN)?
            }
            (Security::Classic(_), None, Some(auth)) => hybrid_server(&auth, cipher, ALPN)?,
            _ => return Err(GatewayError::WrongMode),
        };
        server
            .transport_config(self.transports.towards(address))
            .time_source(Arc::clone(&self.time) as _)
            .migration(true)
            .max_incoming(MAX_INCOMING);
        Ok(server)
    }

    /// Why a peer with a link, of which this host is the `side`, would not be accepted now: its pin was removed or
    /// ended at `wall`, or its certificate ended or was revoked. `chain` is `None` where certificates need not be checked,
    /// since that costs signatures.
    pub(crate) fn distrust(
        &self,
        negotiated: &Negotiated,
        side: Side,
        chain: Option<&[CertificateDer<'static>]>,
        wall: SystemTime,
    ) -> Option<String> {
        match (self.auth()?, chain) {
            (Auth::Pinned { trust, .. }, _) => {
                let pin = negotiated.peer.and_then(|key| trust.pin_of(&key));
                match pin {
                    Some(pin) if pin.holds(wall) => None,
                    Some(pin) => Some(format!(
                        "its pin in AXON_CLASSIC_TRUST, of {}, ended: its last day is {} (UTC)",
                        pin.name(),
                        pin.last_day().unwrap_or("unknown")
                    )),
                    None => Some("its key is no longer pinned in AXON_CLASSIC_TRUST".into()),
                }
            }
            (Auth::Ca(material), Some(chain)) => {
                let accepted = match side {
                    Side::Client => material.accepts_server(chain),
                    Side::Server => material.accepts_client(chain),
                };
                let error = accepted.err()?;
                Some(format!("its certificate is no longer accepted: {error}"))
            }
            _ => None,
        }
    }
}
