//! The messages between two daemons on the control stream of a link (`docs/formats.md`, section 6).

mod close;
mod frame;
mod message;
#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;

pub use close::CloseCode;
pub(crate) use frame::is_known;
pub use frame::{
    FrameError, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED, read_length, unpacked_length,
};
pub use message::{
    AccessDecisions, DeniedUse, DeniedUses, Elected, GraphResync, GraphUpdate, LastSeen,
    LinkAccessCheck, LinkClosed, LinkHello, LinkMessage, LivelinessAsserted, MAX_DENIED,
    MAX_PROOFS, Owners, ReceiveLimits, ReceivedOf, ReceivedUpTo, RouteReady, RouteRefused,
    RouteSubscriber, RouteUnasked, Subscribe, Unsubscribe, UseDecision,
};
