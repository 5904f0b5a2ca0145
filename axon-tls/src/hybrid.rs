//! X25519MLKEM768 and nothing else, on rustls as released.
//!
//! X25519MLKEM768 is one group: its secret is safe as long as either X25519 or ML-KEM-768 is. A
//! peer that offers neither it nor TLS 1.3 is refused with a `handshake_failure` or
//! `protocol_version` alert.
//!
//! ```
//! use std::sync::Arc;
//!
//! use axon_tls::Cipher;
//! use axon_tls::hybrid;
//! use axon_tls::identity::{Auth, SigningKey};
//!
//! let auth = Auth::None(SigningKey::generate()?);
//! let config = hybrid::client_config(&auth, Cipher::default(), b"my-protocol/1")?;
//! let conn = rustls::ClientConnection::new(Arc::new(config), "peer".try_into()?)?;
//! assert!(hybrid::negotiated(&conn).is_none(), "the handshake has not begun");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod erasing;

use std::sync::Arc;

use rustls::client::Resumption;
use rustls::crypto::aws_lc_rs::{default_provider, kx_group};
use rustls::crypto::{CryptoProvider, SupportedKxGroup};
use rustls::server::NoServerSessionStorage;
use rustls::version::TLS13;
use rustls::{ClientConfig, CommonState, NamedGroup, ServerConfig};

use self::erasing::suite;
use crate::identity::{Auth, SpkiDigest};
use crate::{Cipher, Error, KeyExchange, Negotiated};

/// aws-lc-rs with X25519MLKEM768 alone and the TLS 1.3 suites with 256-bit keys alone.
///
/// Their HKDF erases the secrets that it held.
pub fn provider() -> CryptoProvider {
    CryptoProvider {
        cipher_suites: Cipher::ALL.into_iter().map(suite).collect(),
        kx_groups: vec![GROUP],
        ..default_provider()
    }
}

/// The same with one cipher suite.
pub fn provider_with(cipher: Cipher) -> CryptoProvider {
    CryptoProvider { cipher_suites: vec![suite(cipher)], ..provider() }
}

/// A client's configuration, with one ALPN protocol, or none if `alpn` is empty.
///
/// No server name is sent: what the connection is made with says which certificate is accepted
/// under [`Auth::Ca`], and nothing under the others.
pub fn client_config(auth: &Auth, cipher: Cipher, alpn: &[u8]) -> Result<ClientConfig, Error> {
    let builder = ClientConfig::builder_with_provider(Arc::new(provider_with(cipher)))
        .with_protocol_versions(&[&TLS13])?;
    let mut config = auth.client(builder)?;
    config.alpn_protocols = protocols(alpn)?;
    config.resumption = Resumption::disabled();
    config.enable_sni = false;
    Ok(config)
}

/// A server's configuration, with one ALPN protocol, or none if `alpn` is empty.
pub fn server_config(auth: &Auth, cipher: Cipher, alpn: &[u8]) -> Result<ServerConfig, Error> {
    let builder = ServerConfig::builder_with_provider(Arc::new(provider_with(cipher)))
        .with_protocol_versions(&[&TLS13])?;
    let mut config = auth.server(builder)?;
    config.alpn_protocols = protocols(alpn)?;
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// What a finished handshake agreed on; `None` while it is under way.
///
/// Takes any connection of rustls, over TCP or QUIC: each dereferences to a [`CommonState`].
/// Also `None` if something other than this module offers was agreed on, which a connection made
/// from its configurations cannot do.
pub fn negotiated(conn: &CommonState) -> Option<Negotiated> {
    if conn.is_handshaking() {
        return None;
    }
    let agreed = conn.negotiated_cipher_suite()?.suite();
    let group = conn.negotiated_key_exchange_group()?.name();
    Some(Negotiated {
        key_exchange: (group == NamedGroup::X25519MLKEM768)
            .then_some(KeyExchange::X25519MlKem768)?,
        cipher: Cipher::ALL.into_iter().find(|cipher| suite(*cipher).suite() == agreed)?,
        psk_identity: None,
        peer: conn.peer_certificates().and_then(<[_]>::first).and_then(SpkiDigest::of_peer),
        alpn: conn.alpn_protocol().unwrap_or_default().to_vec(),
    })
}

pub(crate) fn protocols(alpn: &[u8]) -> Result<Vec<Vec<u8>>, Error> {
    match alpn.len() {
        0 => Ok(Vec::new()),
        1..=255 => Ok(vec![alpn.to_vec()]),
        _ => Err(Error::Alpn),
    }
}

const GROUP: &dyn SupportedKxGroup = kx_group::X25519MLKEM768;
