//! The session's side of the protocol with the daemon: the daemon's address, its start, the socket to it, and the
//! thread that exchanges messages with it.

pub mod address;
pub mod connect;
pub(super) mod control;
pub(super) mod memory_changes;
pub mod socket;
pub mod spawn;
mod status;
pub(super) mod status_text;

pub use status::{daemon_check_access_at, daemon_reload_at, daemon_status, daemon_status_at};
