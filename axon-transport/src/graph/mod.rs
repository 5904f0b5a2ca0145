//! The graph: which nodes and endpoints exist, on this host and on others.
//!
//! This module does no I/O. The daemon and the gateway transfer the data.

pub(crate) mod access;
pub(crate) mod endpoint;
pub(crate) mod pairing;
mod query;
pub(crate) mod range;
mod topic_index;
mod users;
pub(crate) mod view;

pub(crate) use access::{permits, shows, verb_of};
pub(crate) use endpoint::LIMITS;
pub use endpoint::{Endpoint, EndpointKind};
pub(crate) use pairing::{Pairing, pairing, reads, writes};
pub use query::{NamesAndTypes, NodeName, SERVICE_KINDS, TOPIC_KINDS};
pub(crate) use range::{
    EndpointRange, OutOfRange, RangeToHost, RemoteEndpoint, Scope, out_of_range,
};
pub(crate) use topic_index::TopicIndex;
pub(crate) use users::Users;
pub use view::{GraphEntry, GraphView};
