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
//! let conn = rustls_axon::ClientConnection::new(Arc::new(config), "base".try_into()?)?;
//!
//! // what the server makes of it
//! let identity = PskIdentity::parse(b"axon-qkd-v1:sae-robot:5fa1")?;
//! assert_eq!((identity.client_sae(), identity.key_id()), ("sae-robot", "5fa1"));
//! # let _ = conn;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod config;
mod derive;
mod identity;
mod imported;
#[cfg(test)]
mod recorded;

pub use config::{PskResolver, client_config, negotiated, server_config};
pub use derive::{Psk, derive_psk};
pub use identity::PskIdentity;
pub use imported::{ImportedIdentity, import_psk};
