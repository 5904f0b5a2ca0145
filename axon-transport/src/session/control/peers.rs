//! The other sessions whose memory this session has mapped.
//!
//! The daemon sends a session's descriptors once, with the first pair that needs them, and again only after the last
//! such pair has ended. This table counts the pairs exactly as the daemon does, so that both agree on the descriptors
//! that the session holds.

use std::{
    collections::{BTreeSet, HashMap, HashSet},
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::Arc,
};

use axon_shm::{
    ShmError,
    internal::{
        KnownPeers, PeerDescriptors, PeerSession, RingPeer, SegmentInfo, SegmentKind,
        SessionSegment, descriptors::PassedFd,
    },
};
use rustix::{
    event::{Timespec, epoll},
    io::Errno,
};

use crate::{
    ids::{Gid, SessionId},
    session::core::MemoryChanges,
    wire::session::{Pair, Segment},
};

pub(super) struct Peers {
    own: Arc<SessionSegment>,
    news: Arc<MemoryChanges>,
    /// The sessions whose descriptors this process holds already, if it is their daemon.
    known: Option<Arc<KnownPeers>>,
    peers: HashMap<SessionId, Entry>,
    held: PairRefs,
    /// An epoll instance of the peers' pidfds. With hundreds of peers, checking each of them at every event would be
    /// most of the work.
    deaths: Arc<OwnedFd>,
}

/// Maximum number of ended processes per check. The next check reports the others.
const DEATHS: usize = 64;

struct Entry {
    session: Arc<PeerSession>,
    /// The epoll instance that reports the death of the process.
    deaths: Arc<OwnedFd>,
    /// True if the process has ended. Memory that the daemon took from it before may still arrive.
    dead: bool,
    /// Segments that arrived or were named since the daemon began to announce everything. The daemon does not know
    /// that this session holds other segments, so it will not report their end.
    named: BTreeSet<u32>,
}

impl Entry {
    fn new(session: Arc<PeerSession>, deaths: &Arc<OwnedFd>) -> Result<Self, ShmError> {
        let key = epoll::EventData::new_u64(key(&session.id()));
        epoll::add(deaths, session.pidfd(), key, epoll::EventFlags::IN)
            .map_err(ShmError::system("watching a process"))?;
        Ok(Self { session, deaths: deaths.clone(), dead: false, named: BTreeSet::new() })
    }

    /// Returns whether the process has ended, recorded or not.
    fn is_dead(&self) -> bool {
        self.dead || self.session.is_dead()
    }

    /// Records the death of the process and stops watching it. Otherwise, the epoll instance would report the death
    /// again and again.
    fn note_death(&mut self) {
        self.unwatch();
        self.dead = true;
    }

    fn unwatch(&self) {
        // The pidfd may be in use for longer, here and in other processes that share it.
        if !self.dead {
            let _ = epoll::delete(&self.deaths, self.session.pidfd());
        }
    }

    fn add(&mut self, segment: Segment, descriptor: &PassedFd) {
        self.named.insert(segment.number);
        if let Err(error) = self.session.add_segment(segment.into(), descriptor) {
            let (session, number) = (self.session.id(), segment.number);
            tracing::error!(%session, number, %error, "memory of another process is not usable");
        }
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.unwatch();
    }
}

/// The pairs that hold each session. There may be thousands of pairs with hundreds of sessions, and one pair ends at a
/// time.
#[derive(Default)]
struct PairRefs {
    pairs: BTreeSet<(Pair, SessionId)>,
    /// Number of pairs that hold each session.
    counts: HashMap<SessionId, usize>,
}

impl PairRefs {
    fn add(&mut self, pair: Pair, id: SessionId) {
        if self.pairs.insert((pair, id)) {
            *self.counts.entry(id).or_default() += 1;
        }
    }

    /// Removes a pair that ended. Returns the sessions that no other pair holds.
    fn release(&mut self, pair: &Pair) -> Vec<SessionId> {
        let [first, last] = [0, u8::MAX].map(|byte| (*pair, SessionId([byte; 16])));
        let over: Vec<_> = self.pairs.range(first..=last).copied().collect();
        let mut free = Vec::new();
        for held in over {
            self.pairs.remove(&held);
            let (_, id) = held;
            if let Some(count) = self.counts.get_mut(&id) {
                *count -= 1;
                if *count == 0 {
                    self.counts.remove(&id);
                    free.push(id);
                }
            }
        }
        free
    }

