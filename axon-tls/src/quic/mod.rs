//! Both modes as quinn configurations.
//!
//! The AES-128-GCM that QUIC prescribes for Initial packets is used only for them; TLS never offers it. There is no
//! 0-RTT, and a server returns 1-RTT keys only after it has verified the client's Finished. Only QUIC version 1 is
//! supported.
//!
//! An alert of TLS is visible in [`quinn::ConnectionError`] as the code 0x100 + alert. [`tls_alert()`] extracts it.
//!
//! | alert | code  | means |
//! |-------|-------|-------|
//! | 40    | 0x128 | no common group, cipher suite or PSK mode |
//! | 51    | 0x133 | wrong pre-shared key, or swapped roles |
//! | 109   | 0x16d | the client offers no pre-shared key, and must |
//! | 115   | 0x173 | the server does not know the identity of the pre-shared key |
//! | 120   | 0x178 | no common application protocol |

#[cfg(feature = "hybrid")]
mod hybrid;
mod protection;
mod psk;

use std::any::Any;
use std::sync::Arc;

#[cfg(feature = "hybrid")]
use crate::identity::Auth;
use crate::psk::{Psk, PskResolver};
use crate::{Cipher, Error, Negotiated, PskKex};

/// The application protocol of AXON.
pub const ALPN: &[u8] = b"axon/1";

/// Makes a client in hybrid mode.
#[cfg(feature = "hybrid")]
pub fn hybrid_client(
    auth: &Auth,
    cipher: Cipher,
    alpn: &[u8],
) -> Result<quinn::ClientConfig, Error> {
    hybrid_client_with(crate::hybrid::client_config(auth, cipher, alpn)?)
}

/// Makes a server in hybrid mode.
#[cfg(feature = "hybrid")]
pub fn hybrid_server(
    auth: &Auth,
    cipher: Cipher,
    alpn: &[u8],
) -> Result<quinn::ServerConfig, Error> {
    hybrid_server_with(crate::hybrid::server_config(auth, cipher, alpn)?)
}

/// Makes a client in hybrid mode from the caller's own configuration, for example one that verifies a web server's
/// certificate and shows none itself. Make the configuration with
/// [`hybrid::client_builder()`](crate::hybrid::client_builder).
///
/// Instead of quinn's `HandshakeData` the connection has [`negotiated()`].
///
/// # Errors
/// [`Error::NotHybrid`] if the configuration has a group other than X25519MLKEM768 or a suite other than the two
/// [`Cipher`]s, [`Error::EarlyData`] if it has early data, [`Error::Alpn`] if it has no ALPN protocol, which QUIC makes
/// mandatory (RFC 9001 section 8.1).
#[cfg(feature = "hybrid")]
pub fn hybrid_client_with(tls: rustls::ClientConfig) -> Result<quinn::ClientConfig, Error> {
    crate::hybrid::check(tls.crypto_provider(), tls.enable_early_data)?;
    check_alpn(&tls.alpn_protocols)?;
    Ok(quinn::ClientConfig::new(Arc::new(hybrid::Client::new(tls))))
}

/// Makes a server in hybrid mode from the caller's own configuration, for example one with a web certificate that does
/// not ask clients for one. Make the configuration with [`hybrid::server_builder()`](crate::hybrid::server_builder).
///
/// ```
/// use axon_tls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
/// use axon_tls::{hybrid, quic, quinn};
///
/// fn http3(
///     chain: Vec<CertificateDer<'static>>,
///     key: PrivateKeyDer<'static>,
/// ) -> Result<quinn::ServerConfig, Box<dyn std::error::Error>> {
///     let mut tls = hybrid::server_builder().with_no_client_auth().with_single_cert(chain, key)?;
///     tls.alpn_protocols = vec![b"h3".to_vec()];
///     Ok(quic::hybrid_server_with(tls)?)
/// }
/// ```
///
/// # Errors
/// As [`hybrid_client_with()`].
#[cfg(feature = "hybrid")]
pub fn hybrid_server_with(tls: rustls::ServerConfig) -> Result<quinn::ServerConfig, Error> {
    crate::hybrid::check(tls.crypto_provider(), tls.max_early_data_size != 0)?;
    check_alpn(&tls.alpn_protocols)?;
    Ok(quinn::ServerConfig::with_crypto(Arc::new(hybrid::Server::new(tls))))
}

/// Makes a client that offers `psks`, most preferred first. The cipher is the one that the keys are for.
///
/// # Errors
/// The same as for [`psk::client_config()`](crate::psk::client_config), and [`Error::Alpn`] if `alpn` is empty.
pub fn psk_client(
    psks: Vec<Arc<Psk>>,
    kex: PskKex,
    alpn: &[u8],
) -> Result<quinn::ClientConfig, Error> {
    let tls = crate::psk::client_config(psks, kex, alpn)?;
    check_alpn(&tls.alpn_protocols)?;
    Ok(quinn::ClientConfig::new(Arc::new(psk::Client::new(tls))))
}

/// Makes a server on the pre-shared keys that `resolver` knows.
///
/// # Errors
/// [`Error::Alpn`] if `alpn` is empty or too long.
pub fn psk_server(
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
    kex: PskKex,
    alpn: &[u8],
) -> Result<quinn::ServerConfig, Error> {
    let tls = crate::psk::server_config(resolver, cipher, kex, alpn)?;
    check_alpn(&tls.alpn_protocols)?;
    Ok(quinn::ServerConfig::with_crypto(Arc::new(psk::Server::new(tls))))
}

/// Makes a client for one connection on `psk`. The cipher is the one for which the key was derived.
pub fn qkd_client(psk: Arc<Psk>, kex: PskKex, alpn: &[u8]) -> Result<quinn::ClientConfig, Error> {
    psk_client(vec![psk], kex, alpn)
}

/// Makes a server on the pre-shared keys that `resolver` knows, as [`psk_server()`] does.
pub fn qkd_server(
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
    kex: PskKex,
    alpn: &[u8],
) -> Result<quinn::ServerConfig, Error> {
    psk_server(resolver, cipher, kex, alpn)
}

/// Returns the result of the finished handshake of a connection from this module.
///
/// `handshake_data()` of quinn's types also holds it, as a [`Negotiated`].
pub fn negotiated(conn: &quinn::Connection) -> Option<Negotiated> {
    from_handshake_data(conn.handshake_data()?)
}

/// Converts quinn's handshake data. Returns `None` if the connection is not from this module.
pub fn from_handshake_data(data: Box<dyn Any>) -> Option<Negotiated> {
    data.downcast().ok().map(|negotiated| *negotiated)
}

/// Returns the TLS alert that ended a connection. Either end may have sent it.
pub fn tls_alert(error: &quinn::ConnectionError) -> Option<u8> {
    let code = match error {
        quinn::ConnectionError::TransportError(error) => u64::from(error.code),
        quinn::ConnectionError::ConnectionClosed(close) => u64::from(close.error_code),
        _ => return None,
    };
    code.checked_sub(0x100).and_then(|alert| u8::try_from(alert).ok())
}

/// Checks that there is a protocol, because QUIC makes ALPN mandatory (RFC 9001 section 8.1).
fn check_alpn(protocols: &[Vec<u8>]) -> Result<(), Error> {
    let usable = |protocol: &Vec<u8>| (1..=255).contains(&protocol.len());
    if protocols.is_empty() || !protocols.iter().all(usable) {
        return Err(Error::Alpn);
    }
    Ok(())
}
