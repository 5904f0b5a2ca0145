//! KME keys: where they come from, what each of them may be used for, and when they end.
//!
//! [`bootstrap`] gives a link its first key (the TLS external PSK), [`verifier`] proves the
//! client's name over it, [`supply`] keeps `messages10` in envelope keys. They are state machines
//! (`docs/architecture.md`): `poll_request` gives what is to be asked of the KME, `handle_answer` takes
//! the [`Answer`]. [`kme`] alone talks to the KME. Every `now` is the time of the daemon's one
//! [`Clock`].

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

pub use crate::wire::keys::{KeyMessage, MessageError, Violation};
pub use bootstrap::{Acceptor, Attempt, Completion, Dial, DialRefusal, Dialler, Lookup, Resolver};
pub use clock::Clock;
pub use exporters::{ENVELOPE_EXPORTER, Exporters, READY_EXPORTER};
pub use kme::{Event, Events, Kme, KmeError, Origin, Statistics};
pub use request::{Answer, Failure, FailureKind, Fetched, Purpose, Request, Stock};
pub use supply::{Disagreement, NoKey, Receiver, Sender, SupplyError};
pub use used::{UsedKeys, UsedStatistics};
pub use verifier::{ClientProof, ProofFailure, ProofResponder, ProofState};
