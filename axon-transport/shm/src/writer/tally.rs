//! The counters in a ring's header. No reader uses them; the daemon [reads](crate::ring::inspect) them for
//! `axon status`.
//!
//! No other process can write the counters, so the publisher keeps no second copy. It changes each of them under the
//! commit lock.

use std::time::Duration;

use crate::{
    error::PublishError,
    ring::layout::ring::{BLOCKED, BYTES, NO_MEMORY, PINNED, WINDOW},
    sync::{Ordering, Word},
    writer::{Writer, WriterState},
};

impl Writer {
    /// The session's memory gave the ring `bytes` more.
    pub(crate) fn add_bytes(&self, bytes: u64) {
        self.update(BYTES, |now| now.wrapping_add(bytes));
    }

    /// The session's memory has `bytes` of the ring's back.
    pub(crate) fn subtract_bytes(&self, bytes: u64) {
        self.update(BYTES, |now| now.wrapping_sub(bytes));
    }

    /// The readers have changed.
    pub(crate) fn show_window(&self, state: &WriterState) {
        self.update(WINDOW, |_| state.reader_set.window());
    }

    /// A publish that had `deadline` to succeed failed. A caller that gave it no time tries again, so
    /// nothing is dropped yet.
    #[cold]
    pub(crate) fn count_failure(&self, error: &PublishError, deadline: Duration) {
        let word = match error {
            PublishError::Blocked { .. } if !deadline.is_zero() => BLOCKED,
            PublishError::NoMemory { .. } | PublishError::Segment { .. } => NO_MEMORY,
            PublishError::Pinned { .. } | PublishError::Loaned { .. } => PINNED,
            _ => return,
        };
        let _lock = self.lock();
        self.update(word, |now| now.wrapping_add(1));
    }

    /// A sample that was to be kept went, since there was no memory for more descriptors.
    #[cold]
    pub(crate) fn count_short(&self) {
        self.update(NO_MEMORY, |now| now.wrapping_add(1));
    }

    fn update(&self, word: usize, change: impl FnOnce(u64) -> u64) {
        // Relaxed: the number alone matters, and only this process writes it.
        let word = &self.ring.words()[word];
        Word::store(word, change(Word::load(word, Ordering::Relaxed)), Ordering::Relaxed);
    }
}
