//! TLS 1.3 and QUIC connections that cannot fall back to a classical-only key exchange.
//!
//! There are two ways to agree on keys:
//!
//! - `hybrid`: only the group X25519MLKEM768, on the released [rustls](https://docs.rs/rustls). `identity::Auth`, or
//!   the caller's own rustls configuration, chooses the authentication of the peer.
//! - [`psk`]: an external pre-shared key, on [`rustls_axon`]. The key authenticates both ends; there are no
//!   certificates. [`qkd`] derives the key from one that a quantum key distribution system gave to both ends.
//!
//! Both offer only 256-bit [`Cipher`]s and TLS 1.3, and refuse all other proposals of the peer. The configurations that
//! this crate makes have one cipher, no tickets, no early data and no key log.
//!
//! After the handshake [`Negotiated`] tells what was negotiated. It is read from the connection and not from the
//! configuration.
//!
//! # Features
//!
//! - `hybrid` (default): the modules `hybrid` and `identity`, on stock rustls, re-exported as `rustls`.
//! - `quic`: both modes for [quinn](https://docs.rs/quinn), in the module `quic`, with `quinn` re-exported.
//! - `tokio`: connections of rustls-axon over byte streams of tokio, in the module `stream`. For connections of stock
//!   rustls use [tokio-rustls](https://docs.rs/tokio-rustls).
//!
//! # Example
//!
//! This is a configuration of rustls for a client that verifies servers by their certificates:
//!
//! ```
//! # #[cfg(feature = "hybrid")] {
//! use axon_tls::{hybrid, rustls};
//!
//! let config = hybrid::client_builder()
//!     .with_root_certificates(rustls::RootCertStore::empty()) // yours
//!     .with_no_client_auth();
//! # let _ = config; }
//! ```
#![forbid(unsafe_code)]

mod erase;
mod error;
#[cfg(feature = "hybrid")]
pub mod hybrid;
#[cfg(feature = "hybrid")]
pub mod identity;
mod negotiated;
pub mod psk;
pub mod qkd;
#[cfg(feature = "quic")]
pub mod quic;
#[cfg(feature = "tokio")]
pub mod stream;

#[cfg(feature = "quic")]
pub use quinn;
#[cfg(feature = "hybrid")]
pub use rustls;
#[cfg(feature = "tokio")]
pub use tokio;
pub use {rustls_axon, secrecy, zeroize};

// For AXON's own crates; not part of the interface.
#[doc(hidden)]
pub use erase::erasing;
pub use error::{CaPart, Error};
pub use negotiated::{Cipher, KeyExchange, Negotiated, PskKex, UnknownName};

#[cfg(all(doctest, feature = "hybrid", feature = "quic", feature = "tokio"))]
#[doc = include_str!("../README.md")]
struct Readme;
