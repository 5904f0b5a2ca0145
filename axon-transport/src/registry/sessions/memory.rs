//! The segments of one session's memory, and the segments of other sessions that it holds.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use crate::{
    ids::{Gid, SessionId},
    registry::limits::MAX_SEGMENTS,
    wire::session::{Pair, Segment},
};

/// A segment of a session's memory.
#[derive(Clone, Debug)]
pub struct RegisteredSegment<F> {
    /// What it is.
    pub segment: Segment,
    /// Its descriptor.
    pub descriptor: F,
}

/// The segments of a session's memory besides the first, by number.
#[derive(Debug)]
pub struct OwnMemory<F> {
    segments: BTreeMap<u32, RegisteredSegment<F>>,
    /// The session was told that no more segments are taken, and has given none up since.
    short: bool,
}

/// Why a segment is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NotTaken {
    /// No session numbers a segment so.
    Number,
    /// There are as many as may be.
    Full,
}

impl<F> Default for OwnMemory<F> {
    fn default() -> Self {
        Self { segments: BTreeMap::new(), short: false }
    }
}

impl<F> OwnMemory<F> {
    /// The segments.
    pub fn iter(&self) -> impl Iterator<Item = &RegisteredSegment<F>> {
        self.segments.values()
    }

    /// How many there are: as many descriptors of the daemon's.
    pub fn len(&self) -> usize {
        self.segments.len()
    }

    /// Whether the session has its first segment alone.
    pub fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }

    /// The segment of a number.
    pub fn get(&self, number: u32) -> Option<&RegisteredSegment<F>> {
        self.segments.get(&number)
    }

    pub(super) fn open(&mut self, segment: Segment, descriptor: F) -> Result<(), NotTaken> {
        let number = segment.number;
        if number == 0 || self.segments.contains_key(&number) {
            return Err(NotTaken::Number);
        }
        if self.segments.len() >= MAX_SEGMENTS {
            return Err(NotTaken::Full);
        }
        self.segments.insert(number, RegisteredSegment { segment, descriptor });
        Ok(())
    }

    /// Returns whether there was such a segment.
    pub(super) fn close(&mut self, number: u32) -> bool {
        let closed = self.segments.remove(&number).is_some();
        self.short &= !closed;
        closed
    }

    /// Returns whether the session has to be told that a segment is refused: once until it gives one up.
    pub(super) fn note_short(&mut self) -> bool {
        !std::mem::replace(&mut self.short, true)
    }

    /// The segments in which a reader of `writer` looks.
    pub(super) fn numbers_for(&self, writer: &Gid) -> Vec<u32> {
        let concerns = |s: &&RegisteredSegment<F>| s.segment.publisher.is_none_or(|p| p == *writer);
        self.iter().filter(concerns).map(|s| s.segment.number).collect()
    }
}

/// What a session holds of the memory of others.
///
/// It holds the first descriptors of another session as long as a pair is between the two, and segments only of a
/// session whose descriptors it holds.
#[derive(Debug, Default)]
pub(in crate::registry) struct HeldMemory(HashMap<SessionId, HeldOf>);

/// What a session holds of another.
#[derive(Debug, Default)]
struct HeldOf {
    /// The pairs for which it does.
    pairs: HashSet<Pair>,
    /// The numbers of the segments that it was handed.
    segments: BTreeSet<u32>,
    /// Those of them for which it asked: it may have had them before.
    asked: BTreeSet<u32>,
}

impl HeldMemory {
    /// The session holds another's descriptors for `pair`. Returns whether it has to be handed them.
    pub(super) fn introduce(&mut self, of: SessionId, pair: Pair) -> bool {
        let pairs = &mut self.0.entry(of).or_default().pairs;
        let first = pairs.is_empty();
        pairs.insert(pair);
        first
    }

    /// A pair is over. With the last one the session lets go of the other's memory.
    pub(super) fn forget(&mut self, of: &SessionId, pair: &Pair) {
        if let Some(held) = self.0.get_mut(of) {
            held.pairs.remove(pair);
            if held.pairs.is_empty() {
                self.0.remove(of);
            }
        }
    }

    /// The session lets go of everything.
    pub(in crate::registry) fn clear(&mut self) {
        self.0.clear();
    }

    /// The pairs with a session whose memory it holds.
    pub(super) fn pairs_with(&self, of: &SessionId) -> impl Iterator<Item = &Pair> {
        self.0.get(of).into_iter().flat_map(|held| &held.pairs)
    }

