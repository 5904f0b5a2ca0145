//! The changes of the graph that sessions have not been sent yet, and the packets that contain them.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::{Arc, Weak},
};

use super::{limits::MAX_TOMBSTONES, range::GraphFilter, sessions::encode};
use crate::{
    graph::Endpoint,
    ids::{DaemonId, Gid},
    wire::session::{GraphItem, SessionGraph, SessionMessage},
};

/// Bytes of endpoints in one packet. This leaves room for the rest of the message and one more endpoint.
const PART: usize = 24 * 1024;

/// A new endpoint in the graph, and its daemon if it is on another host.
pub(super) type NewEndpoint = (Arc<Endpoint>, Option<DaemonId>);

/// The changes of the graph since the last flush, and the graph's version.
///
/// A GID that was removed and is back is in both lists. A session is told of the removal first.
#[derive(Debug, Default)]
pub(super) struct GraphChanges {
    version: u64,
    pending: GraphChange,
    /// GIDs of endpoints that ended while there was no daemon to tell, or while this daemon was new. They are part of
    /// the complete state that a session is sent.
    tombstones: VecDeque<Gid>,
}

/// A change of the graph.
#[derive(Debug, Default)]
pub(super) struct GraphChange {
    pub(super) added: BTreeMap<Gid, NewEndpoint>,
    /// The removed GIDs; true for endpoints of this host.
    removed: BTreeMap<Gid, bool>,
    /// Endpoints of this host that ended. Sessions detach from them.
    pub(super) ended: BTreeSet<Gid>,
    /// Endpoints of this host whose session lists other peers than the gateway knows.
    pub(super) regraded: BTreeSet<Gid>,
}

impl GraphChange {
    /// Returns the GIDs that were removed, including those of other hosts.
    pub(super) fn removed(&self) -> Vec<Gid> {
        self.removed.keys().copied().collect()
    }

    /// Returns the GIDs of this host that were removed.
    pub(super) fn own_removed(&self) -> Vec<Gid> {
        self.removed.iter().filter(|(_, own)| **own).map(|(gid, _)| *gid).collect()
    }

    fn is_empty(&self) -> bool {
        self.added.is_empty() && self.removed.is_empty() && self.regraded.is_empty()
    }
}

impl GraphChanges {
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    /// Adds an endpoint.
    pub(super) fn add(&mut self, endpoint: Arc<Endpoint>, daemon: Option<DaemonId>) {
        // The session of an endpoint that is back attaches its partners anew. They have been told that it had ended.
        self.pending.ended.remove(&endpoint.gid);
        self.pending.added.insert(endpoint.gid, (endpoint, daemon));
    }

    /// Removes an endpoint. `own` is true if it is of this host.
    pub(super) fn remove(&mut self, gid: Gid, own: bool) {
        self.pending.added.remove(&gid);
        *self.pending.removed.entry(gid).or_default() |= own;
    }

    /// Removes an endpoint of this host that ended.
    pub(super) fn end(&mut self, gid: Gid) {
        self.remove(gid, true);
        self.pending.ended.insert(gid);
    }

    /// Removes an endpoint of this host that ended while there was no daemon, or while this daemon was new. Sessions
    /// that have not come back yet must be told of it, too.
    pub(super) fn bury(&mut self, gid: Gid) {
        if self.tombstones.len() == MAX_TOMBSTONES {
            self.tombstones.pop_front();
        }
        self.tombstones.push_back(gid);
        self.end(gid);
    }

    /// Records that the session of an endpoint now lists other peers.
    pub(super) fn regrade(&mut self, gid: Gid) {
        self.pending.regraded.insert(gid);
    }

    pub(super) fn is_empty(&self) -> bool {
        self.pending.is_empty()
    }

    /// Takes the pending changes as the next version; `None` if nothing changed.
    pub(super) fn take(&mut self) -> Option<GraphChange> {
        if self.is_empty() {
            return None;
        }
        self.version += 1;
        Some(std::mem::take(&mut self.pending))
    }

    /// Returns the ended endpoints of which returning sessions must be told.
    pub(super) fn tombstones(&self) -> Vec<Gid> {
        self.tombstones.iter().copied().collect()
    }
}

/// The packets of the whole graph for each view, as they were last made. They are kept as long as a session has yet to
/// be sent them, and as long as the graph has their version.
#[derive(Debug, Default)]
pub(super) struct WholeGraphs {
    version: u64,
    by_view: BTreeMap<GraphFilter, Vec<Weak<[u8]>>>,
}

