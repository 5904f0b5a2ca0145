//! Queues the messages to sessions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    sync::Arc,
};

use super::{MAX_QUEUE, MAX_QUEUE_BYTES, Registry, STATUS_SLICE, SessionEntry};
use crate::{
    graph::Scope,
    ids::SessionId,
    wire::session::{Graph, Message, SessionRole, StatusPart},
};

/// Pairs of which a session is told at a time, and the rest of those of one endpoint.
pub(super) const PAIRS_TOGETHER: usize = 256;

/// A packet for a session.
#[derive(Clone, Debug)]
pub struct Output<F> {
    /// Its bytes.
    pub packet: Arc<[u8]>,
    /// What goes with it.
    pub descriptors: Vec<F>,
    /// The session's segment that it hands over and nothing else.
    pub(super) segment: Option<(SessionId, u32)>,
    /// Which it is of the packets that were queued for its session; 0 before it is.
    pub(super) number: u64,
}

impl<F: Clone> Registry<F> {
    /// The next packet for a session; `None` when there is none.
    ///
    /// A session that is behind is told everything anew: the graph, its matches or what was granted
    /// to its readers, and what readers asked of its writers, closed by a GRAPH without `more`. What
    /// it does not hear again is over. It is told a part at a time, when it has taken what waits for it:
    /// so the parts and what changes in between come in the order in which they were so.
    pub fn poll_output(&mut self, id: &SessionId) -> Option<Output<F>> {
        let entry = self.sessions.get_mut(id)?;
        if entry.queue.is_empty() {
            if entry.telling.is_some() {
                self.tell_pairs(id);
            } else if entry.behind || entry.resync {
                self.tell_everything(id);
            }
        }
        let entry = self.sessions.get_mut(id)?;
        let output = entry.queue.pop_front();
        entry.queued_bytes -= output.as_ref().map_or(0, |output| output.packet.len());
        if entry.queue.is_empty() && entry.telling.is_none() {
            entry.queue_limit = MAX_QUEUE;
            entry.bytes_limit = MAX_QUEUE_BYTES;
        }
        output.or_else(|| next_part(&mut entry.status))
    }

