//! The reader of one publisher's ring, and what the numbers of its samples tell.

use std::time::Duration;

use axon_shm::internal::{MAX_GAP, Reader};

use crate::session::clock;

/// What a writer's numbers tell of losses that the ring's positions do not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::session) enum NumberKind {
    None,
    /// It stands in for one elsewhere: what was lost on the way to its ring.
    All,
    /// What was lost since it was here before.
    Since,
    /// What was lost between the last sample that it brought before and its first. Later losses are said
    /// aloud.
    Between,
}

/// What the take that is under way found at a reader.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum TakeTurn {
    /// Nothing yet: the reader may have a sample.
    #[default]
    Open,
    /// No sample, since the writer was faster.
    Overtaken,
    /// There was no memory for the next sample. Later samples of the writer wait as well.
    Short,
}

/// A reader of a ring that a publisher granted.
pub(in crate::session) struct MatchedReader {
    pub(super) reader: Reader,
    /// When it was mapped: what was published before is no news. By the monotonic clock.
    pub(super) since: u64,
    /// The age at which its samples are not delivered any more.
    pub(super) lifespan: Option<Duration>,
    /// Within what the writer says that it is alive.
    pub(super) lease: Option<u64>,
    /// The writer is gone: take what it left, then unmap.
    pub(super) over: bool,
    /// It is gone, too, but what it left is still to come.
    pub(super) leaving: bool,
    pub(super) turn: TakeTurn,
    /// The last sequence number taken of its writer, by way of whatever reader; of one that was attached
    /// before and has taken nothing, the one in front of its first.
    pub(super) last: Option<u64>,
    /// The number in front of the first that this reader was granted.
    after: Option<u64>,
    /// The gaps in its numbers, where they tell of losses.
    gaps: Option<Gaps>,
    numbers: NumberKind,
    /// A number of its writer was known when it was granted.
    pub(super) resumed: bool,
    /// What was missing while they were looked at.
    missed: u64,
}

/// Samples of a publisher on another host that never came to the ring that stands in for it here:
/// numbers that no position of the ring has.
#[derive(Default)]
struct Gaps {
    /// Sequence number of the newest sample, and the position after that of the last one.
    before: Option<(u64, u64)>,
    lost: u64,
}

impl Gaps {
    /// A sample of this number was at this position.
    fn pass(&mut self, sequence: u64, position: u64) {
        let newest = self.before.map_or(sequence, |(newest, next)| {
            // What was overwritten on this side is counted there, by its positions.
            let missing = sequence.saturating_sub(newest).saturating_sub(1);
            let lost = missing.saturating_sub(position.saturating_sub(next));
            // The writer's process may say any number. A loss that cannot be is not counted.
            if missing <= MAX_GAP {
                self.lost = self.lost.saturating_add(lost);
            }
            newest.max(sequence)
        });
        self.before = Some((newest, position.saturating_add(1)));
    }
}

impl MatchedReader {
    /// A reader that was granted what comes `after` a number. `last` is the last number taken of a writer that was
    /// attached before, in which case the reader has `resumed`.
    pub(super) fn new(
        reader: Reader,
        after: Option<u64>,
        last: Option<u64>,
        resumed: bool,
        numbers: NumberKind,
    ) -> Self {
        let times = reader.times();
        let told = match numbers {
            NumberKind::None => false,
            NumberKind::All => true,
            NumberKind::Since | NumberKind::Between => resumed,
        };
        Self {
            since: clock::monotonic(),
            lifespan: times.lifespan.map(Duration::from_nanos),
            lease: times.lease,
            over: false,
            leaving: false,
            turn: TakeTurn::Open,
            last,
            // One that speaks for another has no number before it has a sample.
            after: after.filter(|number| *number > 0),
            gaps: told.then(Gaps::default),
            numbers,
            resumed,
            missed: 0,
            reader,
        }
    }

    /// Whether the writer is one of those that the subscription is matched with.
    pub(super) fn counts(&self) -> bool {
        !self.over && !self.leaving
    }

    /// A sample was taken.
    pub(super) fn passed(&mut self, sequence: u64) {
        let Some(gaps) = &mut self.gaps else { return };
        let position = self.reader.position().saturating_sub(1);
        if let (None, Some(last)) = (gaps.before, self.last) {
            gaps.before = Some((last, self.reader.grant().first));
        }
        gaps.pass(sequence, position);
        if self.numbers == NumberKind::Between {
            self.missed = gaps.lost;
            self.gaps = None;
        }
    }

    /// The number up to which nothing is to come any more.
    pub(super) fn reached(&self) -> Option<u64> {
        self.last.or(self.after)
    }

    /// Its samples that were lost, here and before they came here.
    pub(super) fn lost(&self) -> u64 {
        let before = self.gaps.as_ref().map_or(0, |gaps| gaps.lost);
        self.reader.lost().saturating_add(before).saturating_add(self.missed)
    }

    /// Whether its writer sends once more, in another ring than the `earlier` reader's, what was not confirmed.
    pub(super) fn sends_again(&self, earlier: &Self) -> bool {
        self.reader.writer() == earlier.reader.writer()
            && self.resumed
            && self.numbers != NumberKind::None
            && !self.reader.is_of_ring(&earlier.reader)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_without_a_position_was_lost_on_the_way() {
        let mut gaps = Gaps::default();
        for (sequence, position) in [(5, 0), (6, 1), (9, 2)] {
            gaps.pass(sequence, position);
        }
        assert_eq!(gaps.lost, 2, "7 and 8");
        // Overwritten here: numbers and positions are missing alike.
        gaps.pass(19, 12);
        assert_eq!(gaps.lost, 2);
        gaps.pass(30, 20);
        assert_eq!(gaps.lost, 5, "three of ten were lost on the way");
        // What comes again has a position, and makes up for no number.
        gaps.pass(29, 21);
        gaps.pass(30, 22);
        gaps.pass(32, 23);
        assert_eq!(gaps.lost, 6);
    }

    #[test]
    fn a_number_that_no_publisher_can_have_reached_is_no_loss() {
        let mut gaps = Gaps::default();
        gaps.pass(1, 0);
        gaps.pass(2 + MAX_GAP, 1);
        assert_eq!(gaps.lost, MAX_GAP);
        gaps.pass(u64::MAX, 2);
        assert_eq!(gaps.lost, MAX_GAP, "nobody lost 2^64 samples");
        gaps.pass(u64::MAX, 3);
        assert_eq!(gaps.lost, MAX_GAP);
    }
}
