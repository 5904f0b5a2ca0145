//! The graph that the daemon shows to sessions, and its changes.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{Arc, Weak},
};

use super::{LocalEndpoint, Registry, output::encode};
use crate::{
    graph::{Endpoint, LIMITS, RemoteEndpoint},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{EndpointRole, Graph, GraphItem, Message},
};

/// Bytes of endpoints in one packet; leaves room for the rest of the message and one endpoint more.
const PART: usize = 24 * 1024;

impl<F: Clone> Registry<F> {
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
            if let Some(gone) = self.remote.get_mut(&daemon).and_then(|all| all.remove(&gid)) {
                self.graph_remove(gid, false);
                changed.push(gone);
            }
        }
        for remote in added {
            let remote: RemoteEndpoint = remote.into();
            let gid = remote.endpoint.gid;
            let local = self.endpoints.get(&gid).is_some_and(|e| e.role != EndpointRole::StandIn);
            let elsewhere =
                self.remote.iter().any(|(other, all)| *other != daemon && all.contains_key(&gid));
            let all = self.remote.entry(daemon).or_default();
            let full = all.len() >= LIMITS.endpoints;
            if local || elsewhere || !remote.endpoint.is_sane() || full {
                continue;
            }
            let before = all.insert(gid, remote.clone());
            if before.as_ref().is_some_and(|before| before.toward != remote.toward) {
                // Sessions that saw it may not see it any more.
                self.graph_remove(gid, false);
            }
            if before.is_none_or(|before| before.toward != remote.toward) {
                changed.push(remote.clone());
            }
            self.graph_add(remote.endpoint, Some(daemon));
        }
        self.rematch_remote(&changed);
    }

    /// Another host's daemon is gone, and its endpoints with it.
    pub fn remote_gone(&mut self, daemon: &DaemonId) {
        for (gid, _) in self.remote.remove(daemon).unwrap_or_default() {
            self.graph_remove(gid, false);
        }
    }

    /// Queues what changed in the graph since the last call. Called a few milliseconds after a
    /// change, so that a node that starts with twenty endpoints costs each session one packet.
    pub fn flush(&mut self) {
        if !self.needs_flush() {
            return;
        }
        self.version += 1;
        let removed = std::mem::take(&mut self.removed);
        let added = std::mem::take(&mut self.added);
        let ended = std::mem::take(&mut self.ended);
        let regraded = std::mem::take(&mut self.regraded);
        let all: Vec<Gid> = removed.keys().copied().collect();
        let own: Vec<Gid> = removed.iter().filter(|(_, own)| **own).map(|(gid, _)| *gid).collect();
        for (view, sessions) in self.views() {
            // The gateway itself reported the endpoints of other hosts.
            let removed = if view.is_gateway() { &own } else { &all };
            let regraded = regraded.iter().filter(|_| view.is_gateway());
            let regraded = regraded.filter(|gid| !added.contains_key(*gid));
            let again = regraded.filter_map(|gid| self.endpoints.get(gid)).filter(|e| is_shown(e));
            let again = again.map(|local| (&local.endpoint, None));
            let added = added.values().map(|(endpoint, daemon)| (&**endpoint, *daemon));
            let shown = added.chain(again).filter_map(|(e, d)| self.shown_in(&view, e, d));
            let mut shown = shown.peekable();
            if shown.peek().is_none() && removed.is_empty() {
                continue;
            }
            let (shown, telling): (Vec<_>, Vec<_>) = (shown.collect(), self.telling(&sessions));
            let rest: Vec<_> =
                sessions.iter().filter(|id| !telling.contains(id)).copied().collect();
            // One that is being told everything takes a change as a part of the whole.
            for (sessions, open) in [(rest, false), (telling, true)] {
                let shown = shown.iter().cloned().take_while(|_| !sessions.is_empty());
                for packet in packets(self.version, false, shown, removed, &ended, open) {
                    self.push_encoded(&sessions, &packet);
                }
            }
        }
    }

    /// Those of them that are being told everything.
    fn telling(&self, sessions: &[SessionId]) -> Vec<SessionId> {
        let told = |id: &&SessionId| self.sessions.get(*id).is_some_and(|s| s.telling.is_some());
        sessions.iter().filter(told).copied().collect()
    }

    /// A number that stands for the endpoints of applications here: another one, most likely, when
    /// they change.
    pub fn digest(&self) -> u64 {
        self.shown().fold(0, |digest, local| {
            // GIDs are mostly random; FNV-1a spreads the rest.
            let hash = local.endpoint.gid.0.iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
                (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
            });
            digest ^ hash
        })
    }

    /// Whether [`flush`](Self::flush) has something to do.
    pub fn needs_flush(&self) -> bool {
        !self.added.is_empty() || !self.removed.is_empty() || !self.regraded.is_empty()
    }

    /// The whole graph as a session is shown it, open-ended: the last part says that more follows.
    /// Sessions of one view share its packets while they are of the same version.
    pub(super) fn whole_graph(&mut self, id: &SessionId) -> Vec<Arc<[u8]>> {
        let view = self.view(id);
        if self.whole.0 != self.version {
            self.whole = (self.version, BTreeMap::new());
        }
        let made = self.whole.1.get(&view).and_then(|made| {
            let made = made.iter().map(Weak::upgrade).collect::<Option<Vec<_>>>();
            made.filter(|made| !made.is_empty())
        });
        if let Some(made) = made {
            return made;
        }
        let local = self.shown().map(|local| (&local.endpoint, None));
        let remote = self.remote_endpoints().map(|(daemon, e)| (e, Some(*daemon)));
        let shown = local.chain(remote).filter_map(|(e, d)| self.shown_in(&view, e, d));
        let tombstones: Vec<Gid> = self.tombstones.iter().copied().collect();
        let ended = self.tombstones.iter().copied().collect();
        let made = packets(self.version, true, shown, &tombstones, &ended, true);
        if !view.is_gateway() {
            self.whole.1.insert(view, made.iter().map(Arc::downgrade).collect());
        }
        made
    }

    /// The endpoints of this host's applications that are in the graph.
    fn shown(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.endpoints.values().filter(|local| is_shown(local))
    }

    pub(super) fn graph_add_local(&mut self, endpoint: &Endpoint) {
        // A session's word about its own GID outweighs another host's.
        let claimed: Vec<DaemonId> = self
            .remote
            .iter_mut()
            .filter_map(|(d, all)| all.remove(&endpoint.gid).map(|_| *d))
            .collect();
        if !claimed.is_empty() {
            self.graph_remove(endpoint.gid, false);
        }
        self.graph_add(Arc::new(endpoint.clone()), None);
    }

    fn graph_add(&mut self, endpoint: Arc<Endpoint>, daemon: Option<DaemonId>) {
        // One that is back is attached to anew. That it had ended its partners have been told.
        self.ended.remove(&endpoint.gid);
        self.added.insert(endpoint.gid, (endpoint, daemon));
    }

    /// An endpoint of this host ended.
    pub(super) fn graph_end(&mut self, gid: Gid) {
        self.graph_remove(gid, true);
        self.ended.insert(gid);
    }

    /// An endpoint is gone, of this host if it is its `own`.
    pub(super) fn graph_remove(&mut self, gid: Gid, own: bool) {
        self.added.remove(&gid);
        *self.removed.entry(gid).or_default() |= own;
    }
}

