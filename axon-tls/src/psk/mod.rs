//! Connections on an external pre-shared key: any secret that both ends have, with any identity.
//!
//! The key authenticates both ends (RFC 8446 section 2.2). There are no certificates, and a connection completes on one
//! of the configured keys or fails. [`crate::qkd`] derives such keys from those of a quantum key distribution system.
//! With [`Psk::new()`] they can come from any source, for example a provisioning step or a hardware token.
//!
//! ```
//! use std::sync::Arc;
//!
//! use axon_tls::psk::{self, Psk, PskTable};
//! use axon_tls::secrecy::SecretSlice;
//! use axon_tls::{Cipher, PskKex, rustls_axon};
//!
//! # fn secret() -> SecretSlice<u8> { vec![7; 32].into() }
//! let cipher = Cipher::default();
//! let client = psk::client_config(
//!     vec![Arc::new(Psk::new("robot-7 to base, 2026", secret(), cipher)?)],
//!     PskKex::PskDheKe,
//!     b"my-protocol/1",
//! )?;
//! let known = PskTable::new([Arc::new(Psk::new("robot-7 to base, 2026", secret(), cipher)?)])?;
//! let server = psk::server_config(Arc::new(known), cipher, PskKex::PskDheKe, b"my-protocol/1")?;
//!
//! let client = rustls_axon::ClientConnection::new(Arc::new(client), "base".try_into()?)?;
//! let server = rustls_axon::ServerConnection::new(Arc::new(server))?;
//! # let _ = (client, server);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! For QUIC, use `quic::psk_client()` and `quic::psk_server()` with the feature `quic`. For any byte stream of tokio,
//! use the module `stream` with the feature `tokio`.
//!
//! # Security
//!
//! - A key must have at least 128 bits of entropy. A password is open to an offline dictionary attack.
//! - A key is for one client and one server, in these roles. If both ends accept each other's connections on the same
//!   key, an attacker can reflect a handshake (Selfie, RFC 9257 section 4.1). Give each direction its own key, as
//!   [`derive_psk()`](crate::qkd::derive_psk) does, or import the key with a context that names the roles (RFC 9258,
//!   [`ImportedPsk`](rustls_axon::external_psk::ImportedPsk)).
//! - [`PskKex::PskKe`](crate::PskKex::PskKe) has no forward secrecy. Use a key for one connection, or use
//!   [`PskKex::PskDheKe`](crate::PskKex::PskDheKe).
//! - The identity is sent in the clear, and anyone who saw it can send it. A look-up therefore consumes nothing. A key
//!   is consumed when [`negotiated()`] of the connection is `Some`.

pub(crate) mod config;
mod key;
mod table;

pub use config::{PskResolver, client_config, negotiated, server_config};
pub use key::Psk;
pub use table::PskTable;
