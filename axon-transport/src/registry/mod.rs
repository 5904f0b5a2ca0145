//! The control plane's state: sessions, endpoints, matched pairs, and the queued messages of each session.
//!
//! A state machine (`docs/architecture.md`) without time: messages of sessions go in, packets and descriptors come
//! out. `F` stands for a descriptor. Matching is a function of the endpoints alone. If a session cannot receive its
//! messages in time, the registry sends it the complete state anew ([`Registry::poll_output`]).

#[cfg(test)]
mod bounds;
mod changes;
mod endpoints;
mod fence;
mod input;
mod limits;
mod matching;
mod output;
mod pairs;
mod range;
mod relayed;
mod remote;
mod sessions;
#[cfg(test)]
mod tests;

use std::{collections::BTreeSet, sync::Arc};

pub use self::{
    changes::parts,
    endpoints::LocalEndpoint,
    limits::{
        MAX_ALL_PAIRS, MAX_OF_PROCESS, MAX_PAIRS, MAX_QUEUE, MAX_QUEUE_BYTES, MAX_SEGMENTS,
        MAX_SESSIONS, Violation,
    },
    range::OutOfRangePair,
    relayed::RelayCounters,
    sessions::{OwnMemory, RegisteredSegment, SessionEntry, SessionPacket},
};
use self::{
    changes::{GraphChanges, WholeGraphs},
    endpoints::Endpoints,
    fence::Fences,
    pairs::Pairs,
    range::Ranges,
    remote::{RemoteChange, RemoteEndpoints},
    sessions::Sessions,
};
use crate::{
    graph::{Endpoint, RemoteEndpoint, Scope, Users},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{Attach, EndpointRole, SessionRole},
};

/// The state of the control plane.
#[derive(Debug)]
pub struct Registry<F> {
    sessions: Sessions<F>,
    endpoints: Endpoints,
    pairs: Pairs,
    remote: RemoteEndpoints,
    changes: GraphChanges,
    whole: WholeGraphs,
    fences: Fences,
    users: Users,
    /// Applications' sessions came or went.
    rescoped: bool,
}

impl<F> Default for Registry<F> {
    fn default() -> Self {
        Self {
            sessions: Sessions::default(),
            endpoints: Endpoints::default(),
            pairs: Pairs::default(),
            remote: RemoteEndpoints::default(),
            changes: GraphChanges::default(),
            whole: WholeGraphs::default(),
            fences: Fences::default(),
            users: Users::default(),
            rescoped: false,
        }
    }
}

impl<F: Clone> Registry<F> {
    /// The sessions.
    pub fn sessions(&self) -> impl Iterator<Item = (&SessionId, &SessionEntry<F>)> {
        self.sessions.iter()
    }

    /// One session.
    pub fn session(&self, id: &SessionId) -> Option<&SessionEntry<F>> {
        self.sessions.get(id)
    }

