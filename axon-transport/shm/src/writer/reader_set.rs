//! The readers of a ring, and the oldest positions that the publisher must keep for them.

use std::{collections::HashSet, sync::Arc, time::Duration};

use crate::{
    alloc::pin_limit::PinPool,
    error::ShmError,
    ids::Gid,
    qos::{Durability, History, Qos},
    ring::{
        types::Grant,
        window::{BURST, depth, holds, keeps_all, wanted},
    },
    session::{
        lane::LaneView,
        peer::{PeerSession, RingPeer},
        pin_lanes::{PinLanes, Pinned, PinningReader},
        reader_info::ReaderInfo,
    },
    wake::Purpose,
    writer::{
        absent::{Absences, Carried},
        attached::Attached,
    },
};

/// The readers of one ring.
pub(crate) struct ReaderSet {
    offered: Qos,
    /// Whether it waits for KEEP_LAST readers, too: for what is within their depth.
    heeds_depths: bool,
    /// The most samples that can ever stand.
    capacity: u64,
    readers: Vec<Attached>,
    /// Those that carried samples to others and whose process ended.
    absent: Absences,
    /// Their lanes, and those of readers that were here and may hold samples still.
    pin_lanes: PinLanes,
    /// Their sessions, each once, shared with publishes that ring after they have unlocked.
    peers: Arc<[RingPeer]>,
    window: u64,
    /// Whether samples are noted in the session's journal, for readers that may follow it: relays, and where each
    /// reader waits for calls, all in other sessions.
    followers: bool,
    /// Samples that readers who stand for others gave up.
    given_up: u64,
}

/// Positions from which on samples are wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Floors {
    /// Given up last: the windows of all readers, and what KEEP_ALL readers have not taken.
    pub(crate) retained: u64,
    /// Never given up: a RELIABLE, KEEP_ALL publisher's for its like in other sessions, and what is
    /// within the depth of those that read requests or responses there.
    pub(crate) held: u64,
}

impl ReaderSet {
    pub(crate) fn new(offered: Qos, capacity: u64, pool: PinPool) -> Self {
        let mut reader_set = Self {
            offered,
            heeds_depths: false,
            capacity,
            readers: Vec::new(),
            absent: Absences::default(),
            pin_lanes: PinLanes::new(pool),
            peers: Arc::new([]),
            window: 0,
            followers: false,
            given_up: 0,
        };
        reader_set.changed();
        reader_set
    }

    /// Holds what is within its readers' depths, too.
    pub(crate) fn enforce_depths(&mut self) {
        self.heeds_depths = true;
    }

    /// The readers for which more than the window is kept, each with whether the publisher waits for it.
    fn heeded(&self) -> impl Iterator<Item = (&Attached, bool)> {
        let all = self.heeds_depths;
        let heeded = move |reader: &&Attached| {
            !reader.dead && (all || reader.info.qos.history == History::KeepAll)
        };
        self.readers.iter().filter(heeded).map(move |reader| {
            (reader, reader.info.peer.remote().is_some() && (all || holds(&reader.info.qos)))
        })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.readers.is_empty() && self.absent.is_empty()
    }

    /// Whether all of the history is for those that come later, as far as its memory goes.
    pub(crate) fn keeps_all(&self) -> bool {
        keeps_all(&self.offered)
    }

    pub(crate) fn peers(&self) -> Arc<[RingPeer]> {
        Arc::clone(&self.peers)
    }

    /// Whether there are readers that may follow the session's journal.
    #[inline]
    pub(crate) fn has_followers(&self) -> bool {
        self.followers
    }

    /// Whether a reader may follow the journal. Others cost a publish nothing.
    fn may_follow(&self, reader: &ReaderInfo) -> bool {
        reader.stands_for.is_some() || (self.heeds_depths && reader.peer.remote().is_some())
    }

    /// The sessions, if anybody there waits for a sample, after [`settle`](crate::wake::settle).
    #[inline]
    pub(crate) fn waiting(&self) -> Option<Arc<[RingPeer]>> {
        self.peers.iter().any(|peer| peer.waits(Purpose::Samples)).then(|| self.peers())
    }

    pub(crate) fn readers(&self) -> Vec<Gid> {
        let mut gids = Vec::new();
        for Attached { info, .. } in &self.readers {
            match &info.stands_for {
                Some(others) => gids.extend_from_slice(others),
                None => gids.push(info.gid),
            }
        }
        gids
    }

