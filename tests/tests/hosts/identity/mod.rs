//! Tests the identity of peers in `classic`: which are accepted, and changes while the daemons run.

use axon_transport::ids::DaemonId;

pub(crate) mod authority;
mod ca;
mod claims;
mod pinned;
mod replay;

/// Parses an id as status shows it.
fn daemon_id(text: &str) -> DaemonId {
    let byte = |at: usize| u8::from_str_radix(&text[2 * at..2 * at + 2], 16).unwrap();
    DaemonId(std::array::from_fn(byte))
}