    /// Tells a session the status, part by part, as it takes them. It need not fit the queue: a
    /// large system's is of many megabytes.
    pub fn tell_status(&mut self, id: &SessionId, text: Arc<[u8]>) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.status = Some((text, 0));
            self.ready.insert(*id);
        }
    }

    /// Tells a session that asks once more the same status from its beginning; whether one is
    /// being told to it.
    pub fn repeat_status(&mut self, id: &SessionId) -> bool {
        let entry = self.sessions.get_mut(id);
        let status = entry.and_then(|entry| entry.status.as_mut());
        status.is_some_and(|(_, next)| {
            *next = 0;
            true
        })
    }

    /// Puts a packet back that could not be sent.
    pub fn return_output(&mut self, id: &SessionId, output: Output<F>) {
        let Some(entry) = self.sessions.get_mut(id) else { return };
        if Message::is_status(&output.packet) {
            if let Some((_, next)) = &mut entry.status {
                *next = next.saturating_sub(1);
            }
        } else {
            entry.queued_bytes += output.packet.len();
            entry.queue.push_front(output);
        }
    }

    /// Sessions that got something to be told since the last call.
    pub fn take_ready(&mut self) -> BTreeSet<SessionId> {
        std::mem::take(&mut self.ready)
    }

    /// Queues a message for one session.
    pub fn push(&mut self, to: &SessionId, message: &Message, descriptors: Vec<F>) {
        // It is told everything anew.
        if self.sessions.get(to).is_none_or(|entry| entry.behind) {
            return;
        }
        let Some(packet) = encode(message) else { return };
        let segment = match message {
            Message::Segment(opened) => Some((opened.session, opened.segment.number)),
            _ => None,
        };
        self.push_packet(to, Output { packet, descriptors, segment, number: 0 });
    }

    pub(super) fn push_shared(&mut self, to: &[SessionId], message: &Message) {
        if let Some(packet) = encode(message) {
            self.push_encoded(to, &packet);
        }
    }

    pub(super) fn push_encoded(&mut self, to: &[SessionId], packet: &Arc<[u8]>) {
        for id in to {
            let (packet, descriptors) = (Arc::clone(packet), Vec::new());
            self.push_packet(id, Output { packet, descriptors, segment: None, number: 0 });
        }
    }

    fn push_packet(&mut self, to: &SessionId, output: Output<F>) {
        let Some(entry) = self.sessions.get_mut(to) else { return };
        if entry.behind {
            return;
        }
        if entry.queue.len() >= entry.queue_limit || entry.queued_bytes >= entry.bytes_limit {
            self.mark_behind(to);
            return;
        }
        entry.queued_bytes += output.packet.len();
        entry.last_queued += 1;
        entry.queue.push_back(Output { number: entry.last_queued, ..output });
        self.ready.insert(*to);
    }

    /// Takes back what hands a segment over and waits for a session still. Whether there was any.
    pub(super) fn take_back(&mut self, to: &SessionId, of: &SessionId, number: u32) -> bool {
        let Some(entry) = self.sessions.get_mut(to) else { return false };
        let before = entry.queue.len();
        entry.queue.retain(|output| output.segment != Some((*of, number)));
        let taken = entry.queue.len() < before;
        if taken {
            entry.queued_bytes = entry.queue.iter().map(|output| output.packet.len()).sum();
        }
        taken
    }

    pub(super) fn mark_behind(&mut self, id: &SessionId) {
        if let Some(entry) = self.sessions.get_mut(id) {
            // There is no graph that a tool could be behind with.
            entry.behind = entry.role != SessionRole::Tool;
            entry.telling = None;
            entry.queue.clear();
            entry.queued_bytes = 0;
            self.ready.insert(*id);
        }
    }

    fn tell_everything(&mut self, id: &SessionId) {
        // Pending changes are part of the whole, and the others hear of them as usual.
        self.flush();
        let packets = self.whole_graph(id);
        let Some(entry) = self.sessions.get_mut(id) else { return };
        entry.behind = false;
        entry.resync = false;
        entry.known.clear();
        entry.telling = Some(entry.endpoints.iter().copied().collect());
        entry.queue_limit = usize::MAX;
        entry.bytes_limit = usize::MAX;
        for packet in packets {
            self.push_encoded(&[*id], &packet);
        }
        self.limit_queue(id);
    }

    /// Tells a session of pairs of its endpoints, some at a time, and at last that this is the whole.
    fn tell_pairs(&mut self, id: &SessionId) {
        let Some(entry) = self.sessions.get_mut(id) else { return };
        entry.queue_limit = usize::MAX;
        entry.bytes_limit = usize::MAX;
        let mut told = 0;
        while told < PAIRS_TOGETHER {
            let Some(entry) = self.sessions.get_mut(id) else { return };
            let Some(gid) = entry.telling.as_mut().and_then(Vec::pop) else {
                entry.telling = None;
                return self.tell_end(id);
            };
            let Some(local) = self.endpoints.get(&gid) else { continue };
            let mut pairs = self.prospective_pairs(&local.endpoint);
            pairs.retain(|pair| self.pairs.contains_key(pair));
            told += pairs.len();
            for pair in pairs {
                // A reader that is not served yet asks again; one that is learns how.
                if pair.reader == gid && !self.forward_grant(&pair) {
                    self.push(id, &Message::Match(pair), Vec::new());
                }
                if pair.writer == gid {
                    self.forward_attach(&pair);
                }
            }
        }
        self.limit_queue(id);
    }

    fn tell_end(&mut self, id: &SessionId) {
        let (added, removed) = (Vec::new(), Vec::new());
        let end =
            Graph { version: self.version, whole: false, added, removed, more: false, ended: None };
        self.push(id, &Message::Graph(end), Vec::new());
        self.limit_queue(id);
    }

    /// As much as usual may wait besides what waits now.
    fn limit_queue(&mut self, id: &SessionId) {
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.queue_limit = entry.queue.len() + MAX_QUEUE;
            entry.bytes_limit = entry.queued_bytes + MAX_QUEUE_BYTES;
        }
    }
}

/// The next part of a status, of which one without text has one, too.
fn next_part<F>(status: &mut Option<(Arc<[u8]>, u32)>) -> Option<Output<F>> {
    let (text, next) = status.as_mut()?;
    let parts = u32::try_from(text.len().div_ceil(STATUS_SLICE).max(1)).ok()?;
    if *next == parts {
        *status = None;
        return None;
    }
    let from = *next as usize * STATUS_SLICE;
    let slice = &text[from..text.len().min(from + STATUS_SLICE)];
    let part = Message::Status(StatusPart { part: *next, parts, text: slice.to_vec() });
    *next += 1;
    Some(Output { packet: encode(&part)?, descriptors: Vec::new(), segment: None, number: 0 })
}

pub(super) fn session_entry<F>(
    role: SessionRole,
    name: String,
    pid: u32,
    descriptors: Option<[F; 3]>,
    scope: Option<Scope>,
) -> SessionEntry<F> {
    SessionEntry {
        role,
        name,
        pid,
        scope,
        lists: BTreeSet::new(),
        endpoints: BTreeSet::new(),
        descriptors,
        segments: BTreeMap::new(),
        known: HashMap::new(),
        queue: VecDeque::new(),
        last_queued: 0,
        queue_limit: MAX_QUEUE,
        queued_bytes: 0,
        bytes_limit: MAX_QUEUE_BYTES,
        behind: false,
        resync: false,
        telling: None,
        pairs: 0,
        status: None,
        refused: false,
        short: false,
        relay: None,
    }
}

pub(super) fn encode(message: &Message) -> Option<Arc<[u8]>> {
    match message.encode() {
        Ok(packet) => Some(packet.into()),
        Err(error) => {
            // Everything that is stored is small enough to be passed on.
            tracing::error!(%error, "a control message could not be encoded");
            None
        }
    }
}
