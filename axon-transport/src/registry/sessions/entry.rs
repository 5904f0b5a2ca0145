//! One session.

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

/// A session as the registry knows it.
#[derive(Debug)]
pub struct SessionEntry<F> {
    /// What kind it is.
    pub role: SessionRole,
    /// Its process's name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// Its user, where that is another than the daemon's.
    pub user: Option<u32>,
    /// How far it is discovered; `None` of the gateway, and of all in a registry within a process.
    pub scope: Option<Scope>,
    /// Daemons of the linked peers that it lists.
    pub lists: BTreeSet<DaemonId>,
    /// Its endpoints.
    pub endpoints: BTreeSet<Gid>,
    /// Segment, doorbell and pidfd; a tool has none, nor has a session that nobody can meet.
    pub descriptors: Option<[F; 3]>,
    /// The segments of its memory besides the first.
    pub segments: OwnMemory<F>,
    /// What is shown of its relay, where it is relayed. Pairs within it are its own process's.
    pub relay: Option<Arc<RelayCounters>>,
    /// What waits for it.
    pub(in crate::registry) outbox: Outbox<F>,
    /// The memory of other sessions whose descriptors it holds.
    pub(in crate::registry) held: HeldMemory,
    /// An endpoint of its was refused.
    pub(in crate::registry) refused: bool,
    /// The first of its endpoints that were refused, and why.
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
            // There is no graph that a tool could be behind with.
            outbox: Outbox::new(role != SessionRole::Tool),
            held: HeldMemory::default(),
            refused: false,
            refused_endpoints: BTreeMap::new(),
        }
    }

    /// Packets that wait for it.
    pub fn queued(&self) -> usize {
        self.outbox.len()
    }

    /// The first of its endpoints that were refused, and why.
    pub fn refused_endpoints(&self) -> impl Iterator<Item = (&Endpoint, &str)> {
        self.refused_endpoints.values().map(|(endpoint, why)| (endpoint, &**why))
    }

    /// Its range, and the daemons of linked peers that it lists; `None` where ranges do not apply.
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
