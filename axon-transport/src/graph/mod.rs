//! The graph: which endpoints exist, on this host and on others.
//!
//! Plain data in, data out; the daemon and the gateway move it.

mod endpoint;
mod view;

pub use endpoint::{Endpoint, EndpointKind, LIMITS, Limits};
pub use view::{GraphEntry, GraphView};
