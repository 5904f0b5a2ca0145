//! The flows that cannot send because a stream, a key, or space in their queue is missing.

use std::{collections::BTreeSet, time::Duration};

use crate::engine::{outbound::budget::Budget, rank::FlowId};

/// Time after which a flow without a key looks again, unless a key is reported before.
const KEY_RETRY: Duration = Duration::from_millis(250);

/// The flows, by the resource that they lack.
#[derive(Debug)]
pub(super) struct BlockedFlows {
    stream: BTreeSet<FlowId>,
    key: BTreeSet<FlowId>,
    key_retry: Option<Duration>,
    room: BTreeSet<FlowId>,
    /// The released bytes of the budget when the flows without space were last tried.
    released: usize,
}

impl BlockedFlows {
    /// Creates the set without flows.
    pub(super) fn new(budget: &Budget) -> Self {
        Self {
            stream: BTreeSet::new(),
            key: BTreeSet::new(),
            key_retry: None,
            room: BTreeSet::new(),
            released: budget.released(),
        }
    }

    /// Adds a flow to which the peer allows no stream.
    pub(super) fn stream(&mut self, flow: FlowId) {
        self.stream.insert(flow);
    }

    /// Adds a flow without a key for its next message.
    pub(super) fn key(&mut self, flow: FlowId, now: Duration) {
        self.key.insert(flow);
        self.key_retry.get_or_insert(now + KEY_RETRY);
    }

    /// Adds a flow whose queue has no space for its next sample.
    pub(super) fn room(&mut self, flow: FlowId) {
        self.room.insert(flow);
    }

    /// Forgets a flow that is gone.
    pub(super) fn forget(&mut self, flow: FlowId) {
        self.stream.remove(&flow);
        self.key.remove(&flow);
        self.room.remove(&flow);
    }

    /// Returns when flows without a key look for one again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.key_retry
    }

    /// Returns the number of flows that wait for a stream.
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

    /// Takes the flows that wait for space, if the budget released some since they were last tried.
    pub(super) fn take_for_room(&mut self, budget: &Budget) -> BTreeSet<FlowId> {
        let released = budget.released();
        if self.room.is_empty() || released == std::mem::replace(&mut self.released, released) {
            return BTreeSet::new();
        }
        std::mem::take(&mut self.room)
    }
}
