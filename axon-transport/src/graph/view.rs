//! The graph as a session sees it.

use std::{collections::HashMap, sync::Arc};

use super::{Endpoint, EndpointRange};
use crate::ids::{DaemonId, Gid};

/// Every node and endpoint that a session's daemon knows, here and on other hosts.
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
    /// The daemon it belongs to when it is on another host.
    pub daemon: Option<DaemonId>,
    /// How far its session is discovered: of endpoints of this host, in the gateway's view alone.
    pub(crate) reach: Option<EndpointRange>,
}

/// How far the session of an endpoint of this host is discovered, in the gateway's view.
pub fn reach_of(entry: &GraphEntry) -> Option<&EndpointRange> {
    entry.reach.as_ref()
}
