//! The session's side of its conversation with the daemon: where the daemon is, how it is started, the
//! socket between them, and the thread that keeps up the conversation.

pub mod address;
pub mod connect;
pub(super) mod control;
pub mod socket;
pub mod spawn;
mod status;

pub use status::{daemon_status, daemon_status_at};
