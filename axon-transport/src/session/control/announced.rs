//! What one connection's daemon and session have told each other.

use std::collections::{BTreeSet, HashSet};

use crate::{ids::Gid, wire::session::Pair};

/// The pairs that the daemon of this connection has told of. What it never told of stands by the word of an earlier
/// one, and this one may know nothing of it yet: a stopped process has not come back.
#[derive(Debug, Default)]
pub(super) struct AnnouncedPairs {
    told: HashSet<Pair>,
    /// Those that it repeated since it began to tell everything anew.
    repeated: Option<HashSet<Pair>>,
    /// Whether it has told everything already.
    whole: bool,
}

impl AnnouncedPairs {
    /// The daemon begins to tell everything. One that tells everything to a session it knew repeats every pair that
    /// it told it of. A new daemon learns of the pairs from their two sides, one by one.
    pub(super) fn begin_whole(&mut self) {
        self.repeated = self.whole.then(HashSet::new);
        self.whole = true;
    }

    /// The daemon says that a pair stands, or is to.
    pub(super) fn tell(&mut self, pair: Pair) {
        self.told.insert(pair);
        if let Some(repeated) = &mut self.repeated {
            repeated.insert(pair);
        }
    }

    /// The daemon says that a pair is over.
    pub(super) fn remove(&mut self, pair: &Pair) {
        self.told.remove(pair);
    }

    /// Endpoints ended.
    pub(super) fn remove_endpoints(&mut self, gids: &HashSet<Gid>) {
        self.told.retain(|pair| !gids.contains(&pair.reader) && !gids.contains(&pair.writer));
    }

    /// The daemon has told everything. If it did so before, returns the pairs that it did not repeat: they are over.
    pub(super) fn end_whole(&mut self) -> Option<HashSet<Pair>> {
        let repeated = self.repeated.take()?;
        let mut over = std::mem::replace(&mut self.told, repeated);
        over.retain(|pair| !self.told.contains(pair));
        Some(over)
    }
}

/// The segments of the session's memory that this connection's daemon was told of, and those that it could not be told
/// of, for want of descriptors. None is both.
#[derive(Debug, Default)]
pub(super) struct AnnouncedSegments {
    told: BTreeSet<u32>,
    untold: BTreeSet<u32>,
}

impl AnnouncedSegments {
    pub(super) fn is_told(&self, number: u32) -> bool {
        self.told.contains(&number)
    }

    /// Whether there are none that the daemon could not be told of.
    pub(super) fn are_complete(&self) -> bool {
        self.untold.is_empty()
    }

    /// Those that the daemon could not be told of.
    pub(super) fn untold(&self) -> Vec<u32> {
        self.untold.iter().copied().collect()
    }

    /// The daemon is told of one.
    pub(super) fn tell(&mut self, number: u32) {
        self.untold.remove(&number);
        self.told.insert(number);
    }

    /// The daemon cannot be told of one. Returns whether that is new.
    pub(super) fn fail(&mut self, number: u32) -> bool {
        self.untold.insert(number)
    }

    /// Forgets a segment that this session gave up.
    pub(super) fn remove(&mut self, number: u32) {
        self.told.remove(&number);
        self.untold.remove(&number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::SessionId;

    fn pair(number: u32) -> Pair {
        let [reader, writer] = [1, 2].map(|session| Gid::new(SessionId([session; 16]), number));
        Pair { reader, writer }
    }

    #[test]
    fn pairs_that_the_daemon_does_not_repeat_are_over() {
        let mut pairs = AnnouncedPairs::default();
        pairs.begin_whole();
        (1..4).for_each(|number| pairs.tell(pair(number)));
        assert_eq!(pairs.end_whole(), None, "the first time there is nothing to repeat");
        pairs.begin_whole();
        pairs.tell(pair(1));
        pairs.tell(pair(4));
        assert_eq!(pairs.end_whole(), Some([pair(2), pair(3)].into()));
        assert_eq!(pairs.end_whole(), None, "a change tells no whole");
        pairs.begin_whole();
        assert_eq!(pairs.end_whole(), Some([pair(1), pair(4)].into()));
    }

    #[test]
    fn a_pair_that_ended_meanwhile_is_not_over_once_more() {
        let mut pairs = AnnouncedPairs::default();
        pairs.begin_whole();
        (1..4).for_each(|number| pairs.tell(pair(number)));
        pairs.end_whole();
        pairs.remove(&pair(1));
        pairs.remove_endpoints(&[pair(2).reader, pair(3).writer].into());
        pairs.begin_whole();
        assert_eq!(pairs.end_whole(), Some(HashSet::new()));
    }

    #[test]
    fn a_restarted_full_update_forgets_the_pairs_repeated_before() {
        let mut pairs = AnnouncedPairs::default();
        pairs.begin_whole();
        pairs.tell(pair(1));
        pairs.end_whole();
        pairs.begin_whole();
        pairs.tell(pair(1));
        pairs.begin_whole();
        assert_eq!(pairs.end_whole(), Some([pair(1)].into()));
    }

    #[test]
    fn a_segment_that_could_not_be_told_of_is_told_later_or_given_up() {
        let mut segments = AnnouncedSegments::default();
        assert!(segments.fail(1) && !segments.fail(1) && segments.fail(2));
        assert_eq!(segments.untold(), [1, 2]);
        segments.tell(1);
        assert!(segments.is_told(1) && !segments.is_told(2) && !segments.are_complete());
        segments.remove(2);
        assert!(segments.are_complete());
        segments.remove(1);
        assert!(!segments.is_told(1));
    }
}
