//! One reader that is attached to a ring, and how far it is.

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
    /// Carries samples to another process.
    pub(super) carries: bool,
    pub(super) dead: bool,
    /// Of a relay: the furthest position that it was seen to be done with.
    done: u64,
    given_up: LaneGivenUp,
}

/// The samples that a reader gave up, by its lane and by what its session said: both say the same, one of them later.
#[derive(Debug, Default)]
struct LaneGivenUp {
    /// How many were counted.
    counted: u64,
    /// How many its session said so far that it gave up, and how many its lane says.
    told: u64,
    shown: u64,
}

impl LaneGivenUp {
    /// Its lane says that it gave up so many in all.
    fn show(&mut self, samples: u64) {
        self.shown = self.shown.max(samples);
    }

    /// Its session says that it gave up so many more, of those that were published `since` it came.
    fn tell(&mut self, samples: u64, since: u64) {
        self.told = self.told.saturating_add(samples).min(since);
    }

    /// How many there are that were not counted. Never more than were published `since` it came.
    fn count_new(&mut self, since: u64) -> u64 {
        let said = self.shown.max(self.told);
        let new = said.min(since).saturating_sub(self.counted);
        self.counted += new;
        new
    }
}

impl AttachedReader {
    /// A reader that begins where it was granted to.
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

    /// The next position that the reader takes, as it says; `None` when it has left.
    pub(super) fn position(&self) -> Option<u64> {
        let lane = self.lane.words();
        match self.tenancy.standing(lane) {
            // It may have left between the two looks, and then it holds nothing.
            LaneState::Open => self.tenancy.cursor(lane),
            LaneState::Asked => Some(self.grant.first),
            LaneState::Left => None,
        }
    }

    /// The same within what it may say, and up to `head`: which may be one of before it was attached.
    pub(super) fn cursor(&self, head: u64) -> Option<u64> {
        self.position().map(|cursor| cursor.max(self.grant.first).min(head))
    }

    /// Whether it takes samples elsewhere: to another host, or to or from a process that shares no memory.
    pub(super) fn is_carrier(&self) -> bool {
        self.carries || self.info.is_relay()
    }

    /// Of a carrier: below this it is done. One that read for itself and has left wants nothing; what a
    /// relay leaves is given up by the daemon's word only.
    pub(super) fn delivered(&mut self, head: u64) -> Option<u64> {
        match &self.info.stands_for {
            Some(_) => Some(self.done_with(head)),
            None => self.cursor(head),
        }
    }

    /// Of a relay: up to where it is done. One that has left is where it was seen last, until the daemon
    /// says that it ended, or what it gave up.
    fn done_with(&mut self, head: u64) -> u64 {
        let position = self.position().filter(|position| *position < u64::MAX);
        // In this order. What was seen of the cursor counts with what was given up below it.
        if let (Some(position), true) = (position, self.look_for_given_up()) {
            self.done = self.done.max(position);
        }
        self.done.min(head)
    }

    /// Notes what its lane says that it gave up; whether the lane still says that of this reader.
    fn look_for_given_up(&mut self) -> bool {
        let shown = self.tenancy.given_up(self.lane.words());
        self.given_up.show(shown.unwrap_or_default());
        shown.is_some()
    }

    /// How many samples were published since it came.
    fn since(&self, head: u64) -> u64 {
        head.saturating_sub(self.grant.first)
    }

    /// Its session says that it gave up so many samples more. Returns how many were not counted.
    pub(super) fn give_up(&mut self, samples: u64, head: u64) -> u64 {
        self.given_up.tell(samples, self.since(head));
        self.newly_given_up(head)
    }

    /// How many samples it gave up that were not counted.
    pub(super) fn newly_given_up(&mut self, head: u64) -> u64 {
        self.look_for_given_up();
        self.given_up.count_new(self.since(head))
    }

    /// How many samples above this position were not counted as given up.
    pub(super) fn left_above(&self, position: u64, head: u64) -> u64 {
        head.saturating_sub(position).saturating_sub(self.given_up.counted)
    }

    /// The oldest position that it wants: KEEP_LAST passes over what is beyond its depth.
    pub(super) fn floor(&self, head: u64) -> Option<u64> {
        let within = head.saturating_sub(depth(&self.info.qos));
        self.cursor(head).map(|cursor| cursor.max(within))
    }

    /// Whether it has got one of the publisher's segments of this number or a later one.
    pub(super) fn has_mapped(&self, number: u32) -> bool {
        self.info.peer.remote().is_none() || lane::mapped(self.lane.words()) >= u64::from(number)
    }

    /// Whether its session is another one that lives and has not taken up the grant, though there are samples for it.
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