    /// Adds a reader, whose lane is `lane`, and which goes on at `resumed` if it has been here before.
    ///
    /// # Errors
    /// Its process has too many. It, or the one that it takes the place of, stays as it was.
    pub(crate) fn attach(
        &mut self,
        info: ReaderInfo,
        lane: LaneView,
        tail: u64,
        head: u64,
        resumed: Option<u64>,
        carries: bool,
    ) -> Result<Grant, ShmError> {
        // One whose process ended has nothing to do with this one, though they share GID and lane.
        // A relay may follow one of a daemon that ended.
        if info.is_relay() || self.readers.iter().any(|known| known.info.gid == info.gid) {
            self.mark_dead(head);
        }
        let stands_for = info.stands_for.clone().unwrap_or_default();
        let known = self.readers.iter().position(|known| {
            let same = &known.info;
            !known.dead
                && same.gid == info.gid
                && same.lane == info.lane
                && same.peer.id() == info.peer.id()
                // One that has left since is given a new start.
                && known.cursor(head).is_some()
        });
        if let Some(index) = known {
            self.absent.end(&info.gid, &stands_for);
            self.followers |= self.may_follow(&info);
            let known = &mut self.readers[index];
            known.info.stands_for = info.stands_for;
            known.carries = carries;
            return Ok(known.grant);
        }
        let transient =
            [&self.offered, &info.qos].iter().all(|q| q.durability == Durability::TransientLocal);
        let first = if transient {
            head.saturating_sub(depth(&self.offered).min(depth(&info.qos))).max(tail)
        } else {
            head
        };
        let absent = self.absent.position_of(&info.gid, &stands_for);
        let resumed = absent.into_iter().chain(resumed).min();
        let first = resumed.map_or(first, |resumed| resumed.clamp(tail, head).min(first));
        let tenancy = self.pin_lanes.admit(info.gid, &info.peer, info.lane, &lane)?;
        let grant = Grant { generation: tenancy.generation(), first };
        self.detach(info.gid, head);
        self.joined(&info);
        self.absent.end(&info.gid, &stands_for);
        self.readers.push(Attached::new(info, lane, tenancy, grant, carries));
        Ok(grant)
    }

    /// Samples that are kept at least.
    pub(crate) fn window(&self) -> u64 {
        self.window
    }

    /// Whether all readers have got one of the publisher's segments of this number or a later one:
    /// most likely that one, too.
    pub(crate) fn has_mapped(&self, number: u32) -> bool {
        self.readers.iter().filter(|reader| !reader.dead).all(|reader| reader.has_mapped(number))
    }

    /// The lanes of those that may be reading still.
    pub(crate) fn into_pin_lanes(self) -> PinLanes {
        self.pin_lanes
    }

    pub(crate) fn detach(&mut self, reader: Gid, head: u64) -> bool {
        let before = self.readers.len();
        // A process that ended said nothing of what it leaves.
        if self.readers.iter().any(|known| known.info.gid == reader && known.is_carrier()) {
            self.mark_dead(head);
        }
        // What it gave up last is counted.
        self.given_up(head);
        self.readers.retain(|known| known.info.gid != reader);
        let gone = self.readers.len() != before;
        // A session asks all of its publishers whenever an endpoint ends anywhere.
        if gone {
            self.changed();
        }
        gone
    }

    /// Adds to `found` the positions that any reader pins, after
    /// [`about_to_scan`](crate::ring::pins::about_to_scan).
    pub(crate) fn scan(&mut self, found: &mut Pinned) {
        self.pin_lanes.scan(found);
    }

    /// A reader that pins one of `positions`, and its session where that is not our own; `None` when
    /// looking for it found that some of those that did are dead.
    pub(crate) fn holder(&mut self, positions: &[u64]) -> Option<PinningReader> {
        if self.pin_lanes.sweep(|_| true) { None } else { self.pin_lanes.holder(positions) }
    }

    #[cfg(test)]
    pub(crate) fn pin_lanes(&self) -> usize {
        self.pin_lanes.len()
    }

    /// Forgets those that may keep samples no longer, as they have left or their process has ended.
    pub(crate) fn sweep(&mut self) {
        self.pin_lanes.sweep(|_| true);
    }

