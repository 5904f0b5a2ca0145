//! Sessions that share no memory: their samples pass through the daemon, over the session socket.
//!
//! To its daemon such a session is much what another host is. In its own process a registry and a
//! gateway session of their own stand for the world outside (`near`): relays read what the
//! application publishes, stand-ins write what it subscribes to, and all else works as with shared
//! memory. In the daemon a session of the same id has the application's endpoints, in memory that
//! everybody maps (`far`): to others, on this host and elsewhere, it is a session like any. Clients and
//! servers stand for others and cross as topics do (`calls`), and who is alive is said apart.
//!
//! [`flow`] is plain data: samples in pieces, and who may send how many of them. `pipe` moves them
//! over the socket (`docs/formats.md`, section 10).

use std::time::Duration;

mod calls;
pub(crate) mod far;
pub mod flow;
pub(crate) mod near;
mod news;
mod pipe;

pub(crate) use flow::Pool;

/// Relayed sessions of one daemon: each costs it two threads and memory of its own.
pub(crate) const MAX_SESSIONS: usize = 32;
/// Publishers, subscriptions, clients, and servers, of a relayed session.
const MAX_ENDPOINTS: usize = 1024;
/// Clients elsewhere that a relayed session's servers answer, each counted once for each of them.
const MAX_CALLERS: usize = 1024;
/// Others that one endpoint is said to be matched with; one packet holds no more.
const MAX_MATCHED: usize = 1024;
/// How long an end that ends waits for what was written before to have gone on.
const LINGER: Duration = Duration::from_secs(1);
