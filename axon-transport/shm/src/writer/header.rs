//! The words of a ring's header that no reader needs to take a sample: counters and times.
//!
//! No other process can write them, so the publisher keeps no second copy. The counters change under the commit lock.
//! The daemon [reads](crate::ring::inspect) them for `axon status`; readers read the times.

use std::{sync::atomic::AtomicU64, time::Duration};

use crate::{
    alloc::heap::{Block, HeapObject},
    error::PublishError,
    ring::{
        layout::ring::{
            ASSERTED, BLOCKED, BYTES, NO_MEMORY, PINNED, PUBLISHED, REFUSED, SAMPLED, WINDOW,
        },
        times::{Times, read},
    },
    sync::{Ordering, Word},
};

/// A ring's header.
#[derive(Clone)]
pub(crate) struct RingHeader(HeapObject);

/// The reason why a sample was dropped, as `axon status` counts it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Dropped {
    /// A KEEP_ALL reader freed no space in time.
    Blocked,
    /// There was no memory.
    NoMemory,
    /// Readers pin, or loans hold, the existing memory.
    Pinned,
}

impl Dropped {
    /// Returns how a publish that failed with `error` counts. `deadline` is the time that it had: if that is zero, a
    /// blocked publish does not count, because its caller tries again.
    pub(super) fn by(error: &PublishError, deadline: Duration) -> Option<Self> {
        match error {
            PublishError::Blocked { .. } if !deadline.is_zero() => Some(Self::Blocked),
            PublishError::NoMemory { .. } | PublishError::Segment { .. } => Some(Self::NoMemory),
            PublishError::Pinned { .. } | PublishError::Loaned { .. } => Some(Self::Pinned),
            _ => None,
        }
    }
}

impl RingHeader {
    pub(super) fn new(ring: HeapObject) -> Self {
        Self(ring)
    }

    /// Returns the header's memory block.
    #[inline]
    pub(super) fn block(&self) -> &Block {
        &self.0.block
    }

    /// Returns the header's memory, for code that needs an object and does not use it.
    pub(super) fn object(&self) -> HeapObject {
        self.0.clone()
    }

    /// Returns the header's words, for the protocol between the publisher and its readers.
    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        self.0.words()
    }

    /// Counts `bytes` that the ring got from the session's memory.
    pub(super) fn add_bytes(&self, bytes: u64) {
        self.update(BYTES, |now| now.wrapping_add(bytes));
    }

    /// Counts `bytes` that the ring gave back to the session's memory.
    pub(super) fn subtract_bytes(&self, bytes: u64) {
        self.update(BYTES, |now| now.wrapping_sub(bytes));
    }

    /// Shows the window after the readers have changed.
    pub(super) fn show_window(&self, window: u64) {
        self.update(WINDOW, |_| window);
    }

    /// Shows the number of published samples, read or not.
    #[inline]
    pub(super) fn show_published(&self, samples: u64) {
        Word::store(&self.words()[PUBLISHED], samples, Ordering::Relaxed);
    }

    /// Counts a sample that should have been published or kept and was not.
    #[cold]
    pub(super) fn count(&self, dropped: Dropped) {
        let word = match dropped {
            Dropped::Blocked => BLOCKED,
            Dropped::NoMemory => NO_MEMORY,
            Dropped::Pinned => PINNED,
        };
        self.update(word, |now| now.wrapping_add(1));
    }

    /// Counts a publish that found no space because KEEP_ALL readers have not taken the oldest sample. It may wait for
    /// them.
    #[cold]
    pub(super) fn count_refused(&self) {
        self.update(REFUSED, |now| now.wrapping_add(1));
    }

    /// Records that a sample was published at `now`.
    #[inline]
    pub(super) fn note_sample(&self, now: u64) {
        Word::store(&self.words()[SAMPLED], now, Ordering::Relaxed);
    }

    /// Asserts the publisher's liveliness at `now`.
    #[inline]
    pub(super) fn assert(&self, now: u64) {
        Word::store(&self.words()[ASSERTED], now, Ordering::Relaxed);
    }

    /// Returns the times that its readers see.
    pub(super) fn times(&self) -> Times {
        read(self.words())
    }

    fn update(&self, word: usize, change: impl FnOnce(u64) -> u64) {
        // Relaxed: the number alone matters, and only this process writes it.
        let word = &self.words()[word];
        Word::store(word, change(Word::load(word, Ordering::Relaxed)), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        alloc::heap::Need,
        ids::{Gid, SessionId},
        ring::layout,
        session::segment::SessionSegment,
    };

    fn header() -> RingHeader {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        RingHeader::new(session.allocate(layout::RING, Need::Now, |_| true).unwrap().unwrap())
    }

    fn word(header: &RingHeader, word: usize) -> u64 {
        Word::load(&header.words()[word], Ordering::Relaxed)
    }

    #[test]
    fn each_counter_has_a_word_of_its_own() {
        let header = header();
        header.add_bytes(100);
        header.subtract_bytes(40);
        header.show_window(7);
        header.show_published(3);
        (0..9).for_each(|_| header.count_refused());
        for (dropped, times) in
            [(Dropped::Blocked, 1), (Dropped::NoMemory, 2), (Dropped::Pinned, 4)]
        {
            (0..times).for_each(|_| header.count(dropped));
        }
        let words = [BYTES, WINDOW, PUBLISHED, BLOCKED, NO_MEMORY, PINNED, REFUSED];
        assert_eq!(words.map(|at| word(&header, at)), [60, 7, 3, 1, 2, 4, 9]);
    }

    #[test]
    fn readers_see_when_a_publisher_was_alive_and_when_it_published() {
        let header = header();
        header.note_sample(5);
        header.assert(9);
        assert_eq!((word(&header, SAMPLED), word(&header, ASSERTED)), (5, 9));
        let times = header.times();
        header.assert(10);
        assert_ne!(header.times(), times);
    }

    #[test]
    fn a_caller_that_does_not_wait_drops_nothing_that_blocks() {
        let blocked = PublishError::Blocked { reader: Gid([1; 16]) };
        assert_eq!(Dropped::by(&blocked, Duration::ZERO), None);
        assert_eq!(Dropped::by(&blocked, Duration::from_millis(1)), Some(Dropped::Blocked));
        let loaned = PublishError::Loaned { loans: 1 };
        assert_eq!(Dropped::by(&loaned, Duration::ZERO), Some(Dropped::Pinned));
        let large = PublishError::TooLarge { len: 2, max: 1 };
        assert_eq!(Dropped::by(&large, Duration::MAX), None, "the caller's mistake");
    }
}