fn is_shown(local: &LocalEndpoint) -> bool {
    local.role == EndpointRole::Application && !local.leaving
}

/// The packets of a change: each is made before the next one is put together.
fn packets(
    version: u64,
    whole: bool,
    added: impl Iterator<Item = GraphItem>,
    removed: &[Gid],
    ended: &BTreeSet<Gid>,
    open: bool,
) -> Vec<Arc<[u8]>> {
    let mut packets = Vec::new();
    each_part(version, whole, added, removed, ended, open, |part| {
        packets.extend(encode(&Message::Graph(part)));
    });
    packets
}

/// Splits a change into packets. `open` leaves `more` set in the last.
pub fn parts(
    version: u64,
    whole: bool,
    added: impl Iterator<Item = GraphItem>,
    removed: &[Gid],
    ended: &BTreeSet<Gid>,
    open: bool,
) -> Vec<Graph> {
    let mut parts = Vec::new();
    each_part(version, whole, added, removed, ended, open, |part| parts.push(part));
    parts
}

fn each_part(
    version: u64,
    whole: bool,
    added: impl Iterator<Item = GraphItem>,
    removed: &[Gid],
    ended: &BTreeSet<Gid>,
    open: bool,
    mut each: impl FnMut(Graph),
) {
    let empty =
        |whole| Graph { version, whole, added: vec![], removed: vec![], more: true, ended: None };
    let mut part = empty(whole);
    let mut size = 0;
    // Removals go first: a GID that was removed and is back must end up present.
    for gid in removed {
        if size + 34 > PART {
            each(std::mem::replace(&mut part, empty(false)));
            size = 0;
        }
        size += 17;
        part.removed.push(*gid);
        if ended.contains(gid) {
            size += 17;
            part.ended.get_or_insert_default().push(*gid);
        }
    }
    for item in added {
        let e = &item.endpoint;
        let names = [&e.topic, &e.type_name, &e.node, &e.namespace, &e.enclave];
        let bytes = names.iter().map(|n| n.len()).sum::<usize>() + e.type_hash.len() + 160;
        let bytes = bytes + item.reach.as_ref().map_or(0, |reach| 8 + 17 * reach.lists.len());
        if size + bytes > PART {
            each(std::mem::replace(&mut part, empty(false)));
            size = 0;
        }
        size += bytes;
        part.added.push(item);
    }
    part.more = open;
    each(part);
}