    fn holds(&self, id: &SessionId) -> bool {
        self.counts.contains_key(id)
    }
}

/// Returns a key that is almost always unique to a session.
fn key(id: &SessionId) -> u64 {
    id.0.iter().take(8).fold(0, |key, byte| key << 8 | u64::from(*byte))
}

/// The reason why a peer session cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum PeerError {
    #[error("its descriptors did not come")]
    Missing,
    #[error("{0}")]
    Memory(#[from] ShmError),
}

impl Peers {
    pub(super) fn new(
        own: Arc<SessionSegment>,
        news: Arc<MemoryChanges>,
        known: Option<Arc<KnownPeers>>,
    ) -> Result<Self, Errno> {
        let deaths = Arc::new(epoll::create(epoll::CreateFlags::CLOEXEC)?);
        Ok(Self { own, news, known, peers: HashMap::new(), held: PairRefs::default(), deaths })
    }

    /// Returns the session `id`, and holds it for `pair`. `descriptors` begins with those of the session's
    /// introduction, if any, and ends with those of `segments` of its memory.
    pub(super) fn hold(
        &mut self,
        id: SessionId,
        pair: Pair,
        mut descriptors: Vec<PassedFd>,
        segments: &[Segment],
    ) -> Result<RingPeer, PeerError> {
        if id == self.own.id() {
            return Ok(RingPeer::Local(self.own.clone()));
        }
        let introduced = descriptors.len().saturating_sub(segments.len());
        let maps = descriptors.split_off(introduced);
        // The stand-in for a relayed session has that session's id, in each daemon.
        let returned = introduced > 0 && self.peers.get(&id).is_some_and(Entry::is_dead);
        if returned || !self.peers.contains_key(&id) {
            let [segment, doorbell, pidfd] =
                <[PassedFd; 3]>::try_from(descriptors).map_err(|_| PeerError::Missing)?;
            let mut descriptors = PeerDescriptors { segment, doorbell, pidfd };
            if let Some(known) = &self.known {
                known.replace(&id, &mut descriptors);
            }
            let session = PeerSession::map_among(id, descriptors, self.sessions())?;
            let news = self.news.clone();
            session.on_wanted(move || news.want(id));
            // The dead session's pidfd, which may be the same descriptor, leaves the set of watched ones first.
            self.peers.remove(&id);
            self.peers.insert(id, Entry::new(session, &self.deaths)?);
        }
        let entry = self.peers.get_mut(&id).ok_or(PeerError::Missing)?;
        self.held.add(pair, id);
        for (segment, descriptor) in segments.iter().zip(&maps) {
            entry.add(*segment, descriptor);
        }
        Ok(RingPeer::Remote(entry.session.clone()))
    }

    /// Takes the segments of a session that readers lack.
    pub(super) fn take_wanted(&self, id: &SessionId) -> BTreeSet<u32> {
        self.peers.get(id).map(|entry| entry.session.take_wanted()).unwrap_or_default()
    }

    /// Adds a segment of a session that is held.
    pub(super) fn opened(&mut self, id: &SessionId, segment: Segment, descriptor: &PassedFd) {
        if let Some(entry) = self.peers.get_mut(id) {
            entry.add(segment, descriptor);
        }
    }

    /// Removes a segment that a held session gave up.
    pub(super) fn gone(&mut self, id: &SessionId, number: u32) {
        if let Some(entry) = self.peers.get_mut(id) {
            entry.named.remove(&number);
            entry.session.remove_segment(number);
        }
    }

    /// Releases a session's memory for samples of `writer` that was not named, now that all of it could be named.
    pub(super) fn drop_unnamed(&mut self, id: &SessionId, writer: Gid) {
        if let Some(Entry { session, named, .. }) = self.peers.get(id) {
            for SegmentInfo { number, kind } in session.segments() {
                if kind == SegmentKind::Samples(writer) && !named.contains(&number) {
                    session.remove_segment(number);
                }
            }
        }
    }