    /// Stops counting on readers whose process has ended; [`Self::drop_dead`] names them. What a relay
    /// among them was not done with is given up; what one had that carried it to a process which may
    /// live on is kept for a while.
    pub(crate) fn mark_dead(&mut self, head: u64) {
        let late = self.absent.expire(head);
        self.given_up = self.given_up.saturating_add(late);
        for reader in self.readers.iter_mut().filter(|reader| !reader.dead) {
            reader.dead = reader.info.peer.is_dead();
            if !reader.dead || !reader.is_carrier() {
                continue;
            }
            let Some(position) = reader.delivered(head) else { continue };
            self.given_up = self.given_up.saturating_add(reader.newly_given_up(head));
            if holds(&self.offered) && holds(&reader.info.qos) {
                let stood_for = reader.info.stands_for.clone().unwrap_or_default();
                self.absent.add(reader.info.gid, stood_for, position);
            } else {
                self.given_up = self.given_up.saturating_add(reader.left_above(position, head));
            }
        }
    }

    /// A reader that stands for others says that so many samples do not get there: of those that were
    /// published since it came, and each of them once.
    pub(crate) fn give_up(&mut self, reader: Gid, samples: u64, head: u64) {
        let known = self.readers.iter_mut().find(|known| known.info.gid == reader);
        if let Some(known) = known.filter(|known| !known.dead) {
            self.given_up = self.given_up.saturating_add(known.give_up(samples, head));
        }
    }

    /// Samples that readers who stand for others gave up: those of them that were
    /// [handed over](Self::delivered_up_to) are counted if that was asked before.
    pub(crate) fn given_up(&mut self, head: u64) -> u64 {
        for reader in self.readers.iter_mut().filter(|r| !r.dead && r.info.stands_for.is_some()) {
            self.given_up = self.given_up.saturating_add(reader.newly_given_up(head));
        }
        self.given_up
    }

    pub(crate) fn drop_dead(&mut self, head: u64) -> Vec<Gid> {
        self.mark_dead(head);
        self.drop_those(|reader| reader.dead)
    }

    /// Forgets those that have left, too, whether or not they keep samples.
    pub(crate) fn drop_gone(&mut self, head: u64) -> Vec<Gid> {
        self.mark_dead(head);
        // A reader's cursor is at the end of all positions once it takes no more.
        self.drop_those(|reader| reader.dead || matches!(reader.position(), None | Some(u64::MAX)))
    }

    fn drop_those(&mut self, gone: impl Fn(&Attached) -> bool) -> Vec<Gid> {
        let mut gids = Vec::new();
        self.readers.retain(|reader| {
            let gone = gone(reader);
            if gone {
                gids.push(reader.info.gid);
            }
            !gone
        });
        if !gids.is_empty() {
            self.changed();
        }
        self.pin_lanes.sweep(|_| true);
        gids
    }

    /// What of the ring is wanted now that `head` is the next position.
    #[inline]
    pub(crate) fn floors(&self, head: u64) -> Floors {
        let holds = holds(&self.offered);
        let mut floors = Floors { retained: head.saturating_sub(self.window), held: u64::MAX };
        for (reader, waits) in self.heeded() {
            if let Some(floor) = reader.floor(head) {
                floors.retained = floors.retained.min(floor);
                if holds && waits {
                    floors.held = floors.held.min(floor);
                }
            }
        }
        if let Some((position, _)) = self.absent.oldest() {
            floors.retained = floors.retained.min(position);
            floors.held = floors.held.min(position);
        }
        floors
    }

    /// Below this position every reader has taken what it wanted, and a later reader gets nothing:
    /// so no reader asks for it again.
    pub(crate) fn consumed(&self, head: u64) -> u64 {
        if self.offered.durability == Durability::TransientLocal {
            return 0;
        }
        let cursors = self.readers.iter().filter(|reader| !reader.dead);
        let cursors = cursors.filter_map(|reader| reader.cursor(head));
        let absent = self.absent.oldest().map(|(position, _)| position);
        cursors.chain(absent).min().unwrap_or(head)
    }

    /// Below this every reader that carries samples elsewhere is done with what it wanted.
    pub(crate) fn delivered_up_to(&mut self, head: u64) -> u64 {
        let carriers = self.readers.iter_mut().filter(|r| !r.dead && r.is_carrier());
        let done = carriers.filter_map(|reader| reader.delivered(head));
        let absent = self.absent.oldest().map(|(position, _)| position.min(head));
        done.chain(absent).min().unwrap_or(head)
    }

    fn carriers(&self) -> impl Iterator<Item = &Attached> {
        self.readers.iter().filter(|reader| !reader.dead && reader.is_carrier())
    }

    /// Whether a reader that carries samples elsewhere has not taken the one at `tail`.
    pub(crate) fn has_carrier_behind(&self, tail: u64) -> bool {
        self.carriers().filter_map(Attached::position).any(|position| position <= tail)
    }

