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
        attached::AttachedReader,
        departed_readers::{CarrierState, DepartedReaders},
    },
};

/// The readers of one ring.
pub(crate) struct ReaderSet {
    offered: Qos,
    /// True if the publisher also waits for KEEP_LAST readers, to keep the samples within their depths.
    heeds_depths: bool,
    /// The most samples that the ring can hold.
    capacity: u64,
    readers: Vec<AttachedReader>,
    /// Carriers (readers that deliver samples to another process or host) whose process has ended.
    absent: DepartedReaders,
    /// The lanes of all readers, and of detached readers that may still hold samples.
    pin_lanes: PinLanes,
    /// The sessions of the readers, each once. A publish shares the list and wakes the sessions after it has
    /// unlocked.
    peers: Arc<[RingPeer]>,
    window: u64,
    /// True if a reader may follow the session's journal, so that each publish must note its sample there.
    /// Relays may; so may readers in other sessions if the depths are enforced, that is, readers of requests
    /// and responses.
    followers: bool,
    /// The samples that relays (readers that stand for remote ones) gave up.
    given_up: u64,
}

/// The positions from which on samples are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LowWatermarks {
    /// The floor of samples that are given up last: the windows of all readers, and the untaken samples of
    /// KEEP_ALL readers.
    pub(crate) retained: u64,
    /// The floor of samples that are never given up. A RELIABLE, KEEP_ALL publisher holds them for such
    /// readers in other sessions. If depths are enforced, it also holds the samples within the depths of
    /// readers there.
    pub(crate) held: u64,
}

impl ReaderSet {
    pub(crate) fn new(offered: Qos, capacity: u64, pool: PinPool) -> Self {
        let mut reader_set = Self {
            offered,
            heeds_depths: false,
            capacity,
            readers: Vec::new(),
            absent: DepartedReaders::default(),
            pin_lanes: PinLanes::new(pool),
            peers: Arc::new([]),
            window: 0,
            followers: false,
            given_up: 0,
        };
        reader_set.changed();
        reader_set
    }

    /// Also holds the samples within the depths of the readers.
    pub(crate) fn enforce_depths(&mut self) {
        self.heeds_depths = true;
    }

    /// Returns the readers for which more than the window is kept, each with whether the publisher waits for
    /// the reader.
    fn heeded(&self) -> impl Iterator<Item = (&AttachedReader, bool)> {
        let all = self.heeds_depths;
        let heeded = move |reader: &&AttachedReader| {
            !reader.dead && (all || reader.info.qos.history == History::KeepAll)
        };
        self.readers.iter().filter(heeded).map(move |reader| {
            (reader, reader.info.peer.remote().is_some() && (all || holds(&reader.info.qos)))
        })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.readers.is_empty() && self.absent.is_empty()
    }

    /// Returns whether the publisher keeps its whole history for later readers, as far as its memory permits.
    pub(crate) fn keeps_all(&self) -> bool {
        keeps_all(&self.offered)
    }

    pub(crate) fn peers(&self) -> Arc<[RingPeer]> {
        Arc::clone(&self.peers)
    }

    /// Returns whether a reader may follow the session's journal.
    #[inline]
    pub(crate) fn has_followers(&self) -> bool {
        self.followers
    }

    /// Returns whether a reader may follow the journal. A publish has no extra cost for other readers.
    fn may_follow(&self, reader: &ReaderInfo) -> bool {
        reader.stands_for.is_some() || (self.heeds_depths && reader.peer.remote().is_some())
    }

    /// Returns the sessions if one of them waits for a sample. Call [`settle`](crate::wake::settle) first.
    #[inline]
    pub(crate) fn waiting(&self) -> Option<Arc<[RingPeer]>> {
        self.peers.iter().any(|peer| peer.waits(Purpose::Samples)).then(|| self.peers())
    }

    pub(crate) fn readers(&self) -> Vec<Gid> {
        let mut gids = Vec::new();
        for AttachedReader { info, .. } in &self.readers {
            match &info.stands_for {
                Some(others) => gids.extend_from_slice(others),
                None => gids.push(info.gid),
            }
        }
        gids
    }

    /// Counts what [`readers`](Self::readers) lists, without an allocation.
    pub(crate) fn reader_count(&self) -> usize {
        let stands_for = |reader: &AttachedReader| reader.info.stands_for.as_ref().map(Vec::len);
        self.readers.iter().map(|reader| stands_for(reader).unwrap_or(1)).sum()
    }

