//! Connections on a pre-shared key that is derived from a QKD key.
//!
//! Both ends have the same 256-bit key and its key_ID from their key managers (KMEs). The client must be the end that
//! called `enc_keys`. TLS does not use the key itself but the result of [`derive_psk()`]. It binds the key to the names
//! of client and server in their roles, so that a handshake cannot be reflected (RFC 9257 section 4.1). The identity
//! that the client sends, [`PskIdentity`], tells the server whose key it is, and which key to request from its KME.
//!
//! One key is for one connection.
//!
//! A peer that is not AXON, and does not implement that derivation, may implement the importer of RFC 9258 instead.
//! [`import_psk()`] makes the same kind of [`Psk`] in that way, with the same binding to both names. The server parses
//! the identity with [`ImportedIdentity`]. A server for both kinds of clients examines the first byte of an identity,
//! which is `a` in one form and 0 in the other. Use [`derive_psk()`] if both ends use this crate: its identity is
//! printable, and AXON's daemons use no other. A key is used in one form, never in both.
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

/// Makes a client's configuration for one connection on `psk`. It has one ALPN protocol, or none if `alpn` is empty.
/// The cipher is the one for which the key was derived.
///
/// [`psk::client_config()`](crate::psk::client_config) does the same for several keys.
pub fn client_config(psk: Arc<Psk>, kex: PskKex, alpn: &[u8]) -> Result<ClientConfig, Error> {
    crate::psk::client_config(vec![psk], kex, alpn)
}