    /// Notes a segment as handed over. Returns whether it has to be.
    pub(super) fn hand(&mut self, of: &SessionId, number: u32) -> bool {
        self.0.get_mut(of).is_some_and(|held| held.segments.insert(number))
    }

    /// The session misses a segment. Returns whether it holds the other's memory at all.
    pub(super) fn miss(&mut self, of: &SessionId, number: u32) -> bool {
        let Some(held) = self.0.get_mut(of) else { return false };
        held.segments.remove(&number);
        true
    }

    /// Notes that the session asked for a segment, if it was handed that.
    pub(super) fn note_asked(&mut self, of: &SessionId, number: u32) {
        if let Some(held) = self.0.get_mut(of)
            && held.segments.contains(&number)
        {
            held.asked.insert(number);
        }
    }

    /// A segment is given up. Returns whether the session had asked for it; `None` if it was not handed it.
    pub(super) fn close(&mut self, of: &SessionId, number: u32) -> Option<bool> {
        let held = self.0.get_mut(of)?;
        held.segments.remove(&number).then(|| held.asked.remove(&number))
    }
}

#[cfg(test)]
impl HeldMemory {
    /// The pairs for which the session holds others' memory.
    pub(in crate::registry) fn pairs(&self) -> HashMap<SessionId, HashSet<Pair>> {
        self.0.iter().map(|(of, held)| (*of, held.pairs.clone())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OTHER: SessionId = SessionId([2; 16]);

    fn pair(number: u32) -> Pair {
        Pair { reader: Gid::new(SessionId([1; 16]), number), writer: Gid::new(OTHER, number) }
    }

    #[test]
    fn a_session_lets_go_of_memory_with_the_last_pair() {
        let mut held = HeldMemory::default();
        assert!(!held.hand(&OTHER, 1), "it holds nothing of the other");
        assert!(held.introduce(OTHER, pair(1)));
        assert!(!held.introduce(OTHER, pair(2)), "it has the descriptors");
        assert!(held.hand(&OTHER, 1));
        assert!(!held.hand(&OTHER, 1), "it has the segment");
        held.forget(&OTHER, &pair(1));
        assert_eq!(held.pairs_with(&OTHER).collect::<Vec<_>>(), [&pair(2)]);
        held.forget(&OTHER, &pair(2));
        assert!(held.pairs().is_empty());
        assert!(held.introduce(OTHER, pair(1)) && held.hand(&OTHER, 1), "all anew");
    }

    #[test]
    fn given_up_segment_reports_a_repeated_request() {
        let mut held = HeldMemory::default();
        assert!(!held.miss(&OTHER, 1));
        held.introduce(OTHER, pair(1));
        held.note_asked(&OTHER, 1);
        assert_eq!(held.close(&OTHER, 1), None, "it was not handed over");
        held.hand(&OTHER, 1);
        assert_eq!(held.close(&OTHER, 1), Some(false));
        held.hand(&OTHER, 1);
        assert!(held.miss(&OTHER, 1) && held.hand(&OTHER, 1));
        held.note_asked(&OTHER, 1);
        assert_eq!(held.close(&OTHER, 1), Some(true));
        held.hand(&OTHER, 1);
        assert_eq!(held.close(&OTHER, 1), Some(false), "the question is over with the segment");
    }

    #[test]
    fn segments_are_bounded_and_a_session_is_told_once_until_it_gives_one_up() {
        let mut own = OwnMemory::default();
        let open = |own: &mut OwnMemory<()>, number| {
            own.open(Segment { number, publisher: Some(Gid::new(OTHER, number % 2)) }, ())
        };
        assert_eq!(open(&mut own, 0), Err(NotTaken::Number), "the first comes with HELLO");
        for number in 1..=MAX_SEGMENTS as u32 {
            assert_eq!(open(&mut own, number), Ok(()));
        }
        assert_eq!(open(&mut own, 1), Err(NotTaken::Number));
        assert_eq!(open(&mut own, MAX_SEGMENTS as u32 + 1), Err(NotTaken::Full));
        assert_eq!(own.numbers_for(&Gid::new(OTHER, 1)).len(), MAX_SEGMENTS / 2);
        assert!(own.note_short());
        assert!(!own.close(0) && !own.note_short());
        assert!(own.close(1) && own.note_short());
    }
}