impl WholeGraphs {
    pub(super) fn get(&mut self, version: u64, view: &GraphFilter) -> Option<Vec<Arc<[u8]>>> {
        if self.version != version {
            *self = Self { version, by_view: BTreeMap::new() };
        }
        let made = self.by_view.get(view)?.iter().map(Weak::upgrade);
        made.collect::<Option<Vec<_>>>().filter(|made| !made.is_empty())
    }

    /// Keeps packets for the version of the last [`get`](Self::get).
    pub(super) fn put(&mut self, view: GraphFilter, packets: &[Arc<[u8]>]) {
        self.by_view.insert(view, packets.iter().map(Arc::downgrade).collect());
    }
}

/// Makes the packets of a change, each before the next part is collected.
pub(super) fn packets(
    version: u64,
    whole: bool,
    added: impl Iterator<Item = GraphItem>,
    removed: &[Gid],
    ended: &BTreeSet<Gid>,
    open: bool,
) -> Vec<Arc<[u8]>> {
    let mut packets = Vec::new();
    each_part(version, whole, added, removed, ended, open, |part| {
        packets.extend(encode(&SessionMessage::Graph(part)));
    });
    packets
}

/// Splits a change into parts. `open` sets `more` in the last part.
pub fn parts(
    version: u64,
    whole: bool,
    added: impl Iterator<Item = GraphItem>,
    removed: &[Gid],
    ended: &BTreeSet<Gid>,
    open: bool,
) -> Vec<SessionGraph> {
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
    mut each: impl FnMut(SessionGraph),
) {
    let empty = |whole| SessionGraph {
        version,
        whole,
        added: vec![],
        removed: vec![],
        more: true,
        ended: None,
    };
    let mut part = empty(whole);
    let mut size = 0;
    // Removals come first: a GID that was removed and is back must end up present.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{graph::EndpointKind, ids::SessionId};

    fn gid(number: u32) -> Gid {
        Gid::new(SessionId([1; 16]), number)
    }

    fn endpoint(number: u32) -> Arc<Endpoint> {
        Arc::new(Endpoint::example(gid(number), EndpointKind::Publisher))
    }

    #[test]
    fn a_version_is_a_change_that_was_taken() {
        let mut changes = GraphChanges::default();
        assert!(changes.take().is_none());
        changes.add(endpoint(1), None);
        changes.add(endpoint(1), None);
        assert_eq!(changes.version(), 0);
        assert_eq!(changes.take().unwrap().added.len(), 1);
        assert!(changes.take().is_none());
        changes.regrade(gid(1));
        assert_eq!(changes.take().unwrap().regraded, [gid(1)].into());
        assert_eq!(changes.version(), 2);
    }

    #[test]
    fn one_that_ended_and_is_back_is_removed_and_added_and_has_not_ended() {
        let mut changes = GraphChanges::default();
        changes.add(endpoint(1), None);
        changes.end(gid(1));
        changes.end(gid(2));
        changes.add(endpoint(1), None);
        let change = changes.take().unwrap();
        assert_eq!(change.removed(), [gid(1), gid(2)]);
        assert_eq!(change.ended, [gid(2)].into());
        assert_eq!(change.added.keys().collect::<Vec<_>>(), [&gid(1)]);
        // An endpoint of another host and then of this host, and the other way round.
        changes.remove(gid(1), false);
        changes.remove(gid(2), true);
        changes.remove(gid(2), false);
        let change = changes.take().unwrap();
        assert_eq!((change.removed(), change.own_removed()), (vec![gid(1), gid(2)], vec![gid(2)]));
    }

    #[test]
    fn tombstones_are_bounded_and_the_oldest_goes_first() {
        let mut changes = GraphChanges::default();
        let most = u32::try_from(MAX_TOMBSTONES).unwrap();
        (0..=most).for_each(|number| changes.bury(gid(number)));
        let stones = changes.tombstones();
        assert_eq!((stones.len(), stones[0]), (MAX_TOMBSTONES, gid(1)));
        assert!(changes.take().unwrap().ended.contains(&gid(0)), "it was told all the same");
        assert_eq!(changes.tombstones().len(), MAX_TOMBSTONES);
    }

    #[test]
    fn graph_packets_are_freed_after_the_last_session_received_them() {
        let mut whole = WholeGraphs::default();
        let view = GraphFilter::default();
        assert!(whole.get(1, &view).is_none());
        let made = packets(1, true, std::iter::empty(), &[], &BTreeSet::new(), true);
        whole.put(view.clone(), &made);
        assert!(Arc::ptr_eq(&whole.get(1, &view).unwrap()[0], &made[0]));
        assert!(whole.get(2, &view).is_none(), "of another version");
        assert!(whole.get(1, &view).is_none());
        whole.put(view.clone(), &made);
        drop(made);
        assert!(whole.get(1, &view).is_none(), "nobody has it");
    }
}
