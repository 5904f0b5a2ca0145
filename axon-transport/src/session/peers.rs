//! The other sessions whose memory this one has mapped.
//!
//! The daemon hands a session's descriptors over once, with the first pair that needs them, and
//! again only when the last such pair was over. This table counts the pairs exactly as the daemon
//! does, so that both agree on what the session holds.

use std::{
    collections::{BTreeSet, HashMap, HashSet, hash_map::Entry as Slot},
    sync::Arc,
};

use super::{
    message::{Pair, Segment},
    state::MemoryNews,
};
use crate::{
    ids::{Gid, SessionId},
    passed::PassedFd,
    shm::{Peer, PeerDescriptors, PeerSession, SegmentInfo, SegmentKind, SessionSegment, ShmError},
};

pub(super) struct Peers {
    own: Arc<SessionSegment>,
    news: Arc<MemoryNews>,
    peers: HashMap<SessionId, Entry>,
}

struct Entry {
    session: Arc<PeerSession>,
    pairs: HashSet<Pair>,
    /// The segments that came or were named since the daemon began to tell everything: of others it
    /// does not know that they are here, so it will not say when they are gone.
    named: BTreeSet<u32>,
}

impl Entry {
    fn add(&mut self, segment: Segment, descriptor: &PassedFd) {
        self.named.insert(segment.number);
        if let Err(error) = self.session.add_segment(segment.into(), descriptor) {
            let (session, number) = (self.session.id(), segment.number);
            tracing::error!(%session, number, %error, "memory of another process is not usable");
        }
    }
}

/// Why a peer session cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum PeerError {
    #[error("its descriptors did not come")]
    Missing,
    #[error("{0}")]
    Memory(#[from] ShmError),
}

impl Peers {
    pub(super) fn new(own: Arc<SessionSegment>, news: Arc<MemoryNews>) -> Self {
        Self { own, news, peers: HashMap::new() }
    }

    /// The session `id`, for `pair`, with the descriptors that came along, if any: those of its
    /// introduction, and of these segments of its memory.
    pub(super) fn hold(
        &mut self,
        id: SessionId,
        pair: Pair,
        mut descriptors: Vec<PassedFd>,
        segments: &[Segment],
    ) -> Result<Peer, PeerError> {
        if id == self.own.id() {
            return Ok(Peer::Local(self.own.clone()));
        }
        let introduced = descriptors.len().saturating_sub(segments.len());
        let maps = descriptors.split_off(introduced);
        let others: Vec<_> = match self.peers.contains_key(&id) {
            true => Vec::new(),
            false => self.sessions().cloned().collect(),
        };
        let entry = match self.peers.entry(id) {
            Slot::Occupied(held) => held.into_mut(),
            Slot::Vacant(slot) => {
                let [segment, doorbell, pidfd] =
                    <[PassedFd; 3]>::try_from(descriptors).map_err(|_| PeerError::Missing)?;
                let descriptors = PeerDescriptors { segment, doorbell, pidfd };
                let session = PeerSession::map_among(id, descriptors, &others)?;
                let news = self.news.clone();
                session.on_wanted(move || news.wake());
                let (pairs, named) = (HashSet::new(), BTreeSet::new());
                slot.insert(Entry { session, pairs, named })
            }
        };
        entry.pairs.insert(pair);
        for (segment, descriptor) in segments.iter().zip(&maps) {
            entry.add(*segment, descriptor);
        }
        Ok(Peer::Remote(entry.session.clone()))
    }

    /// A session that is held has one segment more.
    pub(super) fn opened(&mut self, id: &SessionId, segment: Segment, descriptor: &PassedFd) {
        if let Some(entry) = self.peers.get_mut(id) {
            entry.add(segment, descriptor);
        }
    }

    /// A session that is held has given a segment up.
    pub(super) fn gone(&mut self, id: &SessionId, number: u32) {
        if let Some(entry) = self.peers.get_mut(id) {
            entry.named.remove(&number);
            entry.session.remove_segment(number);
        }
    }

    /// Lets go of a session's memory for samples of `writer` that was not named, now that all of it
    /// has been.
    pub(super) fn drop_unnamed(&mut self, id: &SessionId, writer: Gid) {
        if let Some(Entry { session, named, .. }) = self.peers.get(id) {
            for SegmentInfo { number, kind } in session.segments() {
                if kind == SegmentKind::Samples(writer) && !named.contains(&number) {
                    session.remove_segment(number);
                }
            }
        }
    }

    /// Lets go of sessions that nobody has to do with, and of memory for samples that neither was
    /// named nor is of a writer that is `read`. What of it is read though it was not named is
    /// returned.
    pub(super) fn drop_unread(&mut self, read: impl Fn(&Gid) -> bool) -> Vec<(SessionId, u32)> {
        // Readers and publishers hold the sessions that they have to do with.
        self.peers.retain(|_, e| !e.pairs.is_empty() || Arc::strong_count(&e.session) > 1);
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

    /// The daemon said that `pair` is over.
    pub(super) fn release(&mut self, pair: &Pair) {
        self.peers.retain(|_, entry| !entry.pairs.remove(pair) || !entry.pairs.is_empty());
    }

    /// The daemon starts to count anew. What is mapped stays, for the pairs that it will repeat.
    pub(super) fn recount(&mut self) {
        for entry in self.peers.values_mut() {
            entry.pairs.clear();
            entry.named.clear();
        }
    }

    /// Forgets and returns the sessions whose process is dead.
    pub(super) fn take_dead(&mut self) -> Vec<Arc<PeerSession>> {
        let dead = |entry: &mut Entry| entry.session.is_dead();
        let dead: Vec<SessionId> =
            self.peers.iter_mut().filter_map(|(id, e)| dead(e).then_some(*id)).collect();
        dead.iter().filter_map(|id| self.peers.remove(id)).map(|e| e.session).collect()
    }

    /// All of them, to be watched for their death.
    pub(super) fn sessions(&self) -> impl Iterator<Item = &Arc<PeerSession>> {
        self.peers.values().map(|e| &e.session)
    }
}
