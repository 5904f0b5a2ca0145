//! The parts of the engine that all peers use.

use std::{cell::RefCell, collections::BTreeMap, sync::Arc};

use axon_shm::ids::Gid;
use axon_transport::{config::Config, graph::Endpoint, internal::graph::EndpointRange};

use super::{kept_relays::KeptRelays, routes::lanes::LocalWriterCounts, stalls::StallHistory};
use crate::engine::{rings::Rings, stand_in::StandIns};

/// The endpoints of applications on this host, with the discovery ranges of their sessions.
pub(crate) type LocalEndpoints = BTreeMap<Gid, (Arc<Endpoint>, EndpointRange)>;

/// The parts of the engine that all peers use.
pub(crate) struct PeerContext<'a> {
    /// The rings of this host.
    pub(crate) rings: &'a dyn Rings,
    /// All stand-ins.
    pub(crate) stand_ins: &'a StandIns,
    /// The endpoints of this host.
    pub(crate) local: &'a LocalEndpoints,
    /// The number of this host's writers for each route.
    pub(crate) writers: &'a LocalWriterCounts,
    /// The settings of this host.
    pub(crate) config: &'a Config,
    /// Routes that were given up.
    pub(crate) stalls: &'a RefCell<StallHistory>,
    /// Relays that are kept for daemons that are restarted.
    pub(crate) kept: &'a RefCell<KeptRelays>,
}
