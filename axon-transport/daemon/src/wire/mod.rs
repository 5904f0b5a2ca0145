//! The encodings of messages between daemons, and of beacons. One file a section of `docs/formats.md`, and no
//! other module knows the bytes. Plain data; every decoder bounds what it allocates. The messages between
//! sessions and their daemon are `axon-transport`'s.

pub mod beacon;
pub mod keys;
pub mod link;
mod terms;

pub use terms::{Difference, Terms};
