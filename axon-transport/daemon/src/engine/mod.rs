//! The engine: links, flows and their scheduling, as one state machine without I/O.

#![forbid(unsafe_code)]

pub(crate) mod connection;
pub(crate) mod control;
pub(crate) mod credentials;
pub(crate) mod endpoints;
pub(crate) mod inbound;
pub(crate) mod keyring;
pub(crate) mod link;
pub(crate) mod links;
pub(crate) mod outbound;
pub(crate) mod peer;
pub(crate) mod protection;
pub(crate) mod rings;
pub(crate) mod stand_in;
