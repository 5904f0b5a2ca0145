//! AXQKD001: an AEAD envelope for messages sealed under keys that two hosts share by key_ID, as a
//! QKD key manager (KME, ETSI GS QKD 014) hands them out.
//!
//! A key seals at most ten messages in one direction and is then gone. The receiver opens each of
//! them once. What this crate does not do is move bytes or keys: it has no I/O, no clock, no
//! threads and no async, so it serves a CAN gateway as well as a QUIC one. `docs/axqkd001.md` in
//! the repository specifies the format for other implementations, with test vectors.
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
//! - **No nonce repeats.** A [`Sealer`] owns its key and counts; a [`Slot`] is consumed by the one
//!   message it seals.
//! - **Nothing opens twice, or elsewhere.** Per key the [`Opener`] remembers each index it has
//!   opened. Kind, topic, sender, receiver and connection are all bound: a message moved to another
//!   place does not open there.
//! - **A refusal tells the sender nothing.** [`OpenError::Refused`] reads the same and does the
//!   same work whether the key was unknown or retired, the index replayed or the tag wrong.
//! - **Secrets are erased** on drop, are neither `Clone` nor `Debug`, and are not left behind by
//!   moves, since they live behind a pointer, nor on the stack by their derivation
//!   ([`KmeKey::derive`]). A [`Sealer`] or [`Opener`] prints names and counts. A key can stay in
//!   locked memory of the caller's: [`KmeKey::from_holder`]. Bytes of a key come out only through the
//!   trait [`ExposeSecret`](secrecy::ExposeSecret) of the crate [`secrecy`] and [`KmeKey::derive`].
//!
//! # Features
//!
//! `aws-lc-rs` (default) and `rust-crypto` choose the AEAD; see [`aead`]. Without `aws-lc-rs` the
//! crate is `no_std` and needs `alloc`. Every type is `Send + Sync`; sealing and opening take `&mut
//! self`.
//!
//! Nothing allocates while a message is sealed or opened; adding a key does, and with `aws-lc-rs`
//! the first refusal on a thread, for aws-lc's error queue.

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

/// Bytes of the authentication tag at the end of every envelope.
pub const TAG_LEN: usize = 16;

/// Compiles and runs the README's example.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
