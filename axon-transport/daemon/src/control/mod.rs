//! The control plane: matches the sessions of one user and domain on this host with each other, and with
//! sessions on other hosts.
//!
//! It runs on the thread that calls [`run`]. The gateway to other hosts has a thread and a runtime of its
//! own. The two threads share only `bridge`. Samples between processes of this host pass through neither.

mod admission;
mod daemonize;
mod descriptors;
mod gateway;
mod handshake;
mod listen;
pub mod log;
mod losses;
mod pending;
mod plane;
mod relayed;
mod reload;
mod remote;
mod report;
mod run;
mod scheduler;
mod session_connection;

pub use gateway::GatewayEntry;
pub use run::{DaemonError, DaemonOptions, Start, main, run};
