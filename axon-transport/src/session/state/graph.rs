//! The graph that a session shows.

use std::{
    collections::{BTreeMap, BTreeSet},
    mem,
    sync::Arc,
};

use crate::{
    graph::{Endpoint, GraphEntry, GraphView, TopicIndex},
    ids::Gid,
};

/// A view of the graph, and its endpoints by topic.
#[derive(Default)]
pub(in crate::session) struct IndexedView {
    view: Arc<GraphView>,
    topics: TopicIndex,
}

impl IndexedView {
    /// Adds or replaces an endpoint.
    pub(in crate::session) fn insert(&mut self, entry: GraphEntry) {
        let endpoint = Arc::clone(&entry.endpoint);
        let replaced = Arc::make_mut(&mut self.view).endpoints.insert(endpoint.gid, entry);
        if let Some(replaced) = replaced {
            self.topics.remove(&replaced.endpoint);
        }
        self.topics.insert(&endpoint);
    }

    /// Removes an endpoint.
    pub(in crate::session) fn remove(&mut self, gid: &Gid) -> Option<GraphEntry> {
        if !self.contains(gid) {
            return None;
        }
        let removed = Arc::make_mut(&mut self.view).endpoints.remove(gid)?;
        self.topics.remove(&removed.endpoint);
        Some(removed)
    }

    pub(in crate::session) fn contains(&self, gid: &Gid) -> bool {
        self.view.endpoints.contains_key(gid)
    }

    pub(in crate::session) fn set_version(&mut self, version: u64) {
        Arc::make_mut(&mut self.view).version = version;
    }

    /// Returns the endpoints on the topic of `endpoint`, of the kind that communicates with it.
    pub(in crate::session) fn counterparts(
        &self,
        endpoint: &Endpoint,
    ) -> impl Iterator<Item = &GraphEntry> {
        self.topics.counterparts(endpoint).filter_map(|gid| self.view.endpoints.get(gid))
    }

    /// Returns the view as it is now. While the value is held, a change copies the view.
    pub(in crate::session) fn view(&self) -> Arc<GraphView> {
        Arc::clone(&self.view)
    }
}

/// The graph as the daemon described it, with the session's own endpoints.
#[derive(Default)]
pub(in crate::session) struct ShownGraph {
    pub(in crate::session) indexed: IndexedView,
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
        if !self.indexed.contains(&own.gid) {
            let endpoint = Arc::new(own.clone());
            self.indexed.insert(GraphEntry { endpoint, daemon: None, reach: None });
        }
        self.changed = true;
    }

    pub(in crate::session) fn hide(&mut self, gid: &Gid) {
        if self.indexed.remove(gid).is_some() {
            self.changed = true;
        }
    }

    /// Removes an own endpoint that is gone from the graph, even if the daemon still announces it.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::EndpointKind;

    fn entry(number: u8, topic: &str) -> GraphEntry {
        let endpoint = Endpoint::example(Gid([number; 16]), EndpointKind::Publisher);
        let endpoint = Arc::new(Endpoint { topic: topic.into(), ..endpoint });
        GraphEntry { endpoint, daemon: None, reach: None }
    }

    #[test]
    fn changes_copy_the_view_only_while_it_is_held() {
        let mut shown = IndexedView::default();
        let place = Arc::as_ptr(&shown.view);
        for number in 0..100 {
            shown.insert(entry(number, "/a"));
        }
        shown.remove(&Gid([1; 16]));
        shown.set_version(7);
        assert_eq!(Arc::as_ptr(&shown.view), place);
        let held = shown.view();
        shown.remove(&Gid([2; 16]));
        assert_ne!(Arc::as_ptr(&shown.view), place);
        assert_eq!((held.endpoints.len(), shown.view.endpoints.len()), (99, 98));
        assert!(shown.remove(&Gid([2; 16])).is_none());
    }

    #[test]
    fn counterparts_follow_an_endpoint_that_is_told_anew() {
        let mut shown = IndexedView::default();
        let reader = |topic: &str| {
            let endpoint = Endpoint::example(Gid([9; 16]), EndpointKind::Subscription);
            Endpoint { topic: topic.into(), ..endpoint }
        };
        shown.insert(entry(1, "/a"));
        assert_eq!(shown.counterparts(&reader("/a")).count(), 1);
        shown.insert(entry(1, "/b"));
        assert_eq!(shown.counterparts(&reader("/a")).count(), 0);
        assert_eq!(shown.counterparts(&reader("/b")).count(), 1);
        shown.remove(&Gid([1; 16]));
        assert_eq!(shown.counterparts(&reader("/b")).count(), 0);
    }
}
