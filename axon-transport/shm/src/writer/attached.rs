//! One reader that is attached to a ring, and its progress.

use crate::{
    ring::{types::Grant, window::depth},
    session::{
        lane::{self, LaneId, LaneState, LaneView},
        reader_info::ReaderInfo,
    },
};

/// One reader of a ring.
pub(super) struct AttachedReader {
    pub(super) info: ReaderInfo,
    lane: LaneView,
    tenancy: LaneId,
    pub(super) grant: Grant,
    /// True if the reader carries samples to another process.
    pub(super) carries: bool,
    pub(super) dead: bool,
    /// The furthest position up to which a relay was seen to have delivered its samples or given them up.
    done: u64,
    given_up: LaneGivenUp,
}

/// The number of samples that a reader gave up, by its lane and by its session's messages. Both report the same
/// samples, one of them later.
#[derive(Debug, Default)]
struct LaneGivenUp {
    /// The number that was counted.
    counted: u64,
    /// The number that its session reported so far; `shown` is the number in its lane.
    told: u64,
    shown: u64,
}

impl LaneGivenUp {
    /// Records the total in its lane.
    fn show(&mut self, samples: u64) {
        self.shown = self.shown.max(samples);
    }

    /// Records that its session reported `samples` samples more. The total is at most `since`, the number of samples
    /// published since the reader attached.
    fn tell(&mut self, samples: u64, since: u64) {
        self.told = self.told.saturating_add(samples).min(since);
    }

    /// Counts the samples that were not counted, and returns their number. The total is never more than were published
    /// `since` the reader attached.
    fn count_new(&mut self, since: u64) -> u64 {
        let said = self.shown.max(self.told);
        let new = said.min(since).saturating_sub(self.counted);
        self.counted += new;
        new
    }
}

impl AttachedReader {
    /// Creates a reader that begins at its grant.
    pub(super) fn new(
        info: ReaderInfo,
        lane: LaneView,
        tenancy: LaneId,
        grant: Grant,
        carries: bool,
    ) -> Self {
        let (dead, done, given_up) = (false, grant.first, LaneGivenUp::default());
        Self { info, lane, tenancy, grant, carries, dead, done, given_up }
    }

    /// Returns the next position that the reader takes, as its lane reports it; `None` if it has left.
    pub(super) fn position(&self) -> Option<u64> {
        let lane = self.lane.words();
        match self.tenancy.standing(lane) {
            // It may have left between the two reads, and then it holds nothing.
            LaneState::Open => self.tenancy.cursor(lane),
            LaneState::Asked => Some(self.grant.first),
            LaneState::Left => None,
        }
    }

    /// Returns the [position](Self::position), limited to the reader's grant and to `head`. `head` may be a head from
    /// before the reader attached.
    pub(super) fn cursor(&self, head: u64) -> Option<u64> {
        self.position().map(|cursor| cursor.max(self.grant.first).min(head))
    }

    /// Returns whether it carries samples: to another host, or to or from a process that shares no memory.
    pub(super) fn is_carrier(&self) -> bool {
        self.carries || self.info.is_relay()
    }

    /// Returns the position below which a carrier has delivered its samples or given them up; `None` if a carrier that
    /// reads for itself has left and so wants nothing. Samples that a relay leaves are given up only when the daemon
    /// reports that.
    pub(super) fn delivered(&mut self, head: u64) -> Option<u64> {
        match &self.info.stands_for {
            Some(_) => Some(self.done_with(head)),
            None => self.cursor(head),
        }
    }

    /// Returns the position up to which a relay has delivered its samples or given them up. A relay that has left stays
    /// at the position last seen, until the daemon reports that it ended, or what it gave up.
    fn done_with(&mut self, head: u64) -> u64 {
        let position = self.position().filter(|position| *position < u64::MAX);
        // The cursor is read first: the samples that were given up below it are then counted with it.
        if let (Some(position), true) = (position, self.look_for_given_up()) {
            self.done = self.done.max(position);
        }
        self.done.min(head)
    }

    /// Records the number of given-up samples in its lane. Returns whether the lane still belongs to this reader.
    fn look_for_given_up(&mut self) -> bool {
        let shown = self.tenancy.given_up(self.lane.words());
        self.given_up.show(shown.unwrap_or_default());
        shown.is_some()
    }

    /// Returns the number of samples published since it attached.
    fn since(&self, head: u64) -> u64 {
        head.saturating_sub(self.grant.first)
    }

    /// Records that its session reported `samples` given-up samples more. Returns how many were not counted yet.
    pub(super) fn give_up(&mut self, samples: u64, head: u64) -> u64 {
        self.given_up.tell(samples, self.since(head));
        self.newly_given_up(head)
    }

    /// Counts the given-up samples that were not counted yet, and returns their number.
    pub(super) fn newly_given_up(&mut self, head: u64) -> u64 {
        self.look_for_given_up();
        self.given_up.count_new(self.since(head))
    }

    /// Returns the number of samples above this position that were not counted as given up.
    pub(super) fn left_above(&self, position: u64, head: u64) -> u64 {
        head.saturating_sub(position).saturating_sub(self.given_up.counted)
    }

    /// Returns the oldest position that it wants: KEEP_LAST skips samples beyond its depth.
    pub(super) fn floor(&self, head: u64) -> Option<u64> {
        let within = head.saturating_sub(depth(&self.info.qos));
        self.cursor(head).map(|cursor| cursor.max(within))
    }

    /// Returns whether it has mapped the publisher's segment of this number or a later one.
    pub(super) fn has_mapped(&self, number: u32) -> bool {
        self.info.peer.remote().is_none() || lane::mapped(self.lane.words()) >= u64::from(number)
    }

    /// Returns whether the reader belongs to another, living session and has not taken up its grant, though there are
    /// samples for it.
    pub(super) fn is_asking(&self, head: u64) -> bool {
        self.info.peer.remote().is_some_and(|peer| !peer.is_dead())
            && self.grant.first < head
            && self.tenancy.standing(self.lane.words()) == LaneState::Asked
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_that_lane_and_session_both_name_are_counted_once() {
        let mut given_up = LaneGivenUp::default();
        given_up.show(3);
        assert_eq!((given_up.count_new(100), given_up.count_new(100)), (3, 0));
        given_up.tell(2, 100);
        assert_eq!(given_up.count_new(100), 0, "the lane said it before");
        given_up.tell(4, 100);
        assert_eq!(given_up.count_new(100), 3);
        given_up.show(6);
        assert_eq!(given_up.count_new(100), 0, "the session said it before");
        given_up.show(2);
        given_up.show(7);
        assert_eq!((given_up.count_new(100), given_up.counted), (1, 7));
    }

    #[test]
    fn no_more_samples_are_given_up_than_were_published() {
        let mut given_up = LaneGivenUp::default();
        given_up.show(u64::MAX);
        assert_eq!((given_up.count_new(5), given_up.count_new(8)), (5, 3));
        let mut given_up = LaneGivenUp::default();
        given_up.tell(u64::MAX, 5);
        given_up.tell(u64::MAX, 5);
        assert_eq!(
            (given_up.count_new(5), given_up.count_new(8)),
            (5, 0),
            "bounded as it was told"
        );
    }
}
