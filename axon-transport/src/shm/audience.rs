//! Who reads a ring, and what of it must stand for them.

use std::sync::Arc;

use super::{Grant, Peer, PeerSession, ReaderInfo};
use crate::{
    ids::Gid,
    qos::{Durability, History, Qos, Reliability},
};

/// The history that is kept at least, for readers that are late by a burst.
const BURST: u64 = 16;

/// The readers of one ring.
pub(super) struct Audience {
    offered: Qos,
    /// The most samples that can stand.
    capacity: u64,
    readers: Vec<Attached>,
    /// Their sessions, each once, shared with publishes that ring after they have unlocked.
    peers: Arc<[Peer]>,
    window: u64,
}

struct Attached {
    info: ReaderInfo,
    grant: Grant,
    /// Whether the reader has opened its lane.
    opened: bool,
    dead: bool,
}

/// Positions from which on samples are wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Floors {
    /// Given up last: the windows of all readers, and what KEEP_ALL readers have not taken.
    pub(super) retained: u64,
    /// Never given up: a RELIABLE, KEEP_ALL publisher's for its like in other sessions.
    pub(super) held: u64,
}

impl Attached {
    fn keeps_all(&self) -> bool {
        self.info.qos.history == History::KeepAll && !self.dead
    }

    /// The next position that the reader takes; `None` when it has left.
    fn cursor(&mut self, head: u64) -> Option<u64> {
        match self.info.peer.cursor(self.info.lane, self.grant.generation) {
            Some(cursor) => {
                self.opened = true;
                Some(cursor.clamp(self.grant.first, head))
            }
            None if self.opened => None,
            // It has not seen its grant yet.
            None => Some(self.grant.first),
        }
    }
}

impl Audience {
    pub(super) fn new(offered: Qos, capacity: u64) -> Self {
        let mut audience =
            Self { offered, capacity, readers: Vec::new(), peers: Arc::new([]), window: 0 };
        audience.changed();
        audience
    }

    pub(super) fn is_empty(&self) -> bool {
        self.readers.is_empty()
    }

    pub(super) fn peers(&self) -> Arc<[Peer]> {
        Arc::clone(&self.peers)
    }

    pub(super) fn readers(&self) -> Vec<Gid> {
        let mut gids = Vec::new();
        for Attached { info, .. } in &self.readers {
            if info.stands_for.is_empty() {
                gids.push(info.gid);
            } else {
                gids.extend_from_slice(&info.stands_for);
            }
        }
        gids
    }

    pub(super) fn attach(&mut self, info: ReaderInfo, tail: u64, head: u64) -> Grant {
        let known = self.readers.iter_mut().position(|known| {
            let same = &known.info;
            same.gid == info.gid
                && same.lane == info.lane
                && same.peer.id() == info.peer.id()
                // One that has left since is given a new start.
                && known.cursor(head).is_some()
        });
        if let Some(index) = known {
            let known = &mut self.readers[index];
            known.info.stands_for = info.stands_for;
            return known.grant;
        }
        self.readers.retain(|known| known.info.gid != info.gid);
        let transient =
            [&self.offered, &info.qos].iter().all(|q| q.durability == Durability::TransientLocal);
        let first = if transient {
            head.saturating_sub(depth(&self.offered).min(depth(&info.qos))).max(tail)
        } else {
            head
        };
        // Random, since a lane serves one publisher after another.
        let grant = Grant { generation: rand::random_range(1..=u64::MAX), first };
        self.readers.push(Attached { info, grant, opened: false, dead: false });
        self.changed();
        grant
    }

    pub(super) fn detach(&mut self, reader: Gid) -> bool {
        let before = self.readers.len();
        self.readers.retain(|known| known.info.gid != reader);
        self.changed();
        self.readers.len() != before
    }

    /// Stops counting on readers whose process has ended; [`Self::drop_dead`] names them.
    pub(super) fn mark_dead(&mut self) {
        for reader in &mut self.readers {
            reader.dead |= reader.info.peer.is_dead();
        }
    }

    pub(super) fn drop_dead(&mut self) -> Vec<Gid> {
        self.mark_dead();
        let dead: Vec<_> = self
            .readers
            .iter()
            .filter(|reader| reader.dead)
            .map(|reader| reader.info.gid)
            .collect();
        if !dead.is_empty() {
            self.readers.retain(|reader| !reader.dead);
            self.changed();
        }
        dead
    }

    /// What of the ring is wanted now that `head` is the next position.
    #[inline]
    pub(super) fn floors(&mut self, head: u64) -> Floors {
        let holds = holds(&self.offered);
        let mut floors = Floors { retained: head.saturating_sub(self.window), held: u64::MAX };
        for reader in self.readers.iter_mut().filter(|reader| reader.keeps_all()) {
            if let Some(cursor) = reader.cursor(head) {
                floors.retained = floors.retained.min(cursor);
                if holds && reader.info.peer.remote().is_some() && self::holds(&reader.info.qos) {
                    floors.held = floors.held.min(cursor);
                }
            }
        }
        floors
    }

    /// The reader that has most to take of those that hold `tail`, and the sessions of all these.
    pub(super) fn laggards(
        &mut self,
        tail: u64,
        head: u64,
    ) -> Option<(Gid, Vec<Arc<PeerSession>>)> {
        let mut worst = None;
        let mut peers = Vec::new();
        for reader in self.readers.iter_mut().filter(|reader| reader.keeps_all()) {
            let Some(cursor) = reader.cursor(head).filter(|cursor| *cursor <= tail) else {
                continue;
            };
            if let Some(peer) = reader.info.peer.remote().filter(|_| holds(&reader.info.qos)) {
                peers.push(Arc::clone(peer));
                worst = worst.into_iter().chain([(cursor, reader.info.gid)]).min();
            }
        }
        worst.map(|(_, gid)| (gid, peers))
    }

    fn changed(&mut self) {
        let readers = self.readers.iter().map(|reader| &reader.info.qos);
        let all_kept = self.offered.history == History::KeepAll
            && self.offered.durability == Durability::TransientLocal;
        self.window = if all_kept {
            self.capacity
        } else {
            readers
                .chain([&self.offered])
                .filter(|qos| qos.history == History::KeepLast)
                .map(depth)
                .chain([BURST])
                .max()
                .unwrap_or(BURST)
                .min(self.capacity)
        };
        let mut peers: Vec<Peer> = Vec::new();
        for reader in &self.readers {
            if peers.iter().all(|peer| peer.id() != reader.info.peer.id()) {
                peers.push(reader.info.peer.clone());
            }
        }
        self.peers = peers.into();
    }
}

/// How many samples a profile keeps.
pub(super) fn depth(qos: &Qos) -> u64 {
    match qos.history {
        History::KeepLast => u64::from(qos.depth.max(1)),
        History::KeepAll => u64::MAX,
    }
}

/// Whether a profile loses nothing rather than go on.
pub(super) fn holds(qos: &Qos) -> bool {
    qos.reliability == Reliability::Reliable && qos.history == History::KeepAll
}
