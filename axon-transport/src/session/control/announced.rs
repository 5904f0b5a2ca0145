//! The pairs and segments that the daemon and the session announced to each other over one connection.

use std::collections::{BTreeSet, HashSet};

use crate::{ids::Gid, wire::session::Pair};

/// The pairs that the daemon of this connection announced. All other pairs were announced by an earlier daemon. This
/// daemon may not know them yet, because a stopped process has not reconnected.
#[derive(Debug, Default)]
pub(super) struct AnnouncedPairs {
    told: HashSet<Pair>,
    /// The pairs that the daemon repeated since it began to announce everything again.
    repeated: Option<HashSet<Pair>>,
    /// True once the daemon has begun to announce everything.
    whole: bool,
}

impl AnnouncedPairs {
    /// Begins a full announcement by the daemon. A daemon that announces everything to a session that it knew repeats
    /// each pair that it announced. A new daemon learns the pairs from their two ends, one by one.
    pub(super) fn begin_whole(&mut self) {
        self.repeated = self.whole.then(HashSet::new);
        self.whole = true;
    }

    /// Records that the daemon announced a pair that exists or is to be created.
    pub(super) fn tell(&mut self, pair: Pair) {
        self.told.insert(pair);
        if let Some(repeated) = &mut self.repeated {
            repeated.insert(pair);
        }
    }

    /// Records that the daemon ended a pair.
    pub(super) fn remove(&mut self, pair: &Pair) {
        self.told.remove(pair);
    }

    /// Removes the pairs of endpoints that ended.
    pub(super) fn remove_endpoints(&mut self, gids: &HashSet<Gid>) {
        self.told.retain(|pair| !gids.contains(&pair.reader) && !gids.contains(&pair.writer));
    }

    /// Ends a full announcement. If it was not the first one, returns the pairs that the daemon did not repeat, which
    /// have ended.
    pub(super) fn end_whole(&mut self) -> Option<HashSet<Pair>> {
        let repeated = self.repeated.take()?;
        let mut over = std::mem::replace(&mut self.told, repeated);
        over.retain(|pair| !self.told.contains(pair));
        Some(over)
    }
}

/// The segments of the session's memory that were announced to this connection's daemon, and those that could not be
/// announced for lack of descriptors. No segment is in both sets.
#[derive(Debug, Default)]
pub(super) struct AnnouncedSegments {
    told: BTreeSet<u32>,
    untold: BTreeSet<u32>,
}

impl AnnouncedSegments {
    pub(super) fn is_told(&self, number: u32) -> bool {
        self.told.contains(&number)
    }

    /// Returns whether no segment's announcement failed.
    pub(super) fn are_complete(&self) -> bool {
        self.untold.is_empty()
    }

    /// Returns the segments that could not be announced.
    pub(super) fn untold(&self) -> Vec<u32> {
        self.untold.iter().copied().collect()
    }

    /// Records that a segment is announced to the daemon.
    pub(super) fn tell(&mut self, number: u32) {
        self.untold.remove(&number);
        self.told.insert(number);
    }

    /// Records that a segment cannot be announced to the daemon. Returns whether that is new.
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
