//! Tells sessions: the changes of the graph, and everything anew.

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

/// Pairs of which a session is told at a time, and the rest of those of one endpoint.
pub(super) const PAIRS_TOGETHER: usize = 256;

impl<F: Clone> Registry<F> {
    /// The next packet for a session; `None` when there is none.
    ///
    /// A session that is behind is told everything anew: the graph, its matches or what was granted
    /// to its readers, and what readers asked of its writers, closed by a GRAPH without `more`. What
    /// it does not hear again is over. It is told a part at a time, when it has taken what waits for it:
    /// so the parts and what changes in between come in the order in which they were so.
    pub fn poll_output(&mut self, id: &SessionId) -> Option<SessionPacket<F>> {
        match self.sessions.get(id)?.outbox.due() {
            Some(DueMessage::Pairs) => self.tell_pairs(id),
            Some(DueMessage::Everything) => self.tell_everything(id),
            None => {}
        }
        self.sessions.pop(id)
    }

    /// Tells a session the status, part by part, as it takes them. It need not fit the queue: a
    /// large system's is of many megabytes.
    pub fn tell_status(&mut self, id: &SessionId, text: Arc<[u8]>) {
        self.sessions.tell_status(id, text);
    }

    /// Tells a session that asks once more the same status from its beginning; whether one is
    /// being told to it.
    pub fn repeat_status(&mut self, id: &SessionId) -> bool {
        self.sessions.repeat_status(id)
    }

    /// Puts a packet back that could not be sent.
    pub fn return_output(&mut self, id: &SessionId, output: SessionPacket<F>) {
        self.sessions.put_back(id, output);
    }

    /// Sessions that got something to be told since the last call.
    pub fn take_ready(&mut self) -> BTreeSet<SessionId> {
        self.sessions.take_ready()
    }

    /// Queues a message for one session.
    pub fn push(&mut self, to: &SessionId, message: &SessionMessage, descriptors: Vec<F>) {
        self.sessions.push(to, message, descriptors);
    }

    /// Answers the FENCEs of which everything was sent by now. Has to be called when packets were sent, and
    /// when sessions ended.
    pub fn answer_fences(&mut self) {
        for (by, fence) in self.fences.take_answered(&self.sessions) {
            self.push(&by, &SessionMessage::Fence(fence), Vec::new());
        }
    }

    /// Whether there are any that wait for packets to be sent.
    pub fn has_fences(&self) -> bool {
        !self.fences.is_empty()
    }

    /// Whether [`flush`](Self::flush) has something to do.
    pub fn needs_flush(&self) -> bool {
        !self.changes.is_empty()
    }

    /// Queues what changed in the graph since the last call. Called a few milliseconds after a
    /// change, so that a node that starts with twenty endpoints costs each session one packet.
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
            // One that is being told everything takes a change as a part of the whole.
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
        // Pending changes are part of the whole, and the others hear of them as usual.
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

    /// The whole graph as a session is shown it, open-ended: the last part says that more follows.
    /// Sessions of one view share its packets while they are of the same version.
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

    /// Tells a session of pairs of its endpoints, some at a time, and at last that this is the whole.
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
                // A reader that is not served yet asks again; one that is learns how.
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
