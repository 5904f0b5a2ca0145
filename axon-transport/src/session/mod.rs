//! A process's access to AXON: publishers and subscriptions over shared memory, and the protocol with the daemon that
//! matches them.
//!
//! Samples never pass the daemon. The daemon announces readers and writers to each other and passes the descriptors
//! on. When the daemon dies, attached pairs continue. The control thread `axon-ctl` finds or starts another daemon
//! and repeats the announcements to it.

mod clock;
mod control;
mod core;
pub mod daemon;
mod endpoint_state;
mod endpoints;
mod error;
mod handle;
mod interface;
pub mod merge;
mod options;
mod relay_thread;
pub mod relayed;
mod state;
#[cfg(test)]
mod tests;

pub(crate) use self::endpoints::OwnedLoan;
pub use self::{
    clock::{from_unix_nanos, unix_nanos},
    core::{GuardCondition, SessionEvent},
    daemon::{daemon_check_access_at, daemon_reload_at, daemon_status, daemon_status_at},
    endpoint_state::{Lifetime, MessageInfo, NewDataCallback, TakeLimit},
    endpoints::{
        CallError, Client, Event, Loan, Messages, Publisher, RemoteWriter, Server, Subscription,
        TrustedSubscription, Written,
    },
    error::{RecvError, SessionError},
    handle::Session,
    interface::{Node, Ready, Waitable},
    options::{DaemonCommand, EndpointSpec, SessionOptions},
};
