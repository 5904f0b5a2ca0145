#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]

mod control;
mod discovery;
mod files;
mod gateway;
mod keys;
mod link;
mod owner;
#[cfg(test)]
mod residue;
mod wire;

pub use axon_shm::internal::ErasingHeap;
pub use control::{DaemonError, DaemonOptions, Report, Start, log, main, run};
pub use gateway::{GatewayError, check};

/// What the other crates of AXON and its tests use of this one. It is not part of its interface, and changes
/// with any release.
#[doc(hidden)]
pub mod internal {
    pub use crate::{
        control::GatewayEntry,
        discovery::{quic_ports, shared_group},
        gateway::{Refusal, RefusedBy, attempt, bridge},
    };

    /// Keys and the KME.
    pub mod keys {
        pub use crate::keys::*;
    }
    /// The protocol between two daemons.
    pub mod link {
        pub use crate::link::*;
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
