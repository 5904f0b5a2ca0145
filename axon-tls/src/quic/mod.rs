//! Both modes as quinn configurations.
//!
//! The AES-128-GCM that QUIC prescribes for Initial packets is used for them alone; TLS never
//! offers it. There is no 0-RTT, and a server hands out 1-RTT keys only after the client's
//! Finished was verified. QUIC version 1 alone is spoken.
//!
//! An alert of TLS is visible in [`quinn::ConnectionError`] as the code 0x100 + alert:
//! [`tls_alert()`] takes it out.
//!
//! | alert | code  | means |
//! |-------|-------|-------|
//! | 40    | 0x128 | no common group, cipher suite or PSK mode |
//! | 51    | 0x133 | wrong pre-shared key, or swapped roles |
//! | 109   | 0x16d | the client offers no pre-shared key, and must |
//! | 115   | 0x173 | the server does not know the identity of the pre-shared key |
//! | 120   | 0x178 | no common application protocol |

mod hybrid;
mod protection;
mod qkd;

use std::any::Any;
use std::sync::Arc;

use crate::identity::Auth;
use crate::qkd::{Psk, PskResolver};
use crate::{Cipher, Error, Negotiated, PskKex};

/// The application protocol of AXON.
pub const ALPN: &[u8] = b"axon/1";

/// A client in hybrid mode.
pub fn hybrid_client(
    auth: &Auth,
    cipher: Cipher,
    alpn: &[u8],
) -> Result<quinn::ClientConfig, Error> {
    check_alpn(alpn)?;
    let tls = crate::hybrid::client_config(auth, cipher, alpn)?;
    Ok(quinn::ClientConfig::new(Arc::new(hybrid::Client::new(tls))))
}

/// A server in hybrid mode.
pub fn hybrid_server(
    auth: &Auth,
    cipher: Cipher,
    alpn: &[u8],
) -> Result<quinn::ServerConfig, Error> {
    check_alpn(alpn)?;
    let tls = crate::hybrid::server_config(auth, cipher, alpn)?;
    Ok(quinn::ServerConfig::with_crypto(Arc::new(hybrid::Server::new(tls))))
}

/// A client for one connection on `psk`. The cipher is the one that the key was derived for.
pub fn qkd_client(psk: Arc<Psk>, kex: PskKex, alpn: &[u8]) -> Result<quinn::ClientConfig, Error> {
    check_alpn(alpn)?;
    let tls = crate::qkd::client_config(psk, kex, alpn)?;
    Ok(quinn::ClientConfig::new(Arc::new(qkd::Client::new(tls))))
}

/// A server on the pre-shared keys that `resolver` knows.
pub fn qkd_server(
    resolver: Arc<dyn PskResolver>,
    cipher: Cipher,
    kex: PskKex,
    alpn: &[u8],
) -> Result<quinn::ServerConfig, Error> {
    check_alpn(alpn)?;
    let tls = crate::qkd::server_config(resolver, cipher, kex, alpn)?;
    Ok(quinn::ServerConfig::with_crypto(Arc::new(qkd::Server::new(tls))))
}

/// What the finished handshake of a connection from this module agreed on.
///
/// It is also what `handshake_data()` of quinn's types holds, as a [`Negotiated`].
pub fn negotiated(conn: &quinn::Connection) -> Option<Negotiated> {
    from_handshake_data(conn.handshake_data()?)
}

/// What quinn gave as handshake data, if it is from a connection from this module.
pub fn from_handshake_data(data: Box<dyn Any>) -> Option<Negotiated> {
    data.downcast().ok().map(|negotiated| *negotiated)
}

/// The TLS alert that ended a connection, whichever end sent it.
pub fn tls_alert(error: &quinn::ConnectionError) -> Option<u8> {
    let code = match error {
        quinn::ConnectionError::TransportError(error) => u64::from(error.code),
        quinn::ConnectionError::ConnectionClosed(close) => u64::from(close.error_code),
        _ => return None,
    };
    code.checked_sub(0x100).and_then(|alert| u8::try_from(alert).ok())
}

/// QUIC makes ALPN mandatory (RFC 9001 section 8.1).
fn check_alpn(alpn: &[u8]) -> Result<(), Error> {
    if alpn.is_empty() { Err(Error::Alpn) } else { Ok(()) }
}
