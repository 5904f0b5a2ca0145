//! The protocol between two daemons: frames of the control stream, what HELLO must agree on, the
//! order in which a connection becomes a link, and which of two connections stays.
//!
//! Plain data in, data out (`docs/formats.md`, section 6); the gateway owns the sockets.

mod close;
mod election;
mod frame;
mod hello;
mod message;
mod order;

pub use close::CloseCode;
pub use election::{Candidate, keep};
pub(crate) use frame::is_known;
pub use frame::{
    FrameError, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED, read_length, unpacked_length,
};
pub use hello::{Mismatch, PROTOCOL, check};
pub use message::{
    Asserted, Elected, Graph, GraphResync, Hello, LastSeen, LinkClosed, MAX_PROOFS, Message,
    Owners, Received, ReceivedOf, RouteReady, RouteRefused, Subscribe, Subscriber, Unsubscribe,
};
pub use order::{Order, OutOfOrder, Side};

#[cfg(test)]
mod tests;