    /// A session is relayed.
    pub fn set_relayed(&mut self, id: &SessionId, relay: Arc<RelayCounters>) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.relay = Some(relay);
        }
    }

    /// How many are.
    pub fn relayed(&self) -> usize {
        self.sessions.iter().filter(|(_, s)| s.relay.is_some()).count()
    }

    /// Whether a session is told everything anew: what is pushed to it now is dropped.
    pub fn is_told_anew(&self, id: &SessionId) -> bool {
        self.sessions.is_told_anew(id)
    }

    /// Whether there is an application's session.
    pub fn is_needed(&self) -> bool {
        self.sessions.iter().any(|(_, s)| s.role == SessionRole::Application)
    }

    /// A segment of a session's memory is not taken, since `there_are` as many as may be. The session
    /// goes on, and is told once until it gives another one up.
    pub fn refuse_segment(&mut self, id: &SessionId, there_are: &str) {
        self.sessions.refuse_segment(id, there_are);
    }

    /// From now on keeps segments of sessions that end, `most` at a time, for readers that come back from an earlier
    /// daemon. What is kept is given up.
    pub fn keep_left_memory(&mut self, most: usize) {
        self.sessions.keep_left_memory(most);
    }

    /// The refused endpoints since the last call, the first of each session.
    pub fn take_refused(&mut self) -> Vec<(SessionId, String)> {
        self.sessions.take_refused()
    }

    /// The endpoints of sessions here.
    pub fn endpoints(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.endpoints.iter()
    }

    /// The endpoints on other hosts.
    pub fn remote_endpoints(&self) -> impl Iterator<Item = (&DaemonId, &Endpoint)> {
        self.remote.iter().map(|(daemon, remote)| (daemon, &*remote.endpoint))
    }

    /// The pairs whose reader has asked its writer.
    pub fn attached(&self) -> impl Iterator<Item = &Attach> {
        self.pairs.attached()
    }

    /// The version that the next [`flush`](Self::flush) will exceed.
    pub fn version(&self) -> u64 {
        self.changes.version()
    }

    /// A number that stands for the endpoints of applications here: another one, most likely, when
    /// they change.
    pub fn digest(&self) -> u64 {
        self.endpoints.digest()
    }

    /// Whether applications' sessions came or went since the last call.
    pub fn take_rescoped(&mut self) -> bool {
        std::mem::take(&mut self.rescoped)
    }

    /// The scopes of applications' sessions.
    pub fn scopes(&self) -> impl Iterator<Item = &Scope> {
        let all = self.sessions.iter().map(|(_, entry)| entry);
        let applications = all.filter(|entry| entry.role == SessionRole::Application);
        applications.filter_map(|entry| entry.scope.as_ref())
    }

    /// Pairs that would be matched but for the ranges of their sessions: at most `most`, of at most
    /// `looked_at` that are looked at.
    pub fn kept_apart(&self, most: usize, looked_at: usize) -> Vec<OutOfRangePair> {
        self.ranges().kept_apart(most, looked_at)
    }

    /// Links, or the addresses of static peers, changed: `listed` tells which linked peers a list of
    /// static peers names. Pairs that are out of range now end, and those that are in range are made.
    pub fn relist(&mut self, listed: impl Fn(&[String]) -> BTreeSet<DaemonId>) {
        for id in self.sessions.relist(listed) {
            let own = self.sessions.get(&id).map(|entry| entry.endpoints.clone());
            for gid in own.unwrap_or_default() {
                self.changes.regrade(gid);
                self.rematch(&gid);
            }
        }
    }

    /// What another host's daemon has: `reset` forgets what it had.
    ///
    /// Endpoints that are out of bounds, or whose GID another host or a session here has, are
    /// left out.
    pub fn remote_graph(
        &mut self,
        daemon: DaemonId,
        reset: bool,
        added: impl IntoIterator<Item = impl Into<RemoteEndpoint>>,
        removed: Vec<Gid>,
    ) {
        if reset {
            self.remote_gone(&daemon);
        }
        // What stands for them is matched anew.
        let mut changed = Vec::new();
        for gid in removed {
            if let Some(gone) = self.remote.remove(&daemon, &gid) {
                self.changes.remove(gid, false);
                changed.push(gone);
            }
        }
        for remote in added {
            let remote: RemoteEndpoint = remote.into();
            let gid = remote.endpoint.gid;
            if self.endpoints.get(&gid).is_some_and(|e| e.role != EndpointRole::StandIn) {
                continue;
            }
            let Some(heard) = self.remote.insert(daemon, &remote) else { continue };
            if heard == RemoteChange::Range {
                // Sessions that saw it may not see it any more.
                self.changes.remove(gid, false);
            }
            if heard != RemoteChange::Known {
                changed.push(remote.clone());
            }
            self.changes.add(remote.endpoint, Some(daemon));
        }
        self.rematch_remote(&changed);
    }

    /// Another host's daemon is gone, and its endpoints with it.
    pub fn remote_gone(&mut self, daemon: &DaemonId) {
        for gid in self.remote.remove_host(daemon) {
            self.changes.remove(gid, false);
        }
    }

    /// A session's word about its own GID outweighs another host's.
    fn graph_add_local(&mut self, endpoint: &Endpoint) {
        if self.remote.disown(&endpoint.gid) {
            self.changes.remove(endpoint.gid, false);
        }
        self.changes.add(Arc::new(endpoint.clone()), None);
    }

    fn ranges(&self) -> Ranges<'_, F> {
        let Self { sessions, endpoints, remote, users, .. } = self;
        Ranges { sessions, endpoints, remote, users }
    }
}