    /// Adds a reader with the given lane. `resumed` is the position at which a returning reader continues.
    ///
    /// # Errors
    /// The reader's process has too many lanes. The reader, or the one that it would replace, is unchanged.
    pub(crate) fn attach(
        &mut self,
        info: ReaderInfo,
        lane: LaneView,
        tail: u64,
        head: u64,
        resumed: Option<u64>,
        carries: bool,
    ) -> Result<Grant, ShmError> {
        // A reader whose process has ended differs from the new one, even with the same GID and lane. A new
        // relay may replace one of a daemon that ended.
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
                // A reader that has left since gets a new start.
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
        self.readers.push(AttachedReader::new(info, lane, tenancy, grant, carries));
        Ok(grant)
    }

    /// Returns the least number of samples that are kept.
    pub(crate) fn window(&self) -> u64 {
        self.window
    }

    /// Returns whether all readers have mapped the publisher's segment of this number or a later one. A
    /// reader with a later one most likely has this one, too.
    pub(crate) fn has_mapped(&self, number: u32) -> bool {
        self.readers.iter().filter(|reader| !reader.dead).all(|reader| reader.has_mapped(number))
    }

    /// Returns the lanes of the readers that may still read.
    pub(crate) fn into_pin_lanes(self) -> PinLanes {
        self.pin_lanes
    }

    pub(crate) fn detach(&mut self, reader: Gid, head: u64) -> bool {
        let before = self.readers.len();
        // A carrier whose process has ended did not report its remaining samples: `mark_dead` accounts for
        // them.
        if self.readers.iter().any(|known| known.info.gid == reader && known.is_carrier()) {
            self.mark_dead(head);
        }
        // Counts the samples that the reader gave up last, before it is forgotten.
        self.given_up(head);
        self.readers.retain(|known| known.info.gid != reader);
        let gone = self.readers.len() != before;
        // Most calls find no reader: a session calls all of its publishers whenever any endpoint ends.
        if gone {
            self.changed();
        }
        gone
    }

    /// Adds to `found` the positions that any reader pins. Call
    /// [`about_to_scan`](crate::ring::pins::about_to_scan) first.
    pub(crate) fn scan(&mut self, found: &mut Pinned) {
        self.pin_lanes.scan(found);
    }

    /// Returns a reader that pins one of `positions`, with its session if that is another one. Returns `None`
    /// also if the search found that readers had left or died: look again then.
    pub(crate) fn holder(&mut self, positions: &[u64]) -> Option<PinningReader> {
        if self.pin_lanes.sweep(|_| true) { None } else { self.pin_lanes.holder(positions) }
    }

    #[cfg(test)]
    pub(crate) fn pin_lanes(&self) -> usize {
        self.pin_lanes.len()
    }

    /// Forgets the lanes that pin no samples any more, because the reader has left or its process has ended.
    pub(crate) fn sweep(&mut self) {
        self.pin_lanes.sweep(|_| true);
    }

    /// Stops counting on readers whose process has ended; [`drop_dead`](Self::drop_dead) returns them. A dead
    /// carrier may leave undelivered samples. They are kept for its successor for a while if the publisher
    /// and the carrier are both RELIABLE and KEEP_ALL. Otherwise they are given up.
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

    /// Counts samples that a relay reports as given up. Counts each sample once, and no more samples than
    /// were published since the relay attached.
    pub(crate) fn give_up(&mut self, reader: Gid, samples: u64, head: u64) {
        let known = self.readers.iter_mut().find(|known| known.info.gid == reader);
        if let Some(known) = known.filter(|known| !known.dead) {
            self.given_up = self.given_up.saturating_add(known.give_up(samples, head));
        }
    }

    /// Returns the number of samples that relays gave up. That includes every given-up sample below the
    /// position that an earlier call of [`delivered_up_to`](Self::delivered_up_to) returned.
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

    /// Forgets dead readers and readers that have left, whether or not they keep samples.
    pub(crate) fn drop_gone(&mut self, head: u64) -> Vec<Gid> {
        self.mark_dead(head);
        // A reader sets its cursor past all positions when it stops taking samples.
        self.drop_those(|reader| reader.dead || matches!(reader.position(), None | Some(u64::MAX)))
    }

