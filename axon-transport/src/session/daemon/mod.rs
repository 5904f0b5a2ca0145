//! The connection to a daemon: its address, its start, the socket to it, and requests that use a connection of their
//! own.

pub mod address;
pub mod connect;
pub mod socket;
pub mod spawn;
pub(super) mod status;
pub(super) mod status_text;

pub use status::{daemon_check_access_at, daemon_reload_at, daemon_status, daemon_status_at};
