#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]

pub mod access;
pub mod config;
pub mod events;
mod ffi;
pub mod graph;
mod log_limit;
mod registry;
mod secrets;
mod session;
mod session_key;
#[cfg(feature = "sros2")]
pub mod sros2;
pub mod status;
mod text;
mod wire;

pub use axon_shm as shm;
#[doc(inline)]
pub use axon_shm::{ids, qos};
pub use session::{
    CallError, Client, DaemonCommand, EndpointSpec, Event, GuardCondition, Lifetime, Loan,
    MessageInfo, Messages, NewDataCallback, Node, Publisher, Ready, RecvError, Server, Session,
    SessionError, SessionEvent, SessionOptions, Subscription, TrustedSubscription, Waitable,
    daemon_check_access_at, daemon_reload_at, daemon_status, daemon_status_at,
};

/// The items of this crate that the other crates of AXON and its tests use. They are not part of its interface, and
/// change with any release.
#[doc(hidden)]
pub mod internal {
    pub use crate::session_key::{OWNER, SessionKey, session_id};

    /// The names that ROS 2 gives to the parts of actions and to the services of parameters.
    pub mod access {
        pub use crate::access::ros::{
            ACTION_SERVICES, ACTION_TOPICS, LIFECYCLE_SERVICES, LIFECYCLE_TOPIC, PARAMETER_EVENTS,
            PARAMETER_SERVICES,
        };
    }
    /// Access rules in a file that somebody names.
    pub mod config {
        pub use crate::config::rules_file::parse as parse_rules_file;
    }
    /// The functions that `include/axon.h` declares, for crates that build libraries from them.
    pub mod ffi {
        pub use crate::ffi::*;
    }
    /// Leases of publishers.
    pub mod events {
        pub use crate::events::alive::Alive;
    }
    /// The endpoints that may match, and the hosts on which they may.
    pub mod graph {
        pub use crate::graph::{
            access::{other_end, permits, permits_use, shows, verb_of},
            endpoint::{LIMITS, Limits},
            pairing::{Pairing, pairing, reads, writes},
            range::{EndpointRange, OutOfRange, RangeToHost, RemoteEndpoint, Scope, out_of_range},
            view::reach_of,
        };
    }
    /// Log lines at a bounded rate.
    pub mod log_limit {
        pub use crate::log_limit::*;
    }
    /// Sessions and endpoints, and which of them match.
    pub mod registry {
        pub use crate::registry::*;
    }
    /// Keys in locked memory.
    pub mod secrets {
        pub use crate::secrets::*;
    }
    /// The parts of a session.
    pub mod session {
        pub use crate::session::*;
    }
    /// Documents of SROS2, for tools.
    #[cfg(feature = "sros2")]
    pub mod sros2 {
        pub use crate::sros2::expression::Expression;

        /// The content of a permissions file.
        pub mod document {
            pub use crate::sros2::document::*;
        }
        /// Topics of DDS.
        pub mod names {
            pub use crate::sros2::names::*;
        }
        /// The text in a signed file.
        pub mod signed {
            pub use crate::sros2::signed::*;
        }
        /// XML of limited size.
        pub mod xml {
            pub use crate::sros2::xml::*;
        }
    }
    /// Text from outside.
    pub mod text {
        pub use crate::text::*;
    }
    /// The messages between sessions and their daemon.
    pub mod wire {
        pub use crate::wire::*;
    }
}
