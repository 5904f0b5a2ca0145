//! TLS 1.3 and QUIC connections that cannot fall back to a classical-only key exchange.
//!
//! Two ways to agree on keys, and no third:
//!
//! - [`hybrid`]: the group X25519MLKEM768 alone, on [rustls](https://docs.rs/rustls) as released.
//!   Who the peer is, is chosen with [`identity::Auth`].
//! - [`qkd`]: an external pre-shared key made from a key that a quantum key distribution system
//!   gave to both ends, on `rustls-axon`. The key authenticates both ends; there are no
//!   certificates.
//!
//! Both offer exactly one 256-bit [`Cipher`] and TLS 1.3 alone, have no tickets, no early data and
//! no key log, and refuse whatever else the peer proposes. With the feature `quic` the same
//! configurations are there for [quinn](https://docs.rs/quinn), in the module `quic`.
//!
//! After the handshake [`Negotiated`] says what was agreed, read from the connection and not from
//! the configuration.
//!
//! # Example
//!
//! A provider for your own rustls configuration:
//!
//! ```
//! let provider = std::sync::Arc::new(axon_tls::hybrid::provider());
//! let builder = rustls::ClientConfig::builder_with_provider(provider)
//!     .with_protocol_versions(&[&rustls::version::TLS13])?;
//! # let _ = builder;
//! # Ok::<(), rustls::Error>(())
//! ```
#![forbid(unsafe_code)]

mod erase;
mod error;
pub mod hybrid;
pub mod identity;
mod negotiated;
pub mod qkd;
#[cfg(feature = "quic")]
pub mod quic;

// For AXON's own crates; not part of the interface.
#[doc(hidden)]
pub use erase::erasing;
pub use error::{CaPart, Error};
pub use negotiated::{Cipher, KeyExchange, Negotiated, PskKex, UnknownName};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