    /// Whether samples are kept for a reader whose process ended.
    pub(crate) fn has_absent(&self) -> bool {
        !self.absent.is_empty()
    }

    /// Whether samples are kept for this reader, which carries them to another process.
    pub(crate) fn carried(&mut self, reader: &Gid, head: u64) -> Option<Carried> {
        self.mark_dead(head);
        if self.carriers().any(|known| known.info.gid == *reader) {
            return Some(Carried::Attached);
        }
        self.absent.until(reader).map(Carried::Absent)
    }

    /// How long it takes until one of the absent readers is given up.
    pub(crate) fn absent_for(&self) -> Option<Duration> {
        self.absent.left()
    }

    /// The sessions of those that do.
    pub(crate) fn relays(&self) -> Vec<Arc<PeerSession>> {
        self.carriers().filter_map(|reader| reader.info.peer.remote().cloned()).collect()
    }

    /// The reader that has most to take of those that hold `tail`, and the sessions of all these.
    pub(crate) fn laggards(&self, tail: u64, head: u64) -> Option<(Gid, Vec<Arc<PeerSession>>)> {
        let mut worst = None;
        let mut peers = Vec::new();
        for (reader, _) in self.heeded().filter(|(_, waits)| *waits) {
            let Some(floor) = reader.floor(head).filter(|floor| *floor <= tail) else { continue };
            if let Some(peer) = reader.info.peer.remote() {
                peers.push(Arc::clone(peer));
                worst = worst.into_iter().chain([(floor, reader.info.gid)]).min();
            }
        }
        let absent = self.absent.oldest().filter(|(position, _)| *position <= tail);
        worst.into_iter().chain(absent).min().map(|(_, gid)| (gid, peers))
    }

    /// Whether a KEEP_ALL reader of another session has not taken up its grant, though there are samples for it.
    pub(crate) fn expects_readers(&self, head: u64) -> bool {
        self.asking(head).any(|reader| holds(&reader.info.qos))
    }

    /// The readers of other sessions that have not taken up their grant, and how many samples there are for each: of a
    /// KEEP_LAST one no more than its depth. What readers carry elsewhere is counted there.
    pub(crate) fn unmet(&self, head: u64) -> Vec<(Gid, u64)> {
        let readers = self.asking(head).filter(|reader| !reader.is_carrier());
        let samples = |reader: &Attached| (head - reader.grant.first).min(depth(&reader.info.qos));
        readers.map(|reader| (reader.info.gid, samples(reader))).collect()
    }

    /// What was granted to readers of other sessions that have not taken it up, and carry samples nowhere.
    pub(crate) fn untaken_grants(&self) -> Vec<(Gid, Grant)> {
        let readers = self.asking(u64::MAX).filter(|reader| !reader.is_carrier());
        readers.map(|reader| (reader.info.gid, reader.grant)).collect()
    }

    /// The readers of other sessions that live and have not taken up their grant, though there are samples for them.
    fn asking(&self, head: u64) -> impl Iterator<Item = &Attached> {
        self.readers.iter().filter(move |reader| reader.is_asking(head))
    }

    /// There is one reader more. A publisher of hundreds gets them one by one, so that what stands is
    /// added to, and not found anew.
    fn joined(&mut self, info: &ReaderInfo) {
        self.followers |= self.may_follow(info);
        self.window = self.window.max(wanted(&info.qos)).min(self.capacity);
        let id = info.peer.id();
        if self.peers.iter().all(|peer| peer.id() != id) {
            self.peers = self.peers.iter().chain([&info.peer]).cloned().collect();
        }
    }

    /// There are others than before.
    fn changed(&mut self) {
        self.window = if self.keeps_all() {
            self.capacity
        } else {
            let readers = self.readers.iter().map(|reader| &reader.info.qos);
            let most = readers.chain([&self.offered]).map(wanted).max().unwrap_or(BURST);
            most.min(self.capacity)
        };
        self.followers = self.readers.iter().any(|reader| self.may_follow(&reader.info));
        let mut met = HashSet::new();
        let peers = self.readers.iter().map(|reader| &reader.info.peer);
        self.peers = peers.filter(|peer| met.insert(peer.id())).cloned().collect();
        // Nobody watches the processes of those that are not attached any more.
        let attached: HashSet<u64> =
            self.readers.iter().map(|reader| reader.grant.generation).collect();
        self.pin_lanes.sweep(|lane| !attached.contains(&lane.tenancy.generation()));
    }
}
