//! The encodings of messages: between sessions and their daemon, between daemons, and of beacons. One file a
//! section of `docs/formats.md`, and no other module knows the bytes. Plain data; every decoder bounds what
//! it allocates.

pub mod beacon;
pub mod keys;
pub mod link;
pub mod session;
mod terms;

pub use terms::{Difference, Terms};
