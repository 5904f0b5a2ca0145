//! The journal of a session: it names the rings that got samples. A session that reads many rings follows it, so that
//! it looks only at rings with new samples.
//!
//! The journal is in the memory of the publishing session, which alone writes it. An entry names a ring and carries its
//! own number. A follower keeps its own position. If it finds another entry than the one that is due, it looks at all
//! rings of that session. There are four causes: the follower was overtaken; the thread that counted the entry has not
//! stored it yet; that thread died before it could; or the session breaks the protocol.
//!
//! The sample is stored before its entry is counted, so a follower that sees the count finds the sample, whether or not
//! it sees the entry. The count is stored before the look at the follower's ticket, so no wake-up is lost
//! ([`ticket`](crate::wake)).

use crate::sync::{Ordering, Site, Word};

/// The words of a session's journal.
pub(crate) struct Journal<'a, W> {
    /// The number of entries so far.
    pub(crate) noted: &'a W,
    /// The last entries. Their number is a power of two, or zero.
    pub(crate) entries: &'a [W],
}

impl<W> Clone for Journal<'_, W> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<W> Copy for Journal<'_, W> {}

/// Encodes entry number `place`, counted from 0. The upper half holds the lower 31 bits of the number, so that an entry
/// is not mistaken for a later one in the same slot, and a bit that marks the slot as used.
fn entry(place: u64, ring: u32) -> u64 {
    1 << 63 | place << 32 | u64::from(ring)
}

impl<W: Word> Journal<'_, W> {
    /// Publisher: notes that a ring has a sample. The caller then calls [`settle`](crate::wake::settle).
    #[inline]
    pub(crate) fn note(&self, ring: u32) {
        // Pairs with the load in `JournalCursor::read`: a follower that sees the count sees the sample.
        let place = self.noted.fetch_add(1, Site::NotedAdd.order());
        let at = place as usize & (self.entries.len() - 1);
        // A follower that sees the count but not yet the entry treats the entry as missing.
        self.entries[at].store(entry(place, ring), Ordering::Relaxed);
    }
}

/// A follower's position in a journal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct JournalCursor(u64);

/// The rings that a follower has to look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RingsToRead {
    /// The rings that were named in the call.
    Named,
    /// All rings of the session.
    All,
}

impl JournalCursor {
    /// Returns the end of a journal. Look at all rings after this call.
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
            // Relaxed: the count orders the sample. The entry is a single word that carries its own number.
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
        // The entry is counted but not stored. Also covers a session that sets the count back or far ahead.
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
