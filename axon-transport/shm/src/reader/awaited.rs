//! Memory of a publisher's session that a reader needs in order to continue and that has not come.

use std::time::{Duration, Instant};

/// Interval at which a reader asks for memory that has not come; also the time that it waits for the memory after it
/// learned that the publisher is gone.
const MISSING: Duration = Duration::from_secs(1);
/// Time that a reader waits for memory of a process that has ended without a report of that: the daemon hands over the
/// remaining memory of the process, and may be slow. The reader waits once for all of that memory.
const MISSING_DEAD: Duration = Duration::from_secs(10);

/// The segment that a reader waits for, if any, and the state of the wait.
#[derive(Default)]
pub(super) struct AwaitedSegment {
    missing: Option<Missing>,
    /// True if memory of the publisher's process, which has ended, was waited for in vain.
    waited: bool,
    /// True if the publisher is known to be gone.
    ended: bool,
}

/// A segment that the reader needs in order to continue.
#[derive(Clone, Copy)]
struct Missing {
    segment: u32,
    since: Instant,
    asked: Instant,
}

/// The reaction of a reader to a segment that has not come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wait {
    /// Asks for the segment, and waits.
    Ask,
    /// Waits for the segment.
    Longer,
    /// Stops waiting: the segment will not come.
    InVain,
}

impl AwaitedSegment {
    /// Returns the segment that the reader needs in order to continue and that has not come.
    #[inline]
    pub(super) fn segment(&self) -> Option<u32> {
        self.missing.map(|missing| missing.segment)
    }

    /// Returns when the reader looks again for it.
    #[inline]
    pub(super) fn look_again(&self) -> Option<Instant> {
        self.missing.map(|missing| missing.asked + MISSING)
    }

    /// Records that the reader needs no segment in order to continue.
    #[inline]
    pub(super) fn clear(&mut self) {
        self.missing = None;
    }

    /// Records that the publisher is gone, and that all of its memory was handed over: memory that does not come soon
    /// never will.
    pub(super) fn end(&mut self) {
        if !std::mem::replace(&mut self.ended, true) {
            // The next take asks for it once more, and waits for the answer.
            self.clear();
        }
    }

    /// Returns the reaction to a segment that the reader needs and that has not come. `is_dead` finds out whether the
    /// publisher's process has ended, by a system call.
    pub(super) fn handle_missing(
        &mut self,
        segment: u32,
        now: Instant,
        is_dead: impl Fn() -> bool,
    ) -> Wait {
        let Some(missing) = self.missing.as_mut().filter(|missing| missing.segment == segment)
        else {
            self.missing = Some(Missing { segment, since: now, asked: now });
            return Wait::Ask;
        };
        let waited = now.duration_since(missing.since);
        // The wait is two intervals long, because the reader asks a second time in between.
        let dead = if self.waited { MISSING } else { MISSING_DEAD };
        if self.ended && waited >= 2 * MISSING || waited >= dead && is_dead() {
            self.waited |= is_dead();
            return Wait::InVain;
        }
        if now.duration_since(missing.asked) < MISSING {
            return Wait::Longer;
        }
        missing.asked = now;
        Wait::Ask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The reactions of the reader, by the second since it found the segment missing.
    fn waits(awaited: &mut AwaitedSegment, segment: u32, seconds: u64, is_dead: bool) -> Vec<Wait> {
        let start = Instant::now();
        let at = |second| start + Duration::from_secs(second);
        (0..=seconds)
            .map(|second| awaited.handle_missing(segment, at(second), || is_dead))
            .collect()
    }

    #[test]
    fn a_reader_asks_once_a_second_as_long_as_the_publisher_lives() {
        let (mut awaited, start) = (AwaitedSegment::default(), Instant::now());
        let at = |tenth: u64| start + Duration::from_millis(100 * tenth);
        let asked = (0..1000)
            .filter(|tenth| awaited.handle_missing(1, at(*tenth), || false) == Wait::Ask)
            .collect::<Vec<_>>();
        assert_eq!(asked, (0..1000).step_by(10).collect::<Vec<_>>());
        assert_eq!((awaited.segment(), awaited.look_again()), (Some(1), Some(at(1000))));
        awaited.clear();
        assert_eq!((awaited.segment(), awaited.look_again()), (None, None));
    }

    #[test]
    fn a_reader_waits_once_for_all_memory_of_a_dead_process() {
        let mut awaited = AwaitedSegment::default();
        let first = waits(&mut awaited, 1, 10, true);
        assert_eq!((&first[..10], first[10]), (&[Wait::Ask; 10][..], Wait::InVain));
        assert_eq!(waits(&mut awaited, 2, 1, true), [Wait::Ask, Wait::InVain]);
    }

    #[test]
    fn reader_requests_each_segment_twice_after_the_end_of_the_writer() {
        let mut awaited = AwaitedSegment::default();
        assert_eq!(waits(&mut awaited, 1, 5, false), [Wait::Ask; 6]);
        awaited.end();
        assert_eq!(awaited.segment(), None);
        for segment in [1, 2] {
            let told = waits(&mut awaited, segment, 2, false);
            assert_eq!(told, [Wait::Ask, Wait::Ask, Wait::InVain]);
            awaited.end();
        }
    }
}
