//! Connections on a pre-shared key that comes from a QKD key.
//!
//! Both ends have the same 256-bit key and its key_ID from their key managers (KMEs). The client
//! has to be the one that called `enc_keys`. What is used in TLS is not the key itself but
//! [`derive_psk()`] of it, which binds it to the names of client and server in their roles, so that
//! a handshake cannot be reflected (RFC 9257 section 4.1). The identity that the client sends,
//! [`PskIdentity`], tells the server whose key and which one to ask its KME for.
//!
//! One key is for one connection.
//!
//! A peer that is not AXON, and knows nothing of that derivation, may speak the importer of RFC 9258
//! instead: [`import_psk()`] makes the same kind of [`Psk`] that way, with the same binding to both
//! names, and [`ImportedIdentity`] is what its server parses. A server that serves both kinds of
//! clients looks at the first byte of an identity, which is `a` in one form and 0 in the other. Use
//! [`derive_psk()`] wherever both ends are yours: its identity is printable, and AXON's daemons use
//! no other. A key is used in one form, never in both.
//!
//! ```
//! use axon_tls::qkd::{self, PskIdentity};
//! use axon_tls::{Cipher, PskKex};
//! use std::sync::Arc;
//!
//! # let key = zeroize::Zeroizing::new([7; 32]);
//! // `key` and its key_ID from the client's key manager
//! let psk = qkd::derive_psk(&key, "5fa1", "sae-robot", "sae-base", Cipher::default())?;
//! assert_eq!(psk.identity(), b"axon-qkd-v1:sae-robot:5fa1");
//!
//! let config = qkd::client_config(Arc::new(psk), PskKex::PskKe, b"my-protocol/1")?;
//! let conn = axon_tls::rustls_axon::ClientConnection::new(Arc::new(config), "base".try_into()?)?;
//!
//! // what the server makes of it
//! let identity = PskIdentity::parse(b"axon-qkd-v1:sae-robot:5fa1")?;
//! assert_eq!((identity.client_sae(), identity.key_id()), ("sae-robot", "5fa1"));
//! # let _ = conn;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod derive;
mod identity;
mod imported;
#[cfg(test)]
mod recorded;

use std::sync::Arc;

use rustls_axon::ClientConfig;

pub use self::derive::derive_psk;
pub use self::identity::PskIdentity;
pub use self::imported::{ImportedIdentity, import_psk};
pub use crate::psk::{Psk, PskResolver, negotiated, server_config};
use crate::{Error, PskKex};

/// A client's configuration for one connection on `psk`, with one ALPN protocol, or none if `alpn`
/// is empty. The cipher is the one that the key was derived for.
///
/// [`psk::client_config()`](crate::psk::client_config) is the same for several keys.
pub fn client_config(psk: Arc<Psk>, kex: PskKex, alpn: &[u8]) -> Result<ClientConfig, Error> {
    crate::psk::client_config(vec![psk], kex, alpn)
}
