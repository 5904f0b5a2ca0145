//! [rustls] with TLS 1.3 external pre-shared keys.
//!
//! This is rustls 0.23.46 with a small series of patches, under another name so that it can stand
//! beside the original. Everything rustls has is here and behaves as there; new is the module
//! [`external_psk`], with what it needs on the config builders and connections:
//!
//! ```no_run
//! use std::sync::Arc;
//!
//! use rustls_axon::crypto::{CryptoProvider, aws_lc_rs, hash::HashAlgorithm};
//! use rustls_axon::external_psk::{ExternalPsk, PskKeyExchangeMode};
//! use rustls_axon::zeroize::Zeroizing;
//! use rustls_axon::{ClientConfig, ClientConnection};
//!
//! # fn example(secret: Zeroizing<Vec<u8>>) -> Result<(), Box<dyn std::error::Error>> {
//! let psk = ExternalPsk::new("the key of today", secret, HashAlgorithm::SHA256)?;
//!
//! let provider = CryptoProvider { kx_groups: vec![], ..aws_lc_rs::default_provider() };
//! let config = ClientConfig::builder_with_provider(Arc::new(provider))
//!     .with_external_psks(vec![Arc::new(psk)], PskKeyExchangeMode::PskKe)?;
//!
//! let conn = ClientConnection::new(Arc::new(config), "example.com".try_into()?)?;
//! // ... after the handshake:
//! assert_eq!(conn.external_psk().unwrap().identity(), b"the key of today");
//! # Ok(())
//! # }
//! ```
//!
//! The other pages are rustls's own documentation, where `rustls::` stands for this crate.
//!
//! # Features
//!
//! - `aws_lc_rs` (default): the aws-lc-rs crypto provider.
//! - `std` (default): everything that needs `std`, QUIC and buffered connections among it.
//! - `logging`: messages through the `log` crate.
//! - `tls12`: TLS 1.2, for connections without an external PSK.
//!
//! [rustls]: https://docs.rs/rustls/0.23.46
#![no_std]
#![forbid(unsafe_code)]
// The code is rustls's: its lints are checked there, with its own settings and all of its features.
#![allow(warnings, clippy::all, rustdoc::all)]

/// The crate that secrets are handed over with.
#[doc(no_inline)]
pub use zeroize;

include!(concat!(env!("RUSTLS_AXON_SRC"), "/lib_body.rs"));
