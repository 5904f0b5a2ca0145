//! The flows that cannot send because something is missing: a stream, a key, or room in their queue.

use std::{collections::BTreeSet, time::Duration};

use crate::engine::outbound::{budget::Budget, schedule::FlowId};

/// A flow without a key looks again after this time, if nobody told it of one.
const KEY_RETRY: Duration = Duration::from_millis(250);

/// The flows, by what they are without.
#[derive(Debug)]
pub(super) struct BlockedFlows {
    stream: BTreeSet<FlowId>,
    key: BTreeSet<FlowId>,
    key_retry: Option<Duration>,
    room: BTreeSet<FlowId>,
    /// What the budget had released when the flows without room were tried last.
    released: usize,
}

impl BlockedFlows {
    /// No flow lacks anything.
    pub(super) fn new(budget: &Budget) -> Self {
        Self {
            stream: BTreeSet::new(),
            key: BTreeSet::new(),
            key_retry: None,
            room: BTreeSet::new(),
            released: budget.released(),
        }
    }

    /// The peer allows this flow no stream.
    pub(super) fn stream(&mut self, flow: FlowId) {
        self.stream.insert(flow);
    }

    /// There is no key for this flow's next message.
    pub(super) fn key(&mut self, flow: FlowId, now: Duration) {
        self.key.insert(flow);
        self.key_retry.get_or_insert(now + KEY_RETRY);
    }

    /// This flow's queue has no room for its next sample.
    pub(super) fn room(&mut self, flow: FlowId) {
        self.room.insert(flow);
    }

    /// A flow is gone.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.stream.remove(&flow);
        self.key.remove(&flow);
        self.room.remove(&flow);
    }

    /// When flows without a key look for one again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.key_retry
    }

    /// How many flows wait for a stream.
    pub(super) fn waits_for_stream(&self) -> usize {
        self.stream.len()
    }

    /// Takes the flows that wait for a stream.
    pub(super) fn take_for_stream(&mut self) -> BTreeSet<FlowId> {
        std::mem::take(&mut self.stream)
    }

    /// Takes the flows that wait for a key.
    pub(super) fn take_for_key(&mut self) -> BTreeSet<FlowId> {
        self.key_retry = None;
        std::mem::take(&mut self.key)
    }

    /// Takes the flows that wait for room, if the budget has more than when they were tried last.
    pub(super) fn take_for_room(&mut self, budget: &Budget) -> BTreeSet<FlowId> {
        let released = budget.released();
        if self.room.is_empty() || released == std::mem::replace(&mut self.released, released) {
            return BTreeSet::new();
        }
        std::mem::take(&mut self.room)
    }
}
