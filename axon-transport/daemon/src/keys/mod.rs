//! KME keys: their source, the permitted use of each key, and its end.
//!
//! [`bootstrap`] gives a link its first key (the TLS external PSK), [`verifier`] proves the client's name over it,
//! and [`supply`] provides `messages10` with envelope keys. They are state machines (`docs/architecture.md`):
//! `poll_request` returns the next request to the KME, and `handle_answer` takes the [`Answer`]. Only [`kme`] talks
//! to the KME. Every `now` is the engine's time. [`bootstrap::Acceptor`] reads it from a [`Clock`].

#![forbid(unsafe_code)]

pub mod bootstrap;
mod clock;
mod exporters;
mod fetch;
pub mod kme;
pub mod proof;
pub mod request;
pub mod supply;
mod used;
pub mod verifier;

pub use crate::wire::keys::{KeyMessage, KeyViolation, MessageError};
pub use bootstrap::{
    Acceptor, BootstrapDialler, Completion, DialDecision, DialKey, DialRefusal, Lookup, Resolver,
};
pub use clock::Clock;
pub use exporters::{ENVELOPE_EXPORTER, Exporters, READY_EXPORTER};
pub use kme::{Events, Kme, KmeAnswer, KmeError, RequestOrigin, Statistics};
pub use request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure, Stock};
pub use supply::{Disagreement, KeyReceiver, KeySender, NoKey, SupplyError};
pub use used::{UsedKeys, UsedStatistics};
pub use verifier::{ClientProof, ProofFailure, ProofResponder, ProofState};
