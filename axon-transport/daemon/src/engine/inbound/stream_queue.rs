//! A queue of streams, each at most once.

use std::collections::{HashSet, VecDeque};

use super::StreamKey;

/// A queue of streams.
#[derive(Debug, Default)]
pub(super) struct StreamQueue {
    order: VecDeque<StreamKey>,
    all: HashSet<StreamKey>,
}

impl StreamQueue {
    /// Adds a stream behind the others, unless it is in the queue.
    pub(super) fn add(&mut self, key: StreamKey) {
        if self.all.insert(key) {
            self.order.push_back(key);
        }
    }

    /// Removes a stream.
    pub(super) fn remove(&mut self, key: &StreamKey) {
        if self.all.remove(key) {
            self.order.retain(|other| other != key);
        }
    }

    /// Removes and returns all streams, in order.
    pub(super) fn take(&mut self) -> VecDeque<StreamKey> {
        self.all.clear();
        std::mem::take(&mut self.order)
    }

    /// Returns whether the queue is empty.
    pub(super) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Returns the streams in the queue.
    pub(super) fn iter(&self) -> impl Iterator<Item = &StreamKey> {
        self.order.iter()
    }

    /// Returns the number of streams in the queue.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.order.len()
    }
}
