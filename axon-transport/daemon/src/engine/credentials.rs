//! The TLS settings of both sides of a handshake, and whether a peer is trusted.

use std::{sync::Arc, time::SystemTime};

use axon_tls::{
    Negotiated,
    identity::Auth,
    quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server},
};
use axon_transport::config::{Config, Security};
use quinn_proto::{QlogStream, TransportConfig};
use rustls_pki_types::CertificateDer;

use crate::{
    engine::{
        tls_settings::{psk_kex, tls_cipher},
        transport::transport,
    },
    error::GatewayError,
    identity::Identity,
    keys::{Attempt, Resolver},
    link::Side,
};

/// Handshakes of unvalidated addresses that QUIC keeps.
const MAX_INCOMING: usize = 256;

/// This host's identity and settings for handshakes.
pub(crate) struct Credentials {
    config: Arc<Config>,
    /// The classic identity; `None` in qkd.
    identity: Option<Arc<Identity>>,
    transport: Arc<TransportConfig>,
}

impl Credentials {
    /// The settings of `config`, with the identity that its files say.
    pub(crate) fn new(config: Arc<Config>, identity: Option<Arc<Identity>>) -> Self {
        Self { transport: Arc::new(transport(&config)), config, identity }
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

    /// The transport settings of one connection whose events are written.
    pub(crate) fn logged(&self, stream: QlogStream) -> Arc<TransportConfig> {
        let mut transport = transport(&self.config);
        transport.qlog_stream(Some(stream));
        Arc::new(transport)
    }

    /// The client's side of a handshake, in qkd on one PSK.
    ///
    /// # Errors
    /// The settings, or the key, make no TLS client.
    pub(crate) fn client(
        &self,
        attempt: Option<&Attempt>,
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
        client.transport_config(Arc::clone(&self.transport));
        Ok(client)
    }

    /// The server's side of a handshake, in qkd with the resolver of PSKs.
    ///
    /// # Errors
    /// The settings make no TLS server.
    pub(crate) fn server(
        &self,
        resolver: Option<Arc<Resolver>>,
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
            .transport_config(Arc::clone(&self.transport))
            .migration(true)
            .max_incoming(MAX_INCOMING);
        Ok(server)
    }

    /// Why a peer with a link, of which this host is the `side`, would not be accepted now: its pin was removed or
    /// ended, or its certificate ended or was revoked. `chain` is `None` where certificates need not be checked,
    /// since that costs signatures.
    pub(crate) fn distrust(
        &self,
        negotiated: &Negotiated,
        side: Side,
        chain: Option<&[CertificateDer<'static>]>,
    ) -> Option<String> {
        match (self.auth()?, chain) {
            (Auth::Pinned { trust, .. }, _) => {
                let pin = negotiated.peer.and_then(|key| trust.pin_of(&key));
                match pin {
                    Some(pin) if pin.holds(SystemTime::now()) => None,
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
