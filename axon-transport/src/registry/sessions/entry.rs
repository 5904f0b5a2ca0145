//! The entry of one session.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use super::{
    memory::{HeldMemory, OwnMemory},
    outbox::Outbox,
};
use crate::{
    config::DiscoveryRange,
    graph::{Endpoint, EndpointRange, RangeToHost, Scope},
    ids::{DaemonId, Gid},
    registry::relayed::RelayCounters,
    wire::session::SessionRole,
};

/// A session, with everything that the registry knows about it.
#[derive(Debug)]
pub struct SessionEntry<F> {
    /// The role.
    pub role: SessionRole,
    /// The name of its process.
    pub name: String,
    /// The id of its process.
    pub pid: u32,
    /// Its user, if that is not the daemon's.
    pub user: Option<u32>,
    /// Its discovery scope; `None` for the gateway, and for all sessions in a registry within a
    /// process.
    pub scope: Option<Scope>,
    /// The daemons of the linked peers that it lists.
    pub lists: BTreeSet<DaemonId>,
    /// Its endpoints.
    pub endpoints: BTreeSet<Gid>,
    /// Segment, doorbell and pidfd. `None` for a tool, and for a session with which no other shares
    /// memory.
    pub descriptors: Option<[F; 3]>,
    /// The segments of its memory besides the first.
    pub segments: OwnMemory<F>,
    /// The counters of its relay, if it is relayed. Then pairs within the session are left to its
    /// own process.
    pub relay: Option<Arc<RelayCounters>>,
    /// The packets that wait for it.
    pub(in crate::registry) outbox: Outbox<F>,
    /// The memory of other sessions whose descriptors it holds.
    pub(in crate::registry) held: HeldMemory,
    /// True if one of its endpoints was refused.
    pub(in crate::registry) refused: bool,
    /// Its first refused endpoints, with the reasons.
    pub(in crate::registry) refused_endpoints: BTreeMap<Gid, (Endpoint, String)>,
}

impl<F> SessionEntry<F> {
    pub(in crate::registry) fn new(
        role: SessionRole,
        name: String,
        pid: u32,
        descriptors: Option<[F; 3]>,
        scope: Option<Scope>,
    ) -> Self {
        Self {
            role,
            name,
            pid,
            user: None,
            scope,
            lists: BTreeSet::new(),
            endpoints: BTreeSet::new(),
            descriptors,
            segments: OwnMemory::default(),
            relay: None,
            // A tool gets no graph, so it cannot be behind.
            outbox: Outbox::new(role != SessionRole::Tool),
            held: HeldMemory::default(),
            refused: false,
            refused_endpoints: BTreeMap::new(),
        }
    }

    /// Returns the number of packets that wait for it.
    pub fn queued(&self) -> usize {
        self.outbox.len()
    }

    /// Returns its first refused endpoints, with the reasons.
    pub fn refused_endpoints(&self) -> impl Iterator<Item = (&Endpoint, &str)> {
        self.refused_endpoints.values().map(|(endpoint, why)| (endpoint, &**why))
    }

    /// Returns its range and the daemons of linked peers that it lists; `None` if ranges do not
    /// apply.
    pub(in crate::registry) fn reach(&self) -> Option<EndpointRange> {
        let scope = self.scope.as_ref()?;
        Some(EndpointRange { range: scope.range, lists: self.lists.iter().copied().collect() })
    }

    pub(in crate::registry) fn toward(&self, peer: &DaemonId) -> Option<RangeToHost> {
        let scope = self.scope.as_ref()?;
        Some(RangeToHost { range: scope.range, lists: self.lists.contains(peer) })
    }

    pub(in crate::registry) fn is_off(&self) -> bool {
        self.scope.as_ref().is_some_and(|scope| scope.range == DiscoveryRange::Off)
    }
}
