//! Sessions that share no memory: their samples pass through the daemon, over the session socket.
//!
//! To its daemon such a session is much like another host. In its own process a registry and a
//! gateway session of their own stand for the world outside (`near`): relays read the samples that the
//! application publishes, stand-ins write those that it subscribes to, and all else works as with shared
//! memory. In the daemon (`daemon::relayed`) a session of the same id has the application's endpoints, in
//! memory that everybody maps: to others, on this host and elsewhere, it is a session like any. Clients
//! and servers stand for others and cross as topics do (`calls`); liveliness is told separately.
//!
//! [`flow`] is plain data: samples in pieces, and who may send how many of them. `pipe` moves them
//! over the socket (`docs/formats.md`, section 10).

use std::time::Duration;

pub mod calls;
pub mod change_signal;
pub mod flow;
pub(crate) mod near;
pub mod pipe;

pub use flow::Pool;

/// Relayed sessions of one daemon: each costs it two threads and memory of its own.
pub const MAX_SESSIONS: usize = 32;
/// Publishers, subscriptions, clients, and servers, of a relayed session.
pub const MAX_ENDPOINTS: usize = 1024;
/// Clients elsewhere that a relayed session's servers answer, each counted once for each of them.
pub const MAX_CALLERS: usize = 1024;
/// Others that one endpoint is said to be matched with; one packet holds no more.
pub const MAX_MATCHED: usize = 1024;
/// How long an end that ends waits for what was written before to have gone on.
pub const LINGER: Duration = Duration::from_secs(1);
