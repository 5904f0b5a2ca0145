//! The graph: which nodes and endpoints exist, on this host and on others.
//!
//! Plain data in, data out; the daemon and the gateway move it.

mod endpoint;
mod pairing;
mod query;
mod range;
mod view;

pub use endpoint::{Endpoint, EndpointKind, LIMITS, Limits};
pub use pairing::{Pairing, pairing, reads, writes};
pub use query::{NamesAndTypes, NodeName, SERVICE_KINDS, TOPIC_KINDS};
pub use range::{OutOfRange, Reach, RemoteEndpoint, Scope, Toward, out_of_range};
pub use view::{GraphEntry, GraphView};
