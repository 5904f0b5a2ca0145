//! The events that an endpoint can report: the eleven events of ROS 2, their status counts, and the rules by which
//! deadlines and leases expire.
//!
//! This module does no I/O. The caller passes times as nanoseconds of one monotonic clock, and no function blocks. A
//! session's control thread feeds these state machines and passes their events to wait sets and callbacks.

pub(crate) mod alive;
mod deadline;
mod liveliness;
mod status;

pub(crate) use alive::Alive;
pub(crate) use deadline::Deadline;
pub(crate) use liveliness::{Lease, Liveness};
pub(crate) use status::Statuses;
pub use status::{
    CountStatus, EventKind, EventStatus, IncompatibleQos, LivelinessChanged, Matched,
};