    fn drop_those(&mut self, gone: impl Fn(&AttachedReader) -> bool) -> Vec<Gid> {
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

    /// Returns the positions from which on samples are kept, now that `head` is the next position.
    #[inline]
    pub(crate) fn floors(&self, head: u64) -> LowWatermarks {
        let holds = holds(&self.offered);
        let mut floors =
            LowWatermarks { retained: head.saturating_sub(self.window), held: u64::MAX };
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

    /// Returns the position below which no reader asks for a sample again: every reader has taken what it
    /// wants, and later readers get no history.
    pub(crate) fn consumed(&self, head: u64) -> u64 {
        if self.offered.durability == Durability::TransientLocal {
            return 0;
        }
        let cursors = self.readers.iter().filter(|reader| !reader.dead);
        let cursors = cursors.filter_map(|reader| reader.cursor(head));
        let absent = self.absent.oldest().map(|(position, _)| position);
        cursors.chain(absent).min().unwrap_or(head)
    }

    /// Returns whether a reader has not taken the sample at `position` and has it within its depth, or a later reader
    /// would get it.
    pub(crate) fn is_wanted(&self, position: u64, head: u64) -> bool {
        let is_history = self.offered.durability == Durability::TransientLocal
            && head.saturating_sub(depth(&self.offered)) <= position;
        let floors = self.readers.iter().filter(|reader| !reader.dead);
        let floors = floors.filter_map(|reader| reader.floor(head));
        let absent = self.absent.oldest().map(|(position, _)| position);
        is_history || floors.chain(absent).any(|floor| floor <= position)
    }

    /// Returns the position below which every carrier has delivered its samples.
    pub(crate) fn delivered_up_to(&mut self, head: u64) -> u64 {
        let carriers = self.readers.iter_mut().filter(|r| !r.dead && r.is_carrier());
        let done = carriers.filter_map(|reader| reader.delivered(head));
        let absent = self.absent.oldest().map(|(position, _)| position.min(head));
        done.chain(absent).min().unwrap_or(head)
    }

    fn carriers(&self) -> impl Iterator<Item = &AttachedReader> {
        self.readers.iter().filter(|reader| !reader.dead && reader.is_carrier())
    }

    /// Returns whether samples are kept for a carrier whose process has ended.
    pub(crate) fn has_absent(&self) -> bool {
        !self.absent.is_empty()
    }

    /// Returns why samples are kept for this carrier; `None` if none are.
    pub(crate) fn carried(&mut self, reader: &Gid, head: u64) -> Option<CarrierState> {
        self.mark_dead(head);
        if self.carriers().any(|known| known.info.gid == *reader) {
            return Some(CarrierState::Attached);
        }
        self.absent.until(reader).map(CarrierState::Absent)
    }

    /// Returns the time until the first absent carrier is given up.
    pub(crate) fn absent_for(&self) -> Option<Duration> {
        self.absent.left()
    }

    /// Returns the other sessions that have a carrier.
    pub(crate) fn relays(&self) -> Vec<Arc<PeerSession>> {
        self.carriers().filter_map(|reader| reader.info.peer.remote().cloned()).collect()
    }

    /// Returns the reader that is furthest behind among the readers that hold `tail`, and the sessions of all
    /// of them.
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

    /// Returns whether a RELIABLE, KEEP_ALL reader of another session has samples to take and has not taken
    /// up its grant.
    pub(crate) fn expects_readers(&self, head: u64) -> bool {
        self.asking(head).any(|reader| holds(&reader.info.qos))
    }

    /// Returns the readers of other sessions that have not taken up their grant, each with the number of
    /// samples for it. A KEEP_LAST reader counts no more samples than its depth. Carriers are left out: their
    /// samples are counted at their destination.
    pub(crate) fn unmet(&self, head: u64) -> Vec<(Gid, u64)> {
        let readers = self.asking(head).filter(|reader| !reader.is_carrier());
        let samples =
            |reader: &AttachedReader| (head - reader.grant.first).min(depth(&reader.info.qos));
        readers.map(|reader| (reader.info.gid, samples(reader))).collect()
    }

    /// Returns the grants that readers of other sessions have not taken up. Carriers are left out.
    pub(crate) fn untaken_grants(&self) -> Vec<(Gid, Grant)> {
        let readers = self.asking(u64::MAX).filter(|reader| !reader.is_carrier());
        readers.map(|reader| (reader.info.gid, reader.grant)).collect()
    }

    /// Returns the readers of other, living sessions that have samples to take and have not taken up their
    /// grant.
    fn asking(&self, head: u64) -> impl Iterator<Item = &AttachedReader> {
        self.readers.iter().filter(move |reader| reader.is_asking(head))
    }

    /// Adds one reader to the summaries. A publisher of hundreds of readers gets them one by one, so the
    /// summaries are extended and not rebuilt.
    fn joined(&mut self, info: &ReaderInfo) {
        self.followers |= self.may_follow(info);
        self.window = self.window.max(wanted(&info.qos)).min(self.capacity);
        let id = info.peer.id();
        if self.peers.iter().all(|peer| peer.id() != id) {
            self.peers = self.peers.iter().chain([&info.peer]).cloned().collect();
        }
    }

    /// Rebuilds the summaries after readers have left.
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
        // Forgets detached readers whose process ended: nothing watches their processes any more.
        let attached: HashSet<u64> =
            self.readers.iter().map(|reader| reader.grant.generation).collect();
        self.pin_lanes.sweep(|lane| !attached.contains(&lane.tenancy.generation()));
    }
}
