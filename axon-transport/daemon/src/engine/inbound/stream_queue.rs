//! Streams that wait in line, each once.

use std::collections::{HashSet, VecDeque};

use super::StreamKey;

/// A line of streams.
#[derive(Debug, Default)]
pub(super) struct StreamQueue {
    order: VecDeque<StreamKey>,
    all: HashSet<StreamKey>,
}

impl StreamQueue {
    /// Adds a stream behind the others, unless it is in line.
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

    /// Removes all, in order.
    pub(super) fn take(&mut self) -> VecDeque<StreamKey> {
        self.all.clear();
        std::mem::take(&mut self.order)
    }

    /// Whether nobody is in line.
    pub(super) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// The streams in line.
    pub(super) fn iter(&self) -> impl Iterator<Item = &StreamKey> {
        self.order.iter()
    }

    /// How many are in line.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.order.len()
    }
}
