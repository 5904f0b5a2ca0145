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

/// The engine's time, in seconds, with which QUIC dates the tokens that validate addresses. QUIC's own default is the
/// wall clock; if that jumped, QUIC would refuse a handshake under way. Another daemon does not see these tokens.
#[derive(Debug, Default)]
struct TokenTime(AtomicU64);

impl TimeSource for TokenTime {
    fn now(&self) -> SystemTime {
        // Relaxed: only the engine's thread writes and reads it.
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
    /// Creates credentials with the settings of `config` and the identity that its files define.
    pub(crate) fn new(config: Arc<Config>, identity: Option<Arc<Identity>>) -> Self {
        Self { transports: Transports::new(&config), config, identity, time: Arc::default() }
    }

    /// Advances the engine's time.
    pub(super) fn set_time(&self, now: Duration) {
        // Relaxed: see `TokenTime`.
        self.time.0.store(now.as_secs(), Ordering::Relaxed);
    }

    /// Returns the classic identity in force; `None` in qkd.
    pub(crate) fn auth(&self) -> Option<Auth> {
        self.identity.as_ref().map(|identity| identity.auth())
    }

    /// Returns whether peers prove who they are.
    pub(crate) fn authenticates(&self) -> bool {
        !matches!(self.auth(), Some(Auth::None(_)))
    }

    /// Returns the reason why no new peer is accepted, if so: a file of the identity cannot be used.
    pub(crate) fn closed(&self) -> Option<String> {
        self.identity.as_ref().and_then(|identity| identity.closed())
    }

    /// Returns the transport settings of one connection with a peer at `address`, whose events go to the log `stream`.
    pub(crate) fn logged(&self, stream: QlogStream, address: IpAddr) -> Arc<TransportConfig> {
        Transports::logged(&self.config, stream, address)
    }

    /// Returns the TLS settings of the client's side of a handshake with a server at `address`, in qkd on one PSK.
    ///
    /// # Errors
    /// The settings or the key are not valid for a TLS client.
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

    /// Returns the TLS settings of the server's side of a handshake with a client at `address`, in qkd with the
    /// resolver of PSKs.
    ///
    /// # Errors
    /// The settings are not valid for a TLS server.
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

    /// Returns the reason why a peer with a link, of which this host is the `side`, would not be accepted now: its pin
    /// was removed or ended at `wall`, or its certificate ended or was revoked. `chain` is `None` where certificates
    /// need not be checked, since that costs signatures.
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
