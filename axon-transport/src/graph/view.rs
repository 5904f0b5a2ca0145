//! The graph as a session sees it.

use std::{collections::HashMap, sync::Arc};

use super::{Endpoint, EndpointRange};
use crate::ids::{DaemonId, Gid};

/// All nodes and endpoints that a session's daemon knows, on this host and on others.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct GraphView {
    /// The version that the daemon gave this state.
    pub version: u64,
    /// The endpoints.
    pub endpoints: HashMap<Gid, GraphEntry>,
}

/// One endpoint of a [`GraphView`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct GraphEntry {
    /// The endpoint.
    pub endpoint: Arc<Endpoint>,
    /// The daemon of the endpoint's host; `None` for an endpoint of this host.
    pub daemon: Option<DaemonId>,
    /// Discovery range of its session. Set only for local endpoints in the gateway's view.
    pub(crate) reach: Option<EndpointRange>,
}

/// Returns the discovery range of a local endpoint's session. Set only in the gateway's view.
pub fn reach_of(entry: &GraphEntry) -> Option<&EndpointRange> {
    entry.reach.as_ref()
}
