//! The states from a dial, or an incoming handshake, to a link that awaits its election.

pub(crate) mod dialling;
pub(crate) mod failure;
pub(crate) mod opening;
mod proving;
pub(crate) mod target;
