//! The bytes that AXON's processes tell each other by, one file a section of `docs/formats.md`. Nothing
//! else knows them. Plain data; every decoder bounds what it allocates.

pub mod beacon;
pub mod keys;
pub mod link;
pub mod session;
mod terms;

pub use terms::{Difference, Terms};
