//! The protocol between two daemons: frames of the control stream, the terms that HELLO must agree on, the order in
//! which a connection becomes a link, and the choice between two connections.
//!
//! Plain data in, data out (`docs/formats.md`, section 6); the reactor owns the sockets.

mod election;
mod hello;
mod order;

pub(crate) use crate::wire::link::is_known;
pub use crate::wire::link::{
    AccessDecisions, CloseCode, DeniedUse, DeniedUses, Elected, FrameError, GraphResync,
    GraphUpdate, LastSeen, LinkAccessCheck, LinkClosed, LinkHello, LinkMessage, LivelinessAsserted,
    MAX_DENIED, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED, MAX_PROOFS, Owners, ReceiveLimits,
    ReceivedOf, ReceivedUpTo, RouteReady, RouteRefused, RouteSubscriber, RouteUnasked, Subscribe,
    Unsubscribe, UseDecision, read_length, unpacked_length,
};
pub use election::{Candidate, new_wins};
pub use hello::{PROTOCOL, TermMismatch, check};
pub use order::{MessageOrder, OutOfOrder, Side};

#[cfg(test)]
mod tests;
