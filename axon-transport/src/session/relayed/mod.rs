//! Sessions that share no memory: their samples pass through the daemon, over the session socket.
//!
//! The daemon treats such a session much like another host. In its own process a separate registry and gateway session
//! represent everything outside the process (`near`). Relays read the samples that the application publishes, and
//! stand-ins write the samples that it subscribes to. Everything else works as with shared memory. In the daemon
//! (axon-daemon's `control::relayed`) a session of the same id holds the application's endpoints, in memory that every
//! session can map. Other sessions, on this host and elsewhere, see an ordinary session. Clients and servers have
//! stand-ins and cross as topics do (`calls`). Liveliness is sent separately.
//!
//! [`flow`] is plain data: it splits samples into pieces and decides how many pieces each channel may send. `pipe`
//! moves the pieces over the socket (`docs/formats.md`, section 10).

use std::time::Duration;

pub mod calls;
pub mod flow;
pub mod pipe;
mod response_log;
pub(super) mod session_end;
mod unanswered;

pub use self::flow::ArrivalPool;
pub use super::core::ChangeSignal;

/// Maximum number of relayed sessions of one daemon. Each costs the daemon two threads and memory of its own.
pub const MAX_SESSIONS: usize = 32;
/// Maximum number of publishers, subscriptions, clients, and servers of a relayed session.
pub const MAX_ENDPOINTS: usize = 1024;
/// Maximum number of clients outside the process that a relayed session's servers answer. A client counts once for each
/// server.
pub const MAX_CALLERS: usize = 1024;
/// Maximum number of matches of one endpoint that are reported: one packet holds no more.
pub const MAX_MATCHED: usize = 1024;
/// Time that an ending end waits for the delivery of earlier messages.
pub const LINGER: Duration = Duration::from_secs(1);
