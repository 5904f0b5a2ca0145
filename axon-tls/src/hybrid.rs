//! Connections with X25519MLKEM768 only, on the released rustls.
//!
//! X25519MLKEM768 is one group. Its secret is safe as long as X25519 or ML-KEM-768 is. A peer that does not offer the
//! group or TLS 1.3 is refused with a `handshake_failure` or `protocol_version` alert.
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
//! let conn = axon_tls::rustls::ClientConnection::new(Arc::new(config), "peer".try_into()?)?;
//! assert!(hybrid::negotiated(&conn).is_none(), "the handshake has not begun");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod erasing;

use std::sync::Arc;

use rustls::client::Resumption;
use rustls::crypto::aws_lc_rs::cipher_suite::TLS13_AES_128_GCM_SHA256;
use rustls::crypto::aws_lc_rs::{default_provider, kx_group};
use rustls::crypto::{CryptoProvider, SupportedKxGroup};
use rustls::server::NoServerSessionStorage;
use rustls::version::TLS13;
use rustls::{ClientConfig, CommonState, ConfigBuilder, NamedGroup, ServerConfig, WantsVerifier};

use self::erasing::{suite, suite_without_resumption};
use crate::identity::{Auth, SpkiDigest};
use crate::negotiated::protocols;
use crate::{Cipher, Error, KeyExchange, Negotiated};

/// Returns aws-lc-rs with only X25519MLKEM768 and only the TLS 1.3 suites with 256-bit keys.
///
/// Their HKDF erases the secrets that it held.
pub fn provider() -> CryptoProvider {
    CryptoProvider {
        cipher_suites: Cipher::ALL.into_iter().map(suite).collect(),
        kx_groups: vec![GROUP],
        ..default_provider()
    }
}

/// As [`provider()`], with one cipher suite.
pub fn provider_with(cipher: Cipher) -> CryptoProvider {
    CryptoProvider { cipher_suites: vec![suite(cipher)], ..provider() }
}

fn provider_without_resumption(cipher: Cipher) -> CryptoProvider {
    CryptoProvider { cipher_suites: vec![suite_without_resumption(cipher)], ..provider() }
}

/// Returns a builder for the caller's own client configuration. The next step chooses how the server's certificate is
/// verified.
///
/// ```
/// use axon_tls::{hybrid, rustls};
///
/// let mut config = hybrid::client_builder()
///     .with_root_certificates(rustls::RootCertStore::empty())
///     .with_no_client_auth();
/// config.alpn_protocols = vec![b"h3".to_vec()];
/// ```
pub fn client_builder() -> ConfigBuilder<ClientConfig, WantsVerifier> {
    ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS13])
        .expect("the provider has suites and a group of TLS 1.3")
}

/// Returns a builder for the caller's own server configuration. The next step chooses whether clients show
/// certificates.
pub fn server_builder() -> ConfigBuilder<ServerConfig, WantsVerifier> {
    ServerConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS13])
        .expect("the provider has suites and a group of TLS 1.3")
}

/// Returns the suite that protects Initial packets of QUIC (RFC 9001 section 5.2), for
/// `quinn::crypto::rustls::QuicServerConfig::with_initial()` and `QuicClientConfig::with_initial()`.
///
/// TLS never offers it: it is not in [`provider()`]. The keys of Initial packets are derived from public bytes of the
/// packets, so they protect nothing from an observer. The module `quic` uses the suite automatically.
pub fn quic_initial_suite() -> rustls::quic::Suite {
    TLS13_AES_128_GCM_SHA256
        .tls13()
        .and_then(|suite| suite.quic_suite())
        .expect("aws-lc-rs has AES-128-GCM for QUIC")
}

/// Makes a client's configuration with one ALPN protocol, or none if `alpn` is empty.
///
/// Its connections resume no session. The resumption secret of each connection is replaced by random bytes, so that
/// memory holds no such secret. If resumption were turned on, a server would refuse what the client offers.
/// [`client_builder()`] makes a configuration that can resume.
///
/// No server name is sent. The name with which the connection is made selects the accepted certificate under
/// [`Auth::Ca`], and has no effect otherwise.
pub fn client_config(auth: &Auth, cipher: Cipher, alpn: &[u8]) -> Result<ClientConfig, Error> {
    let builder =
        ClientConfig::builder_with_provider(Arc::new(provider_without_resumption(cipher)))
            .with_protocol_versions(&[&TLS13])?;
    let mut config = auth.client(builder)?;
    config.alpn_protocols = protocols(alpn)?;
    config.resumption = Resumption::disabled();
    config.enable_sni = false;
    Ok(config)
}

/// Makes a server's configuration with one ALPN protocol, or none if `alpn` is empty.
///
/// It issues no tickets, and like [`client_config()`] it makes no resumption secret.
pub fn server_config(auth: &Auth, cipher: Cipher, alpn: &[u8]) -> Result<ServerConfig, Error> {
    let builder =
        ServerConfig::builder_with_provider(Arc::new(provider_without_resumption(cipher)))
            .with_protocol_versions(&[&TLS13])?;
    let mut config = auth.server(builder)?;
    config.alpn_protocols = protocols(alpn)?;
    config.session_storage = Arc::new(NoServerSessionStorage {});
    config.send_tls13_tickets = 0;
    Ok(config)
}

/// Returns the result of a finished handshake. Returns `None` while the handshake is in progress.
///
/// It accepts any connection of rustls, over TCP or QUIC, because each dereferences to a [`CommonState`]. It also
/// returns `None` if the handshake negotiated something that this module does not offer. A connection made from its
/// configurations cannot do that.
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

/// Refuses a configuration that permits anything except the hybrid group and 256-bit suites of TLS 1.3, or that has
/// early data.
#[cfg(feature = "quic")]
pub(crate) fn check(provider: &CryptoProvider, early_data: bool) -> Result<(), Error> {
    let not_hybrid = |what: String| Err(Error::NotHybrid(what));
    if provider.kx_groups.is_empty() {
        return not_hybrid("no key exchange group".into());
    }
    for group in &provider.kx_groups {
        if group.name() != NamedGroup::X25519MLKEM768 {
            return not_hybrid(format!("the group {:?}", group.name()));
        }
    }
    for offered in &provider.cipher_suites {
        if !Cipher::ALL.into_iter().any(|cipher| suite(cipher).suite() == offered.suite()) {
            return not_hybrid(format!("the cipher suite {:?}", offered.suite()));
        }
    }
    if early_data { Err(Error::EarlyData) } else { Ok(()) }
}

const GROUP: &dyn SupportedKxGroup = kx_group::X25519MLKEM768;
