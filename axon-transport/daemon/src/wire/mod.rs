//! The encodings of messages between daemons, and of beacons. Each file covers one section of `docs/formats.md`, and
//! no other module accesses the bytes. Plain data; every decoder limits its allocations. The messages between
//! sessions and their daemon are in `axon-transport`.

pub mod beacon;
pub mod keys;
pub mod link;
mod terms;

pub use terms::{Difference, SecurityTerms};
