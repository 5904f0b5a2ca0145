//! The reader of one publisher's ring, and the losses that the samples' numbers show.

use std::time::Duration;

use axon_shm::internal::{MAX_GAP, Reader};

use crate::session::clock;

/// The losses that a writer's numbers show and the ring's positions do not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::session) enum NumberKind {
    None,
    /// The writer is a local stand-in for a remote writer: the numbers show the losses on the way to its ring.
    All,
    /// The numbers show the losses since the writer was attached before.
    Since,
    /// The numbers show the losses between the last sample of the previous attachment and the first of this one. Later
    /// losses are reported explicitly.
    Between,
}

/// The result of the current take at one reader.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum TakeTurn {
    /// No result yet: the reader may have a sample.
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
    /// Time at which the ring was mapped, by the monotonic clock. Samples published before do not count for deadlines.
    pub(super) since: u64,
    /// The age above which its samples are not delivered any more.
    pub(super) lifespan: Option<Duration>,
    /// The lease of the writer: it asserts its liveliness at least that often. In nanoseconds.
    pub(super) lease: Option<u64>,
    /// True if the writer is gone: its remaining samples are taken, then the ring is unmapped.
    pub(super) over: bool,
    /// True if the writer is leaving, and some of its samples are still to come.
    pub(super) leaving: bool,
    pub(super) turn: TakeTurn,
    /// The last sequence number taken of its writer, by any reader. If the writer was attached before and no sample was
    /// taken, the number in front of its first sample.
    pub(super) last: Option<u64>,
    /// The number in front of the first sample that this reader was granted.
    after: Option<u64>,
    /// The gaps in the numbers, if they show losses.
    gaps: Option<Gaps>,
    numbers: NumberKind,
    /// True if a number of the writer was known when the reader was granted.
    pub(super) resumed: bool,
    /// Losses that the numbers showed while they were examined.
    missed: u64,
}

/// Samples of a publisher on another host that never came to the ring of its local stand-in: numbers without a position
/// in the ring.
#[derive(Default)]
struct Gaps {
    /// Sequence number of the newest sample, and the position behind the last one.
    before: Option<(u64, u64)>,
    lost: u64,
}

impl Gaps {
    /// Counts the numbers missing before the sample with this number at this position.
    fn pass(&mut self, sequence: u64, position: u64) {
        let newest = self.before.map_or(sequence, |(newest, next)| {
            // Samples overwritten on this side are counted by their positions.
            let missing = sequence.saturating_sub(newest).saturating_sub(1);
            let lost = missing.saturating_sub(position.saturating_sub(next));
            // The writer's process may send any number. A loss that is not possible is not counted.
            if missing <= MAX_GAP {
                self.lost = self.lost.saturating_add(lost);
            }
            newest.max(sequence)
        });
        self.before = Some((newest, position.saturating_add(1)));
    }
}

impl MatchedReader {
    /// Creates a reader that was granted the samples `after` a number. `last` is the last number taken of a writer that
    /// was attached before, in which case the reader has `resumed`.
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
            // A stand-in has no number before it has a sample.
            after: after.filter(|number| *number > 0),
            gaps: told.then(Gaps::default),
            numbers,
            resumed,
            missed: 0,
            reader,
        }
    }

    /// Returns whether the subscription counts as matched with the writer.
    pub(super) fn counts(&self) -> bool {
        !self.over && !self.leaving
    }

    /// Records that a sample was taken.
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

    /// Returns the number up to which no sample is to come any more.
    pub(super) fn reached(&self) -> Option<u64> {
        self.last.or(self.after)
    }

    /// Returns the writer's samples that were lost, in this ring and before they came to it.
    pub(super) fn lost(&self) -> u64 {
        let before = self.gaps.as_ref().map_or(0, |gaps| gaps.lost);
        self.reader.lost().saturating_add(before).saturating_add(self.missed)
    }

    /// Returns whether its writer sends the unconfirmed samples once more, in another ring than the `earlier` reader's.
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
        // Overwritten in this ring: numbers and positions are missing alike.
        gaps.pass(19, 12);
        assert_eq!(gaps.lost, 2);
        gaps.pass(30, 20);
        assert_eq!(gaps.lost, 5, "three of ten were lost on the way");
        // A repeated sample has a position, and makes up for no number.
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
