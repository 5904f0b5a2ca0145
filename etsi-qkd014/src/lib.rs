//! A client for [ETSI GS QKD 014 V1.1.1], the REST interface through which a key manager of quantum key distribution
//! (QKD) hands out keys.
//!
//! A *KME* (key management entity) serves keys. An *SAE* (secure application entity) is the
//! program that uses them. The *master* SAE draws fresh keys with [`Client::enc_keys`] and tells
//! the *slave* SAE their key_IDs by any means; the slave draws the same keys from its own KME with
//! [`Client::dec_keys`]. A KME gives each key once.
//!
//! ```no_run
//! # async fn example() -> Result<(), etsi_qkd014::Error> {
//! use etsi_qkd014::{Client, secrecy::ExposeSecret};
//!
//! let client = Client::builder()
//!     .kme_url("https://kme-a.example:8443")
//!     .ca_file("ca.pem")
//!     .sae_cert_file("sae-a.crt")
//!     .sae_key_file("sae-a.key")
//!     .build()?;
//! let key = client.enc_keys("sae-b").size(256).send().await?.into_single();
//! println!("tell sae-b: {}", key.key_id());
//! let secret: &[u8] = key.expose_secret();
//! # let _ = secret; Ok(())
//! # }
//! ```
//!
//! # What it guarantees
//!
//! - **Mutual TLS, and only the CA you name.** The system's roots are never used, and redirects and proxies from the
//!   environment are never followed. TLS 1.3 and 1.2; X25519MLKEM768 is preferred if the KME supports it.
//! - **Secrets are zeroized.** A [`Key`] cannot be cloned or printed, and compares in constant time. Its bytes are
//!   accessible only through the trait [`ExposeSecret`](secrecy::ExposeSecret) of [`secrecy`], [`Key::expose_array`]
//!   and [`Key::into_secret`]. See [Secrets](#secrets) for what the crate can and cannot erase.
//! - **The KME's answers are checked.** Each check names the clause that it comes from ([`Error::Check`]). Deviations
//!   of real KMEs are tolerated only by name: [`Quirks`].
//! - **Keys are not lost silently.** A call that is cut off after its request may have left reports that:
//!   [`Error::KeyPossiblyConsumed`]. Only a [`RetryPolicy`] repeats a call.
//!
//! # Secrets
//!
//! The following is zeroized when it is dropped, whether by success, error, timeout or cancellation: the assembled
//! answer body and each block that it outgrew, the base64 text taken from it, the decoded key, all keys of a pool, and
//! the SAE's private key as read from bytes or file, PEM or DER. The chunks from hyper are cleared, with all the memory
//! that contains them, as soon as hyper reads into other memory.
//!
//! The following is freed with key bytes in it, because nothing outside rustls can reach it:
//!
//! - `rustls::msgs::deframer::buffers::DeframerVecBuffer::read`: records from the socket, deciphered in place; freed
//!   when the buffer grows and when the connection ends;
//! - `rustls::msgs::base::Payload::into_vec`: the plaintext of a record, freed after it was read.
//!
//! If the runtime has several threads, hyper's last read buffer (`Buffered::poll_read_from_io`) may also be, if its
//! connection does not read on before the call ends.
//!
//! A test with an allocator that keeps and searches freed memory checks this list, for `enc_keys` and `dec_keys`, on
//! success, failed check, malformed answer, refusal with keys in its body, cut-off, timeout and cancellation. It does
//! not see the stack, registers, memory that C code allocates (aws-lc holds the private key), or swap.
//!
//! The crate does not treat a KME's extensions and error details as secrets. A program that must leave no secret in
//! freed memory needs a global allocator that zeroizes on free, which covers the rest, and should disable core dumps.
//!
//! # Features
//!
//! - `blocking`: `blocking::Client`, which needs no async runtime of the program.
//! - `pool`: `KeyPool`, which draws keys for a peer in advance and hands each out once, and its ledger.
//! - `sim`: the module `sim` with KMEs in process for tests, and the binary `kme-sim`.
//!
//! [ETSI GS QKD 014 V1.1.1]: https://www.etsi.org/deliver/etsi_gs/QKD/001_099/014/01.01.01_60/gs_qkd014v010101p.pdf

#![forbid(unsafe_code)]
#![cfg_attr(docsrs, feature(doc_cfg))]

#[cfg(feature = "blocking")]
pub mod blocking;
mod builder;
mod client;
mod error;
mod exchange;
#[doc(hidden)]
pub mod fuzzing;
mod key;
mod parse;
mod pem;
#[cfg(feature = "pool")]
pub mod pool;
mod quirks;
mod request;
mod retry;
mod secret;
#[cfg(feature = "sim")]
pub mod sim;
mod status;
mod subject;
mod tls;

pub use builder::ClientBuilder;
pub use client::Client;
pub use error::{Error, RefusedBy};
pub use key::{Key, KeyContainer};
#[cfg(feature = "pool")]
pub use pool::KeyPool;
pub use quirks::Quirks;
pub use request::{DecKeys, EncKeys};
pub use retry::RetryPolicy;
pub use secrecy;
pub use status::Status;

/// Compiles the README's example as a doc test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