    /// Releases sessions without users. Also releases memory for samples that was not named and whose writer is not
    /// `read`. Returns the memory that was not named and is read.
    pub(super) fn drop_unread(&mut self, read: impl Fn(&Gid) -> bool) -> Vec<(SessionId, u32)> {
        // Readers and publishers hold the sessions that they use.
        let held = &self.held;
        self.peers.retain(|id, e| held.holds(id) || Arc::strong_count(&e.session) > 1);
        let mut unnamed = Vec::new();
        for (id, Entry { session, named, .. }) in &self.peers {
            for SegmentInfo { number, kind } in session.segments() {
                match kind {
                    SegmentKind::Samples(_) if named.contains(&number) => {}
                    SegmentKind::Samples(writer) if read(&writer) => unnamed.push((*id, number)),
                    SegmentKind::Samples(_) => session.remove_segment(number),
                    SegmentKind::Session | SegmentKind::Heap => {}
                }
            }
        }
        unnamed
    }

    /// Releases a pair that the daemon ended.
    pub(super) fn release(&mut self, pair: &Pair) {
        for id in self.held.release(pair) {
            self.peers.remove(&id);
        }
    }

    /// Restarts the count of pairs together with the daemon. Mapped memory stays, for the pairs that the daemon will
    /// repeat.
    pub(super) fn recount(&mut self) {
        self.held = PairRefs::default();
        self.peers.values_mut().for_each(|entry| entry.named.clear());
    }

    /// Records the sessions whose process has ended. Returns whether there are new ones. A session stays until the
    /// daemon has ended its pairs: memory that the daemon took from it before may arrive until then.
    pub(super) fn note_deaths(&mut self) -> bool {
        let mut events = [MaybeUninit::<epoll::Event>::uninit(); DEATHS];
        let now = Timespec::default();
        let Ok((events, _)) = epoll::wait(&self.deaths, &mut events, Some(&now)) else {
            return false;
        };
        let ended: HashSet<u64> = events.iter().map(|event| event.data.u64()).collect();
        if ended.is_empty() {
            return false;
        }
        let mut died = false;
        for (id, entry) in &mut self.peers {
            if !entry.dead && ended.contains(&key(id)) && entry.session.is_dead() {
                entry.note_death();
                died = true;
            }
        }
        died
    }

    /// Returns a descriptor that is readable once the process of a peer has ended.
    pub(super) fn deaths(&self) -> BorrowedFd<'_> {
        self.deaths.as_fd()
    }

    fn sessions(&self) -> impl Iterator<Item = &Arc<PeerSession>> {
        self.peers.values().map(|e| &e.session)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Debug)]
    enum Step {
        Add(u8, u8),
        Release(u8),
    }

    fn step() -> impl Strategy<Value = Step> {
        let (pair, id) = (0..6_u8, prop_oneof![0..4_u8, Just(u8::MAX)]);
        prop_oneof![
            4 => (pair.clone(), id.clone()).prop_map(|(pair, id)| Step::Add(pair, id)),
            3 => pair.prop_map(Step::Release),
        ]
    }

    proptest! {
        #[test]
        fn a_session_is_held_for_as_long_as_one_of_its_pairs(
            steps in prop::collection::vec(step(), 0..100),
        ) {
            let pair = |number: u8| Pair { reader: Gid([number; 16]), writer: Gid([9; 16]) };
            let session = |number: u8| SessionId([number; 16]);
            let (mut held, mut model) = (PairRefs::default(), HashMap::<u8, HashSet<u8>>::new());
            for step in steps {
                match step {
                    Step::Add(one, of) => {
                        held.add(pair(one), session(of));
                        model.entry(of).or_default().insert(one);
                    }
                    Step::Release(one) => {
                        let mut free = Vec::new();
                        model.retain(|of, pairs| {
                            let over = pairs.remove(&one) && pairs.is_empty();
                            free.extend(over.then_some(session(*of)));
                            !over
                        });
                        free.sort();
                        prop_assert_eq!(held.release(&pair(one)), free);
                    }
                }
                for number in [0, 1, 2, 3, u8::MAX] {
                    prop_assert_eq!(held.holds(&session(number)), model.contains_key(&number));
                }
            }
        }
    }
}
