//! The lanes that may pin samples of a ring. A lane stays here until its reader has left or its process has
//! ended, even if the reader is detached, because it may still hold samples. The publisher reads the pins
//! under its lock.

use std::sync::{Arc, atomic::AtomicU64};

use crate::{
    alloc::pin_limit::{PinLimit, PinPool},
    error::ShmError,
    ids::{Gid, SessionId},
    ring::{
        layout::{LANE_WORDS, Location},
        pins,
    },
    session::{
        lane::{LaneId, LaneState, LaneView},
        peer::{PeerSession, RingPeer},
    },
    sync::Word,
};

/// Maximum number of lanes of one other process, because a publish may have to check each of them. The memory that they
/// may pin is [bounded](crate::alloc::pin_limit) separately.
pub(crate) const OF_PROCESS: usize = 1024;

/// The samples that readers pin: positions, and the longest sample that each pin keeps.
#[derive(Default)]
pub(crate) struct Pinned(Vec<(u64, u64)>);

impl Pinned {
    /// Collects the pins anew, with `look`.
    pub(crate) fn refresh(&mut self, look: impl FnOnce(&mut Self)) {
        self.0.clear();
        look(self);
        self.0.sort_unstable();
    }

    /// Returns whether a sample of `len` bytes is kept.
    pub(crate) fn keeps(&self, position: u64, len: u64) -> bool {
        // The pin of a position that keeps the longest sample comes last.
        let end = self.0.partition_point(|(pinned, _)| *pinned <= position);
        self.0[..end].last().is_some_and(|pin| pin.0 == position && len <= pin.1)
    }
}

/// Adds to `found` the positions that a reader pins, and returns the state of its lane. Call it after
/// [`pins::about_to_scan`].
#[inline]
pub(crate) fn scan<W: Word>(tenancy: &LaneId, lane: &[W], found: &mut Pinned) -> LaneState {
    let standing = tenancy.standing(lane);
    let longest = tenancy.pin_limit().longest();
    // A reader that has not seen its grant pins nothing; if it sees the grant from now on, it sees the tail.
    if standing == LaneState::Open && longest > 0 {
        found.0.extend(pins::scan(lane).map(|position| (position, longest)));
    }
    standing
}

/// A reader that keeps samples.
pub(crate) struct PinningReader {
    pub(crate) reader: Gid,
    /// The reader's session, unless it is the publisher's own.
    pub(crate) peer: Option<Arc<PeerSession>>,
}

impl PinningReader {
    /// Returns its process, read from the file system.
    pub(crate) fn process(&self) -> Option<u32> {
        self.peer.as_ref().map_or(Some(std::process::id()), |peer| peer.process())
    }
}

/// One reader's lane, as its publisher knows it.
pub(crate) struct PinLane {
    reader: Gid,
    session: SessionId,
    /// The reader's session; absent if it is the publisher's own.
    peer: Option<Arc<PeerSession>>,
    at: Location,
    lane: LaneView,
    pub(crate) tenancy: LaneId,
}

impl PinLane {
    fn words(&self) -> &[AtomicU64; LANE_WORDS] {
        self.lane.words()
    }

    fn is_dead(&self) -> bool {
        self.peer.as_ref().is_some_and(|peer| peer.is_dead())
    }

    #[inline]
    fn standing(&self) -> LaneState {
        self.tenancy.standing(self.words())
    }
}

/// All lanes with a grant, until their reader has left or its process has ended. Detaching a reader does not remove its
/// lane: the reader may still hold samples.
pub(crate) struct PinLanes {
    all: Vec<PinLane>,
    /// The memory that they may pin.
    pool: PinPool,
}

impl PinLanes {
    pub(crate) fn new(pool: PinPool) -> Self {
        Self { all: Vec::new(), pool }
    }

    /// Admits the reader that asks with the lane of `peer` at `at`, before it learns of its grant. While the lane stays
    /// unchanged, the answer stays the same, so a reader that keeps asking adds nothing.
    ///
    /// # Errors
    /// Its process has [as many](OF_PROCESS) as it may.
    pub(crate) fn admit(
        &mut self,
        reader: Gid,
        peer: &RingPeer,
        at: Location,
        lane: &LaneView,
    ) -> Result<LaneId, ShmError> {
        let session = peer.id();
        let same = |held: &&PinLane| {
            (held.session, held.reader, held.at) == (session, reader, at)
                && held.tenancy.is_asked(held.words())
        };
        if let Some(held) = self.all.iter().find(same) {
            return Ok(held.tenancy);
        }
        let mut pin_limit = PinLimit::ALL;
        if let Some(peer) = peer.remote() {
            let akin = |held: &&PinLane| held.peer.as_ref().is_some_and(|p| p.is_akin_to(peer));
            let is_full = |all: &[PinLane]| all.iter().filter(akin).count() >= OF_PROCESS;
            // Some readers may have left.
            self.sweep(|_| false);
            if is_full(&self.all) && (!self.sweep(|_| true) || is_full(&self.all)) {
                let what = "its process has as many readers of one publisher as it may";
                return Err(ShmError::Refused { what });
            }
            let cost = |held: &PinLane| self.pool.cost(held.tenancy.pin_limit());
            let others = self.all.iter().filter(|held| held.peer.is_some());
            let taken = others.map(cost).sum();
            pin_limit = self.pool.share(taken, self.all.iter().filter(akin).map(cost).sum());
        }
        let tenancy = LaneId::grant(lane.words(), pin_limit);
        let peer = peer.remote().cloned();
        self.all.push(PinLane { reader, session, peer, at, lane: lane.clone(), tenancy });
        Ok(tenancy)
    }

    /// Adds the pinned positions to `found`. Call it after [`pins::about_to_scan`].
    pub(crate) fn scan(&mut self, found: &mut Pinned) {
        self.all.retain(|held| scan(&held.tenancy, held.words(), found) != LaneState::Left);
    }

    /// Returns a reader that pins one of `positions`.
    pub(crate) fn holder(&self, positions: &[u64]) -> Option<PinningReader> {
        let holds = |held: &&PinLane| {
            held.standing() == LaneState::Open
                && pins::scan(held.words()).any(|position| positions.contains(&position))
        };
        self.all
            .iter()
            .find(holds)
            .map(|held| PinningReader { reader: held.reader, peer: held.peer.clone() })
    }

    /// Forgets lanes whose reader has left, and lanes of `suspect` readers whose process has ended. Returns whether
    /// there were any.
    pub(crate) fn sweep(&mut self, suspect: impl Fn(&PinLane) -> bool) -> bool {
        let before = self.all.len();
        self.all.retain(|held| {
            held.standing() != LaneState::Left && !(suspect(held) && held.is_dead())
        });
        self.all.len() != before
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Returns whether a reader in another session has yet to take a sample below this position, or to take up its
    /// grant.
    pub(crate) fn lag_behind(&self, head: u64) -> bool {
        self.all.iter().filter(|held| held.peer.is_some() && !held.is_dead()).any(|held| match held
            .standing()
        {
            LaneState::Open => held.tenancy.cursor(held.words()).is_some_and(|at| at < head),
            LaneState::Asked => true,
            LaneState::Left => false,
        })
    }

    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }
}
