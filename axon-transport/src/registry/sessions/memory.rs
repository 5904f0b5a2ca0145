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
    /// The description of the segment.
    pub segment: Segment,
    /// The descriptor of the segment.
    pub descriptor: F,
}

/// The segments of a session's memory besides the first, by number.
#[derive(Debug)]
pub struct OwnMemory<F> {
    segments: BTreeMap<u32, RegisteredSegment<F>>,
    /// True if the session was told that a segment was refused, and has given up none since.
    short: bool,
}

/// The reason why a segment is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NotTaken {
    /// The number is invalid.
    Number,
    /// The session has the maximum number of segments.
    Full,
}

impl<F> Default for OwnMemory<F> {
    fn default() -> Self {
        Self { segments: BTreeMap::new(), short: false }
    }
}

impl<F> OwnMemory<F> {
    /// Returns the segments.
    pub fn iter(&self) -> impl Iterator<Item = &RegisteredSegment<F>> {
        self.segments.values()
    }

    /// Returns the number of segments. The daemon holds a descriptor for each.
    pub fn len(&self) -> usize {
        self.segments.len()
    }

    /// Returns whether the session has only its first segment.
    pub fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }

    /// Returns the segment with this number.
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

    /// Removes a segment. Returns whether it existed.
    pub(super) fn close(&mut self, number: u32) -> bool {
        let closed = self.segments.remove(&number).is_some();
        self.short &= !closed;
        closed
    }

    /// Returns whether the session has to be told that a segment is refused: once, until it gives up a segment.
    pub(super) fn note_short(&mut self) -> bool {
        !std::mem::replace(&mut self.short, true)
    }

    /// Returns the numbers of the segments that a reader of `writer` may access.
    pub(super) fn numbers_for(&self, writer: &Gid) -> Vec<u32> {
        let concerns = |s: &&RegisteredSegment<F>| s.segment.publisher.is_none_or(|p| p == *writer);
        self.iter().filter(concerns).map(|s| s.segment.number).collect()
    }
}

/// The memory of other sessions that a session holds.
///
/// It holds the first descriptors of another session as long as there is a pair between the two, and further segments
/// only of a session whose descriptors it holds.
#[derive(Debug, Default)]
pub(in crate::registry) struct HeldMemory(HashMap<SessionId, HeldOf>);

/// The memory of one other session that a session holds.
#[derive(Debug, Default)]
struct HeldOf {
    /// The pairs for which it holds the memory.
    pairs: HashSet<Pair>,
    /// The numbers of the segments that it was sent.
    segments: BTreeSet<u32>,
    /// The segments among them for which it asked, so that it may have had them before.
    asked: BTreeSet<u32>,
}

impl HeldMemory {
    /// Records that the session holds another's descriptors for `pair`. Returns whether they have to be sent.
    pub(super) fn introduce(&mut self, of: SessionId, pair: Pair) -> bool {
        let pairs = &mut self.0.entry(of).or_default().pairs;
        let first = pairs.is_empty();
        pairs.insert(pair);
        first
    }

    /// Removes a pair that has ended. With the last pair, the session no longer holds the other's memory.
    pub(super) fn forget(&mut self, of: &SessionId, pair: &Pair) {
        if let Some(held) = self.0.get_mut(of) {
            held.pairs.remove(pair);
            if held.pairs.is_empty() {
                self.0.remove(of);
            }
        }
    }

    /// Records that the session holds nothing any more.
    pub(in crate::registry) fn clear(&mut self) {
        self.0.clear();
    }

    /// Returns the pairs for which it holds the memory of a session.
    pub(super) fn pairs_with(&self, of: &SessionId) -> impl Iterator<Item = &Pair> {
        self.0.get(of).into_iter().flat_map(|held| &held.pairs)
    }

    /// Records a segment as sent. Returns whether it has to be sent.
    pub(super) fn hand(&mut self, of: &SessionId, number: u32) -> bool {
        self.0.get_mut(of).is_some_and(|held| held.segments.insert(number))
    }

    /// Records that the session misses a segment. Returns whether it holds the other's memory at all.
    pub(super) fn miss(&mut self, of: &SessionId, number: u32) -> bool {
        let Some(held) = self.0.get_mut(of) else { return false };
        held.segments.remove(&number);
        true
    }

    /// Records that the session asked for a segment, if it was sent that segment.
    pub(super) fn note_asked(&mut self, of: &SessionId, number: u32) {
        if let Some(held) = self.0.get_mut(of)
            && held.segments.contains(&number)
        {
            held.asked.insert(number);
        }
    }

    /// Removes a segment that was given up. Returns whether the session had asked for it; `None` if it was not sent it.
    pub(super) fn close(&mut self, of: &SessionId, number: u32) -> Option<bool> {
        let held = self.0.get_mut(of)?;
        held.segments.remove(&number).then(|| held.asked.remove(&number))
    }
}

#[cfg(test)]
impl HeldMemory {
    /// Returns the pairs for which the session holds others' memory.
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
