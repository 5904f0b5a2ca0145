//! Sends sessions the changes of the graph, or the complete state.

use std::{collections::BTreeSet, sync::Arc};

use super::{
    Registry,
    changes::packets,
    sessions::{DueMessage, SessionPacket},
};
use crate::{
    ids::SessionId,
    wire::session::{SessionGraph, SessionMessage},
};

/// Number of pairs after which a part of a session's pairs ends. The pairs of one endpoint are never split.
pub(super) const PAIRS_TOGETHER: usize = 256;

impl<F: Clone> Registry<F> {
    /// Returns the next packet for a session; `None` if there is none.
    ///
    /// A session that is behind is sent the complete state: the graph, the matches of its readers or their grants, and
    /// the requests of readers to its writers. A GRAPH without `more` closes it. Anything that the session is not sent
    /// again has ended. It is sent one part at a time, each when the session has taken the packets that wait. So the
    /// parts and the changes in between arrive in the order in which they happened.
    pub fn poll_output(&mut self, id: &SessionId) -> Option<SessionPacket<F>> {
        match self.sessions.get(id)?.outbox.due() {
            Some(DueMessage::Pairs) => self.tell_pairs(id),
            Some(DueMessage::Everything) => self.tell_everything(id),
            None => {}
        }
        self.sessions.pop(id)
    }

    /// Sends a session the status, in parts, as it takes them. It need not fit in the queue: the status of a large
    /// system has many megabytes.
    pub fn tell_status(&mut self, id: &SessionId, text: Arc<[u8]>) {
        self.sessions.tell_status(id, text);
    }

    /// If a status is being sent to a session that asks once more, sends it again from its beginning. Returns whether
    /// one is.
    pub fn repeat_status(&mut self, id: &SessionId) -> bool {
        self.sessions.repeat_status(id)
    }

    /// Puts back a packet that could not be sent.
    pub fn return_output(&mut self, id: &SessionId, output: SessionPacket<F>) {
        self.sessions.put_back(id, output);
    }

    /// Takes the sessions that got something to send since the last call.
    pub fn take_ready(&mut self) -> BTreeSet<SessionId> {
        self.sessions.take_ready()
    }

    /// Queues a message for one session.
    pub fn push(&mut self, to: &SessionId, message: &SessionMessage, descriptors: Vec<F>) {
        self.sessions.push(to, message, descriptors);
    }

    /// Answers the FENCEs for which everything has been sent. Must be called after packets were sent and after sessions
    /// ended.
    pub fn answer_fences(&mut self) {
        for (by, fence) in self.fences.take_answered(&self.sessions) {
            self.push(&by, &SessionMessage::Fence(fence), Vec::new());
        }
    }

    /// Returns whether any FENCE waits for packets to be sent.
    pub fn has_fences(&self) -> bool {
        !self.fences.is_empty()
    }

    /// Returns whether [`flush`](Self::flush) has something to do.
    pub fn needs_flush(&self) -> bool {
        !self.changes.is_empty()
    }

    /// Queues the changes of the graph since the last call. Called a few milliseconds after a change, so that a node
    /// that starts with twenty endpoints costs each session one packet.
    pub fn flush(&mut self) {
        let Some(change) = self.changes.take() else { return };
        let version = self.changes.version();
        let (all, own) = (change.removed(), change.own_removed());
        for (view, sessions) in self.ranges().views() {
            // The gateway itself reported the endpoints of other hosts.
            let removed = if view.is_gateway() { &own } else { &all };
            let regraded = change.regraded.iter().filter(|_| view.is_gateway());
            let regraded = regraded.filter(|gid| !change.added.contains_key(*gid));
            let again = regraded.filter_map(|gid| self.endpoints.get(gid));
            let again = again.filter(|local| local.is_shown()).map(|local| (&local.endpoint, None));
            let added = change.added.values().map(|(endpoint, daemon)| (&**endpoint, *daemon));
            let ranges = self.ranges();
            let shown = added.chain(again).filter_map(|(e, d)| ranges.shown_in(&view, e, d));
            let shown: Vec<_> = shown.collect();
            if shown.is_empty() && removed.is_empty() {
                continue;
            }
            let (telling, rest): (Vec<_>, Vec<_>) =
                sessions.into_iter().partition(|id| self.is_being_told(id));
            // For a session that is being sent the complete state, a change is part of it.
            for (sessions, open) in [(rest, false), (telling, true)] {
                let shown = shown.iter().cloned().take_while(|_| !sessions.is_empty());
                for packet in packets(version, false, shown, removed, &change.ended, open) {
                    self.sessions.push_encoded(&sessions, &packet);
                }
            }
        }
    }

