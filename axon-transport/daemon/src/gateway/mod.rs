//! The gateway: QUIC links to other hosts' daemons and the samples that cross them.
//!
//! It is one more session of its daemon: relays read the rings of local publishers, stand-ins write
//! rings for remote ones. It runs on a thread and runtime of its own, so that its faults and stalls
//! are not the control plane's (`docs/architecture.md`).

// The engine and the reactor replace it. What they do not use goes.
#![allow(dead_code, private_interfaces)]

pub(crate) mod accept;
pub(crate) mod account;
pub mod bridge;
mod check;
pub(crate) mod context;
pub(crate) mod control;
pub(crate) mod counters;
pub(crate) mod dial;
pub(crate) mod endpoint;
pub(crate) mod error;
pub(crate) mod establish;
pub(crate) mod frames;
pub(crate) mod hub;
pub(crate) mod identity;
pub(crate) mod inbound;
pub(crate) mod intake;
pub(crate) mod keyring;
mod outbound;
pub(crate) mod pace;
pub(crate) mod peer;
mod pieces;
#[cfg(test)]
mod played;
pub(crate) mod protection;
pub(crate) mod prove;
pub(crate) mod queue;
mod queue_budget;
mod receipts;
pub(crate) mod refusal;
mod ring_wakeups;
pub(crate) mod routes;
mod routes_in;
mod run;
pub(crate) mod shares;
pub(crate) mod silence;
pub(crate) mod socket;
pub(crate) mod stalls;
mod stand_in;
pub(crate) mod status;
pub(crate) mod tls_settings;
pub(crate) mod watch;

pub use check::check;
pub(crate) use endpoint::EndpointError;
pub use error::GatewayError;
pub use refusal::{Refusal, RefusedBy};
