//! Stand-ins: remote publishers as local subscriptions see them.
//!
//! There is one a GID, whatever link its samples come over: the daemon of a host can be restarted,
//! and its successor announces the same publishers while the last samples of the old link are still
//! being read. They go to the same ring, to which the readers stay attached.

use std::{
    collections::HashMap,
    ops::Deref,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use super::keyring::lock;
use crate::{
    graph::Endpoint,
    ids::Gid,
    session::{Publisher, Session, SessionError},
};

type Known = Arc<Mutex<HashMap<Gid, Weak<StandIn>>>>;

/// All stand-ins of the gateway.
#[derive(Clone, Default)]
pub(super) struct StandIns(Known);

/// A remote publisher as local subscriptions see it.
pub(super) struct StandIn {
    /// Writes the ring that stands in for it. Taken only by `drop`.
    publisher: Option<Publisher>,
    /// Held by the stream that feeds it: the stream of a successor waits until its predecessor's
    /// is read to the end, so samples stay in order.
    pub(super) feeding: tokio::sync::Mutex<()>,
    /// Sequence number of the newest sample written; 0 before the first.
    last: AtomicU64,
    gid: Gid,
    known: Known,
}

impl StandIns {
    /// The stand-in for `remote`: the one that there is, or a new one.
    ///
    /// # Errors
    /// It cannot be made, or another publisher under this GID still has readers to be drained.
    pub(super) fn get(
        &self,
        session: &Session,
        remote: &Endpoint,
    ) -> Result<Arc<StandIn>, SessionError> {
        loop {
            let mut known = lock(&self.0);
            match known.get(&remote.gid).map(Weak::upgrade) {
                Some(Some(stand_in)) => {
                    let same = stand_in.endpoint() == remote;
                    // Released first: dropping the last of them takes the lock.
                    drop(known);
                    if same {
                        return Ok(stand_in);
                    }
                    return Err(SessionError::InUse(remote.gid));
                }
                // Being dropped by another thread, which wants this lock.
                Some(None) => {
                    drop(known);
                    std::thread::sleep(Duration::from_micros(100));
                }
                None => {
                    let publisher = session.create_stand_in(remote.clone())?;
                    let stand_in = Arc::new(StandIn {
                        publisher: Some(publisher),
                        feeding: tokio::sync::Mutex::default(),
                        last: AtomicU64::new(0),
                        gid: remote.gid,
                        known: Arc::clone(&self.0),
                    });
                    known.insert(remote.gid, Arc::downgrade(&stand_in));
                    return Ok(stand_in);
                }
            }
        }
    }
}

impl StandIn {
    /// A sample of this sequence number was written.
    pub(super) fn wrote(&self, sequence: u64) {
        // Relaxed: only where a resumed route begins; sessions drop what they have seen.
        self.last.store(sequence, Ordering::Relaxed);
    }

    /// Sequence number of the newest sample written.
    pub(super) fn last_sequence(&self) -> Option<u64> {
        Some(self.last.load(Ordering::Relaxed)).filter(|n| *n > 0)
    }
}

impl Deref for StandIn {
    type Target = Publisher;

    fn deref(&self) -> &Publisher {
        // Only `drop` takes it, and nobody derefs what is being dropped.
        self.publisher.as_ref().expect("a stand-in has its publisher until it is dropped")
    }
}

impl Drop for StandIn {
    fn drop(&mut self) {
        // Under the lock: the GID is free for another stand-in once this publisher is gone.
        let mut known = lock(&self.known);
        drop(self.publisher.take());
        known.remove(&self.gid);
    }
}