    fn is_being_told(&self, id: &SessionId) -> bool {
        self.sessions.get(id).is_some_and(|entry| entry.outbox.is_being_told())
    }

    fn tell_everything(&mut self, id: &SessionId) {
        // The pending changes are part of the complete state; the other sessions get them as usual.
        self.flush();
        let packets = self.whole_graph(id);
        let Some(entry) = self.sessions.get_mut(id) else { return };
        entry.held.clear();
        entry.outbox.begin_telling(entry.endpoints.iter().copied().collect());
        for packet in packets {
            self.sessions.push_encoded(&[*id], &packet);
        }
        self.limit_queue(id);
    }

    /// Returns the packets of the whole graph as a session sees it. The last part has `more` set. Sessions with the
    /// same view share the packets while the version is the same.
    pub(super) fn whole_graph(&mut self, id: &SessionId) -> Vec<Arc<[u8]>> {
        let (view, version) = (self.ranges().view(id), self.changes.version());
        if let Some(made) = self.whole.get(version, &view) {
            return made;
        }
        let local = self.endpoints.shown().map(|local| (&local.endpoint, None));
        let remote = self.remote_endpoints().map(|(daemon, e)| (e, Some(*daemon)));
        let ranges = self.ranges();
        let shown = local.chain(remote).filter_map(|(e, d)| ranges.shown_in(&view, e, d));
        let tombstones = self.changes.tombstones();
        let ended = tombstones.iter().copied().collect();
        let made = packets(version, true, shown, &tombstones, &ended, true);
        if !view.is_gateway() {
            self.whole.put(view, &made);
        }
        made
    }

    /// Queues some pairs of a session's endpoints, and after the last ones the end of the complete state.
    fn tell_pairs(&mut self, id: &SessionId) {
        let Some(entry) = self.sessions.get_mut(id) else { return };
        entry.outbox.lift_limit();
        let mut told = 0;
        while told < PAIRS_TOGETHER {
            let Some(entry) = self.sessions.get_mut(id) else { return };
            let Some(gid) = entry.outbox.next_endpoint() else { return self.tell_end(id) };
            let Some(local) = self.endpoints.get(&gid) else { continue };
            let pairs = self.endpoints.prospective_pairs(&local.endpoint);
            let pairs: Vec<_> = self.pairs.existing(pairs).collect();
            told += pairs.len();
            for pair in pairs {
                // A reader without a grant asks again; a reader with one is sent its grant.
                if pair.reader == gid && !self.forward_grant(&pair) {
                    self.push(id, &SessionMessage::Match(pair), Vec::new());
                }
                if pair.writer == gid {
                    self.forward_attach(&pair);
                }
            }
        }
        self.limit_queue(id);
    }

    fn tell_end(&mut self, id: &SessionId) {
        let (added, removed, version) = (Vec::new(), Vec::new(), self.changes.version());
        let end = SessionGraph { version, whole: false, added, removed, more: false, ended: None };
        self.push(id, &SessionMessage::Graph(end), Vec::new());
        self.limit_queue(id);
    }

    fn limit_queue(&mut self, id: &SessionId) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.outbox.limit();
        }
    }
}
