//! AXQKD001: an AEAD envelope for messages. Its keys are shared by two hosts and identified by key_IDs, as a QKD key
//! manager (KME, ETSI GS QKD 014) delivers them.
//!
//! A key seals at most ten messages in one direction, and is then erased. The receiver opens each message once. This
//! crate does not transport bytes or keys: it has no I/O, no clock, no threads and no async. It can therefore serve a
//! CAN gateway as well as a QUIC one. `docs/axqkd001.md` in the repository specifies the format for other
//! implementations, with test vectors.
//!
//! # Example
//!
//! ```
//! use axon_envelope::{Channel, Delivery, KeyId, Kind, KmeKey, Opener, Route, Sealer, TopicHash};
//! use std::time::Instant;
//!
//! // Both ends know who talks to whom, and a value that is new with every connection (AXON takes
//! // a TLS exporter). Their key managers gave both the same 256 bits under the same key_ID.
//! let channel = Channel::new("robot-a", "robot-b", [7; 32])?;
//! let key_id = KeyId::new("bc490419-7d60-487f-adc1-4ddcc177c139")?;
//! let mut sealer = Sealer::new(&channel, key_id.clone(), KmeKey::take(&mut [0x42; 32]))?;
//! let mut opener = Opener::new(channel)?;
//! opener.add_key(key_id, KmeKey::take(&mut [0x42; 32]))?;
//!
//! let start = Instant::now(); // the crate has no clock: time is what the caller says it is
//! let topic = TopicHash::new(0, "/scan", "sensor_msgs/msg/LaserScan")?;
//! let route = Route { kind: Kind::Topic, topic };
//!
//! let mut envelope = vec![0; sealer.overhead() + 5];
//! let slot = sealer.slot(start.elapsed(), Delivery::Reliable)?;
//! assert_eq!(slot.seal_into(route, &[b"hello"], &mut envelope)?, envelope.len());
//! let copy = envelope.clone();
//!
//! assert_eq!(opener.open_in_place(start.elapsed(), route, &mut envelope)?, b"hello");
//! // The same bytes never open again.
//! assert!(opener.open_into(start.elapsed(), route, &copy, &mut [0; 5]).is_err());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # What is guaranteed
//!
//! - **No nonce repeats.** A [`Sealer`] owns its key and counts messages; a [`Slot`] is consumed by the one message
//!   that it seals.
//! - **No message opens twice, or elsewhere.** For each key the [`Opener`] records each index that it has opened. An
//!   envelope is bound to its kind, topic, sender, receiver and connection: a message that is moved to another place
//!   does not open there.
//! - **A refusal tells the sender nothing.** [`OpenError::Refused`] has the same text and does the same work whether
//!   the key was unknown or retired, the index was replayed, or the tag was wrong.
//! - **Secrets are erased** on drop, and are neither `Clone` nor `Debug`. Moves leave no copies, because secrets are
//!   behind a pointer. Their derivation leaves nothing on the stack ([`KmeKey::derive`]). The `Debug` output of a
//!   [`Sealer`] or [`Opener`] shows names and counts. A key can stay in the caller's locked memory:
//!   [`KmeKey::from_holder`]. Bytes of a key are accessible only through the trait
//!   [`ExposeSecret`](secrecy::ExposeSecret) of the crate [`secrecy`] and through [`KmeKey::derive`].
//!
//! # Features
//!
//! `aws-lc-rs` (default) and `rust-crypto` choose the AEAD; see [`aead`]. Without `aws-lc-rs` the crate is `no_std` and
//! needs `alloc`. Every type is `Send + Sync`; sealing and opening take `&mut self`.
//!
//! Sealing and opening a message allocate nothing. Adding a key allocates. With `aws-lc-rs` the first refusal on a
//! thread allocates as well, for aws-lc's error queue.

#![forbid(unsafe_code)]
#![no_std]
#![cfg_attr(docsrs, feature(doc_cfg))]

extern crate alloc;

#[cfg(not(any(feature = "aws-lc-rs", feature = "rust-crypto")))]
compile_error!("axon-envelope needs an AEAD: enable the feature `aws-lc-rs` or `rust-crypto`");

pub mod aead;
mod channel;
mod erase;
mod header;
pub mod inner;
mod key;
mod mask;
mod open;
mod rotate;
mod route;
mod seal;

pub use aead::DefaultAead;
pub use channel::{Channel, ChannelError, IdError, KeyId, MAX_CONTEXT_LEN, MAX_ID_LEN};
pub use header::{Header, HeaderError, MAGIC, MAX_HEADER_LEN, MIN_HEADER_LEN, NONCE_LEN};
pub use key::{KeyLength, KmeKey, RandomError};
pub use mask::{Delivery, IndexMask, MESSAGES_PER_KEY};
pub use open::{
    AddKeyError, Expired, Limits, OpenError, Opener, Refusal, RefusalCause, RetireError,
    RetireOutcome,
};
pub use rotate::{KeySource, RotateError, RotatingSealer};
pub use route::{Kind, NameTooLong, Route, TopicHash};
pub use seal::{KEY_MAX_AGE, MAX_PLAINTEXT_LEN, Retirement, SealError, Sealer, Slot, Spent};
pub use secrecy;

/// The length of the authentication tag at the end of every envelope.
pub const TAG_LEN: usize = 16;

/// Compiles and runs the README's example.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
