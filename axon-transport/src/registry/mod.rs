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
    /// True if applications' sessions came or went.
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
    /// Returns the sessions.
    pub fn sessions(&self) -> impl Iterator<Item = (&SessionId, &SessionEntry<F>)> {
        self.sessions.iter()
    }

    /// Returns a session.
    pub fn session(&self, id: &SessionId) -> Option<&SessionEntry<F>> {
        self.sessions.get(id)
    }

    /// Marks a session as relayed.
    pub fn set_relayed(&mut self, id: &SessionId, relay: Arc<RelayCounters>) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.relay = Some(relay);
        }
    }

    /// Returns the number of relayed sessions.
    pub fn relayed(&self) -> usize {
        self.sessions.iter().filter(|(_, s)| s.relay.is_some()).count()
    }

    /// Returns whether a session is being sent the complete state, or is about to be. A message that is pushed to it
    /// may be dropped.
    pub fn is_told_anew(&self, id: &SessionId) -> bool {
        self.sessions.is_told_anew(id)
    }

    /// Returns whether an application has a session.
    pub fn is_needed(&self) -> bool {
        self.sessions.iter().any(|(_, s)| s.role == SessionRole::Application)
    }

    /// Refuses a segment of a session's memory, because `there_are` as many as permitted. The session goes on. It is
    /// told once, until it gives up another segment.
    pub fn refuse_segment(&mut self, id: &SessionId, there_are: &str) {
        self.sessions.refuse_segment(id, there_are);
    }

    /// Keeps up to `most` segments of sessions that end from now on, for readers that come back from an earlier daemon.
    /// Drops the segments that were kept before.
    pub fn keep_left_memory(&mut self, most: usize) {
        self.sessions.keep_left_memory(most);
    }

    /// Takes the refusals since the last call, the first of each session.
    pub fn take_refused(&mut self) -> Vec<(SessionId, String)> {
        self.sessions.take_refused()
    }

    /// Returns the endpoints of this host's sessions.
    pub fn endpoints(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.endpoints.iter()
    }

    /// Returns the endpoints on other hosts.
    pub fn remote_endpoints(&self) -> impl Iterator<Item = (&DaemonId, &Endpoint)> {
        self.remote.iter().map(|(daemon, remote)| (daemon, &*remote.endpoint))
    }

    /// Returns the ATTACH messages of the pairs whose reader has asked its writer.
    pub fn attached(&self) -> impl Iterator<Item = &Attach> {
        self.pairs.attached()
    }

    /// Returns the graph's version; the next [`flush`](Self::flush) exceeds it.
    pub fn version(&self) -> u64 {
        self.changes.version()
    }

    /// Returns a number that represents the applications' endpoints of this host. It most likely differs when they
    /// change.
    pub fn digest(&self) -> u64 {
        self.endpoints.digest()
    }

    /// Returns whether applications' sessions came or went since the last call.
    pub fn take_rescoped(&mut self) -> bool {
        std::mem::take(&mut self.rescoped)
    }

    /// Returns the scopes of applications' sessions.
    pub fn scopes(&self) -> impl Iterator<Item = &Scope> {
        let all = self.sessions.iter().map(|(_, entry)| entry);
        let applications = all.filter(|entry| entry.role == SessionRole::Application);
        applications.filter_map(|entry| entry.scope.as_ref())
    }

    /// Returns pairs that would be matched except for the ranges of their sessions: at most `most`, from at most
    /// `looked_at` candidates.
    pub fn kept_apart(&self, most: usize, looked_at: usize) -> Vec<OutOfRangePair> {
        self.ranges().kept_apart(most, looked_at)
    }

    /// Handles changed links or changed addresses of static peers: `listed` returns the linked peers that a list of
    /// static peers names. Ends pairs that are now out of range, and makes pairs that are now in range.
    pub fn relist(&mut self, listed: impl Fn(&[String]) -> BTreeSet<DaemonId>) {
        for id in self.sessions.relist(listed) {
            let own = self.sessions.get(&id).map(|entry| entry.endpoints.clone());
            for gid in own.unwrap_or_default() {
                self.changes.regrade(gid);
                self.rematch(&gid);
            }
        }
    }

    /// Adds and removes endpoints of another host's daemon. `reset` first removes all that it had.
    ///
    /// Ignores endpoints that are out of bounds, and endpoints whose GID another host or a session of this host has.
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
        // The endpoints that stand for them are matched again.
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
                // Sessions that saw the endpoint may not see it any more.
                self.changes.remove(gid, false);
            }
            if heard != RemoteChange::Known {
                changed.push(remote.clone());
            }
            self.changes.add(remote.endpoint, Some(daemon));
        }
        self.rematch_remote(&changed);
    }

    /// Removes another host's daemon, which is gone, and its endpoints.
    pub fn remote_gone(&mut self, daemon: &DaemonId) {
        for gid in self.remote.remove_host(daemon) {
            self.changes.remove(gid, false);
        }
    }

    /// Adds an endpoint of this host. If another host claimed the GID, that claim is dropped.
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
