//! Links, flows and keys as state machines without I/O (`docs/architecture.md`, "State machines").

#![forbid(unsafe_code)]

pub(crate) mod keyring;
pub(crate) mod link;
