//! The messages between sessions and their daemon (`docs/formats.md`). No other module knows the bytes.
//! Plain data; every decoder bounds what it allocates.

pub mod session;
