//! The messages between sessions and their daemon (`docs/formats.md`). No other module accesses the bytes.
//! Plain data; every decoder limits its allocations.

pub mod session;
