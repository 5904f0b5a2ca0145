//! The other sessions whose memory this one has mapped.
//!
//! The daemon hands a session's descriptors over once, with the first pair that needs them, and
//! again only when the last such pair was over. This table counts the pairs exactly as the daemon
//! does, so that both agree on what this session holds.

use std::{
    collections::{HashMap, HashSet, hash_map::Entry as Slot},
    sync::Arc,
};

use super::{
    message::{Pair, Segment},
    state::MemoryNews,
};
use crate::{
    ids::SessionId,
    passed::PassedFd,
    shm::{Peer, PeerDescriptors, PeerSession, SessionSegment, ShmError},
};

pub(super) struct Peers {
    own: Arc<SessionSegment>,
    news: Arc<MemoryNews>,
    peers: HashMap<SessionId, Entry>,
}

struct Entry {
    session: Arc<PeerSession>,
    pairs: HashSet<Pair>,
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
        let entry = match self.peers.entry(id) {
            Slot::Occupied(held) => held.into_mut(),
            Slot::Vacant(slot) => {
                let [segment, doorbell, pidfd] =
                    <[PassedFd; 3]>::try_from(descriptors).map_err(|_| PeerError::Missing)?;
                let session = PeerSession::map(id, PeerDescriptors { segment, doorbell, pidfd })?;
                let news = self.news.clone();
                session.on_wanted(move || news.wake());
                slot.insert(Entry { session, pairs: HashSet::new() })
            }
        };
        entry.pairs.insert(pair);
        for (segment, descriptor) in segments.iter().zip(&maps) {
            entry.session.add_segment((*segment).into(), descriptor)?;
        }
        Ok(Peer::Remote(entry.session.clone()))
    }

    /// A session that is held, or `None`.
    pub(super) fn get(&self, id: &SessionId) -> Option<&Arc<PeerSession>> {
        self.peers.get(id).map(|entry| &entry.session)
    }

    /// The daemon said that `pair` is over.
    pub(super) fn release(&mut self, pair: &Pair) {
        self.peers.retain(|_, entry| !entry.pairs.remove(pair) || !entry.pairs.is_empty());
    }

    /// The daemon starts to count anew. What is mapped stays, for the pairs that it will repeat.
    pub(super) fn recount(&mut self) {
        self.peers.values_mut().for_each(|entry| entry.pairs.clear());
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
