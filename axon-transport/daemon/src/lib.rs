#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]

mod async_fd;
mod attempt;
mod bridge;
mod check;
mod control;
mod daemon_key;
mod discovery;
mod engine;
mod error;
mod files;
mod identity;
mod keys;
mod link;
mod owner;
mod reactor;
#[cfg(test)]
mod residue;
mod token_bucket;
mod wire;

/// The system's allocator, which in a daemon erases each block of at most 64 KiB before it is freed, and when it
/// grows into another one.
///
/// The libraries of the KME client copy keys into buffers that they free as they are. A program that can be the
/// daemon makes this its global allocator:
///
/// ```
/// #[global_allocator]
/// static HEAP: axon_daemon::ErasingHeap = axon_daemon::ErasingHeap;
/// ```
///
/// It erases nothing until [`run`] or [`main`] is called, so the program's other commands pay for one load.
#[doc(inline)]
pub use axon_shm::internal::ErasingHeap;
pub use check::check;
pub use control::{DaemonError, DaemonOptions, Start, log, main, run};
pub use error::{EndpointError, GatewayError};
pub use keys::KmeError;

/// The items of this crate that the other crates of AXON and its tests use. They are not part of its interface, and
/// change with any release.
#[doc(hidden)]
pub mod internal {
    pub use crate::{
        control::GatewayEntry,
        discovery::{quic_ports, shared_group},
        engine::refusal::{Refusal, RefusedBy},
    };

    /// Single links made by hand.
    pub mod attempt {
        pub use crate::attempt::*;
    }

    /// The messages between the control plane and the reactor.
    pub mod bridge {
        pub use crate::bridge::*;
    }
    /// Keys and the KME.
    pub mod keys {
        pub use crate::keys::*;
    }
    /// The protocol between two daemons.
    pub mod link {
        pub use crate::link::*;
    }
    /// The key of which a daemon's id is made.
    pub mod daemon_key {
        pub use crate::daemon_key::*;
    }
    /// Which daemon a session belongs to.
    pub mod owner {
        pub use crate::owner::*;
    }
    /// The bytes between daemons.
    pub mod wire {
        pub use crate::wire::*;
    }
}
