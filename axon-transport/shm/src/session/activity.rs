//! Finds the readers of a session that may have samples: for a session that reads so many rings that it cannot check
//! all of them whenever one of them rings.
//!
//! The session reads the [journal](crate::ring::journal) of each session whose rings it reads. Its own threads
//! [mark](Activity::mark) readers for events that no journal contains: a reader that was just attached, whose writer
//! ended, or whose memory came. Each look also includes a few further readers in turn, so that in time all are checked,
//! whatever other sessions write to their journals.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    ops::Bound,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

use crate::{
    ids::Gid,
    ring::journal::{Journal, JournalCursor, RingsToRead},
    session::peer::PeerSession,
};

/// Number of readers that each look includes in turn.
const IN_TURN: usize = 2;

/// The readers of a session, and the marks of readers to check.
#[derive(Default)]
pub(crate) struct Activity {
    /// True if a caller takes the marked readers. Otherwise nothing is kept.
    followed: AtomicBool,
    state: Mutex<ActivityState>,
}

#[derive(Default)]
struct ActivityState {
    /// The followed sessions by the address of the other session; 0 is this session itself.
    journals: HashMap<usize, Followed>,
    readers: Readers,
    next: u64,
    /// Number of calls of [`take`](Activity::take).
    looks: u64,
}

/// The readers, by key.
#[derive(Default)]
struct Readers {
    all: BTreeMap<u64, Watched>,
    /// The keys of the marked readers, each once.
    marked: Vec<u64>,
    /// The reader that was included in turn last.
    turn: u64,
    /// Number of calls of `mark`, also for a marked reader.
    #[cfg(test)]
    marks: u64,
}

/// A session whose journal is read.
struct Followed {
    /// `None` is this session itself.
    peer: Option<Arc<PeerSession>>,
    place: JournalCursor,
    /// The rings by number.
    rings: HashMap<u32, Ring>,
}

/// The readers of the rings of one number. A session may give all its rings the same number.
#[derive(Default)]
struct Ring {
    keys: BTreeSet<u64>,
    /// The last look in which the journal named the ring. The journal may name it in all of its entries.
    named: u64,
}

struct Watched {
    reader: Gid,
    writer: Gid,
    journal: usize,
    ring: u32,
    marked: bool,
}

/// A reader's entry, until it is dropped.
pub(crate) struct WatchKey {
    of: Arc<Activity>,
    key: u64,
}

impl Activity {
    /// Starts keeping marks, because a caller takes the marked readers from now on.
    pub(crate) fn follow(&self) {
        // Relaxed: there is no reader yet.
        self.followed.store(true, Ordering::Relaxed);
    }

    /// Watches the ring of this number for a reader, and marks the reader. Returns `None` if no caller follows.
    pub(crate) fn watch(
        self: &Arc<Self>,
        (reader, writer): (Gid, Gid),
        peer: Option<&Arc<PeerSession>>,
        own: Journal<'_, AtomicU64>,
        ring: u32,
    ) -> Option<WatchKey> {
        if !self.followed.load(Ordering::Relaxed) {
            return None;
        }
        let journal = peer.map_or(0, |peer| Arc::as_ptr(peer).addr());
        let mut state = self.lock();
        let key = state.next;
        state.next += 1;
        let followed = state.journals.entry(journal).or_insert_with(|| {
            let words = peer.map_or(own, |peer| peer.journal());
            Followed {
                peer: peer.cloned(),
                place: JournalCursor::end(words),
                rings: HashMap::new(),
            }
        });
        followed.rings.entry(ring).or_default().keys.insert(key);
        state.readers.all.insert(key, Watched { reader, writer, journal, ring, marked: false });
        state.readers.mark(key);
        drop(state);
        Some(WatchKey { of: Arc::clone(self), key })
    }

    /// Adds the marked readers, each with its writer, to `found`. Call it after [`arm`](crate::wake::arm): later
    /// samples ring.
    pub(crate) fn take(&self, own: Journal<'_, AtomicU64>, found: &mut Vec<(Gid, Gid)>) {
        let mut state = self.lock();
        let ActivityState { journals, readers, looks, .. } = &mut *state;
        *looks += 1;
        for Followed { peer, place, rings } in journals.values_mut() {
            let words = peer.as_ref().map_or(own, |peer| peer.journal());
            let news = place.read(words, |number| {
                if let Some(ring) = rings.get_mut(&number)
                    && std::mem::replace(&mut ring.named, *looks) != *looks
                {
                    ring.keys.iter().for_each(|key| readers.mark(*key));
                }
            });
            let changed = peer.as_ref().is_some_and(|peer| peer.take_changed());
            if changed || news == RingsToRead::All {
                rings.values().flat_map(|ring| &ring.keys).for_each(|key| readers.mark(*key));
            }
        }
        for _ in 0..IN_TURN.min(readers.all.len()) {
            readers.mark_next();
        }
        readers.take(found);
    }

    /// Marks all readers.
    pub(crate) fn mark_all(&self) {
        let readers = &mut self.lock().readers;
        let keys: Vec<u64> = readers.all.keys().copied().collect();
        keys.into_iter().for_each(|key| readers.mark(key));
    }

    /// Returns the number of calls of `mark` since the start.
    #[cfg(test)]
    pub(crate) fn marks(&self) -> u64 {
        self.lock().readers.marks
    }

    fn lock(&self) -> MutexGuard<'_, ActivityState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Readers {
    fn mark(&mut self, key: u64) {
        #[cfg(test)]
        {
            self.marks += 1;
        }
        if let Some(watched) = self.all.get_mut(&key)
            && !std::mem::replace(&mut watched.marked, true)
        {
            self.marked.push(key);
        }
    }

    /// Marks the reader whose turn it is.
    fn mark_next(&mut self) {
        let after = self.all.range((Bound::Excluded(self.turn), Bound::Unbounded)).next();
        if let Some((key, _)) = after.or_else(|| self.all.first_key_value()) {
            self.turn = *key;
            self.mark(self.turn);
        }
    }

    /// Adds the marked readers to `found`, and clears the marks.
    fn take(&mut self, found: &mut Vec<(Gid, Gid)>) {
        for key in self.marked.drain(..) {
            if let Some(watched) = self.all.get_mut(&key) {
                watched.marked = false;
                found.push((watched.reader, watched.writer));
            }
        }
    }
}

impl WatchKey {
    /// Marks the reader, whatever its ring's journal contains.
    pub(crate) fn mark(&self) {
        self.of.lock().readers.mark(self.key);
    }
}

impl Drop for WatchKey {
    fn drop(&mut self) {
        let mut state = self.of.lock();
        let Some(Watched { journal, ring, .. }) = state.readers.all.remove(&self.key) else {
            return;
        };
        let Some(followed) = state.journals.get_mut(&journal) else { return };
        if let Some(of) = followed.rings.get_mut(&ring) {
            of.keys.remove(&self.key);
            if of.keys.is_empty() {
                followed.rings.remove(&ring);
            }
        }
        if followed.rings.is_empty() {
            let unfollowed = state.journals.remove(&journal);
            // The session is unmapped outside the lock.
            drop(state);
            drop(unfollowed);
        }
    }
}
