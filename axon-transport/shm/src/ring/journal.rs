//! The journal of a session: which of its rings got samples. A session that reads many rings follows it, and so looks
//! at the rings that have news and at no others.
//!
//! The journal is in the memory of the session that publishes, which alone writes it. An entry names a ring, and says
//! which entry it is. A follower keeps its place itself. Where it finds another entry than the one that is due, it looks
//! at all rings of that session: it was overtaken, or the thread that counted the entry has not stored it, or died
//! before it could, or the session writes what it likes.
//!
//! The sample is stored before its entry is counted, so a follower that sees the count finds the sample, whether or not
//! it sees the entry. The count is stored before the look at the follower's ticket, so no wake-up is lost
//! ([`ticket`](crate::wake)).

use crate::sync::{Ordering, Site, Word};

/// The words of a session's journal.
pub(crate) struct Journal<'a, W> {
    /// How many entries there have been.
    pub(crate) noted: &'a W,
    /// The last of them: a power of two, or none.
    pub(crate) entries: &'a [W],
}

impl<W> Clone for Journal<'_, W> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<W> Copy for Journal<'_, W> {}

/// Entry number `place`, from 0: that number's lower 31 bits in the upper half, so that no entry is taken for a later one
/// in its place, and a bit that tells it from none.
fn entry(place: u64, ring: u32) -> u64 {
    1 << 63 | place << 32 | u64::from(ring)
}

impl<W: Word> Journal<'_, W> {
    /// Publisher: a ring has a sample. [`settle`](crate::wake::settle) has to follow.
    #[inline]
    pub(crate) fn note(&self, ring: u32) {
        // Pairs with the load in `JournalCursor::read`: who sees the count sees the sample.
        let place = self.noted.fetch_add(1, Site::NotedAdd.order());
        let at = place as usize & (self.entries.len() - 1);
        // An entry that is seen late is one that is missing.
        self.entries[at].store(entry(place, ring), Ordering::Relaxed);
    }
}

/// A follower's position in a journal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct JournalCursor(u64);

/// The rings that a follower has to look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RingsToRead {
    /// The rings that were named.
    Named,
    /// All rings of the session.
    All,
}

impl JournalCursor {
    /// The end of a journal. Look at all rings after it.
    pub(crate) fn end<W: Word>(journal: Journal<'_, W>) -> Self {
        // Pairs with the count in `note`.
        Self(journal.noted.load(Site::NotedLoad.order()))
    }

    /// Follower, after it has [armed](crate::wake::arm) its ticket: names the rings with entries since the last call.
    /// Look at the rings after it.
    pub(crate) fn read<W: Word>(
        &mut self,
        journal: Journal<'_, W>,
        mut named: impl FnMut(u32),
    ) -> RingsToRead {
        let Self(end) = Self::end(journal);
        let from = std::mem::replace(&mut self.0, end);
        let count = end.wrapping_sub(from);
        if count > journal.entries.len() as u64 {
            return RingsToRead::All;
        }
        for place in (0..count).map(|step| from.wrapping_add(step)) {
            let at = place as usize & (journal.entries.len() - 1);
            // Relaxed: the count orders the sample, and the entry is one word, which says which one it is.
            let found = journal.entries[at].load(Ordering::Relaxed);
            let ring = found as u32;
            if found != entry(place, ring) {
                return RingsToRead::All;
            }
            named(ring);
        }
        RingsToRead::Named
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;

    struct Words(AtomicU64, Vec<AtomicU64>);

    impl Words {
        fn new() -> Self {
            Self(AtomicU64::new(0), (0..4).map(|_| AtomicU64::new(0)).collect())
        }

        fn journal(&self) -> Journal<'_, AtomicU64> {
            Journal { noted: &self.0, entries: &self.1 }
        }

        fn read(&self, place: &mut JournalCursor) -> (RingsToRead, Vec<u32>) {
            let mut rings = Vec::new();
            (place.read(self.journal(), |ring| rings.push(ring)), rings)
        }
    }

    #[test]
    fn a_follower_is_named_each_ring_that_was_noted_since_it_looked() {
        let words = Words::new();
        let mut place = JournalCursor::end(words.journal());
        for round in 0..10 {
            words.journal().note(round);
            words.journal().note(7);
            assert_eq!(words.read(&mut place), (RingsToRead::Named, vec![round, 7]));
        }
        assert_eq!(words.read(&mut place), (RingsToRead::Named, vec![]));
    }

    #[test]
    fn a_follower_that_was_overtaken_looks_at_all_rings_once() {
        let words = Words::new();
        let mut place = JournalCursor::end(words.journal());
        (0..5).for_each(|ring| words.journal().note(ring));
        assert_eq!(words.read(&mut place).0, RingsToRead::All);
        words.journal().note(9);
        assert_eq!(words.read(&mut place), (RingsToRead::Named, vec![9]));
    }

    #[test]
    fn an_entry_that_is_missing_or_forged_has_all_rings_looked_at() {
        let words = Words::new();
        let mut place = JournalCursor::end(words.journal());
        // Counted, and not stored: also as the session writes it that counts back or far ahead.
        for noted in [1, 0, u64::MAX, 5] {
            words.0.store(noted, Ordering::Relaxed);
            assert_eq!(words.read(&mut place).0, RingsToRead::All, "{noted}");
        }
        words.1.iter().for_each(|word| word.store(u64::MAX, Ordering::Relaxed));
        words.0.store(6, Ordering::Relaxed);
        assert_eq!(words.read(&mut place).0, RingsToRead::All);
        words.journal().note(3);
        assert_eq!(words.read(&mut place), (RingsToRead::Named, vec![3]));
    }
}
