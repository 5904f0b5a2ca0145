//! The gateway: QUIC links to other hosts' daemons and the samples that cross them.
//!
//! It is one more session of its daemon: relays read the rings of local publishers, stand-ins write
//! rings for remote ones. It runs on a thread and runtime of its own, so that its faults and stalls
//! are not the control plane's (`docs/architecture.md`). [`attempt`] makes single links by hand,
//! for tools that try what a daemon refuses.

pub mod attempt;

mod accept;
mod account;
pub mod bridge;
mod check;
mod context;
pub(crate) mod control;
mod counters;
pub(crate) mod dial;
mod endpoint;
mod error;
pub(crate) mod establish;
mod frames;
mod hub;
mod identity;
mod inbound;
mod intake;
pub(crate) mod keyring;
mod outbound;
mod pace;
mod peer;
mod pieces;
#[cfg(test)]
mod played;
mod protection;
pub(crate) mod prove;
mod queue;
mod queue_budget;
mod receipts;
mod refusal;
mod ring_wakeups;
mod routes;
mod routes_in;
mod run;
mod shares;
mod silence;
mod socket;
mod stalls;
mod stand_in;
mod status;
pub(crate) mod tls_settings;
pub(crate) mod watch;

pub use check::check;
pub(crate) use endpoint::EndpointError;
pub use error::GatewayError;
pub use refusal::{Refusal, RefusedBy};
pub(crate) use run::run;
