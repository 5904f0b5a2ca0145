//! The graph that a session shows.

use std::{
    collections::{BTreeMap, BTreeSet},
    mem,
    sync::Arc,
};

use crate::{
    graph::{Endpoint, GraphEntry, GraphView},
    ids::Gid,
};

/// The graph as the daemon described it, with the session's own endpoints.
#[derive(Default)]
pub(in crate::session) struct ShownGraph {
    pub(in crate::session) view: Arc<GraphView>,
    /// Own endpoints that the daemon refused, each with the reason. No other session learns of them.
    pub(in crate::session) refused: BTreeMap<Gid, String>,
    /// Ended endpoints, until a daemon has announced their end.
    pub(in crate::session) tombstones: BTreeSet<Gid>,
    /// True if it changed since the control thread last reported it.
    changed: bool,
}

impl ShownGraph {
    /// Shows an own endpoint in the graph: the caller that created it finds it there, unless the daemon has refused it.
    pub(in crate::session) fn show(&mut self, own: &Endpoint) {
        if self.refused.contains_key(&own.gid) {
            return;
        }
        let entry = || GraphEntry { endpoint: Arc::new(own.clone()), daemon: None, reach: None };
        Arc::make_mut(&mut self.view).endpoints.entry(own.gid).or_insert_with(entry);
        self.changed = true;
    }

    pub(in crate::session) fn hide(&mut self, gid: &Gid) {
        if self.view.endpoints.contains_key(gid) {
            Arc::make_mut(&mut self.view).endpoints.remove(gid);
            self.changed = true;
        }
    }

    /// Removes an own endpoint that is gone from the graph, whatever the daemon knows.
    pub(in crate::session) fn remove_dead(&mut self, gid: &Gid) {
        self.tombstones.insert(*gid);
        self.refused.remove(gid);
        self.hide(gid);
    }

    /// Returns whether it changed since the last call.
    pub(in crate::session) fn take_changed(&mut self) -> bool {
        mem::take(&mut self.changed)
    }
}
