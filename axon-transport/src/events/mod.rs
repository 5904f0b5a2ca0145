//! What an endpoint can report of itself: the eleven events of ROS 2, their status counts, and the
//! rules by which deadlines and leases run out.
//!
//! Plain data: time comes in as nanoseconds of one monotonic clock, and nothing is waited for.
//! A session's control thread feeds these, and hands what is new to wait sets and callbacks.

pub(crate) mod alive;
mod deadline;
mod liveliness;
mod status;

pub(crate) use alive::Alive;
pub use deadline::Deadline;
pub use liveliness::{Lease, Liveness};
pub use status::{
    Counted, EventKind, EventStatus, IncompatibleQos, LivelinessChanged, Matched, Statuses,
};
