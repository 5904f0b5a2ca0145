//! The daemon: brings the sessions of one user and domain on this host together, and with those
//! on other hosts.
//!
//! The control plane (`registry`, `control`) runs on the calling thread. The gateway to other
//! hosts runs on a thread and runtime of its own; `gateway::bridge` is all they share. Samples between
//! processes of this host pass neither.

mod admission;
mod control;
mod conversation;
mod detach;
mod first;
mod gateway;
mod listen;
pub mod log;
mod relayed;
mod remote;
mod report;
mod run;
mod strangers;
mod topics;
mod turns;

pub use axon_shm::internal::ErasingHeap;
pub use detach::Report;
pub use gateway::GatewayEntry;
pub use run::{DaemonError, DaemonOptions, Start, main, run};
