//! What a process needs once to publish to others and to be woken by them.

use std::{
    collections::HashMap,
    fmt,
    sync::{
        Arc, Mutex, PoisonError, Weak,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use super::{Peer, PeerDescriptors, PeerSession, SessionSegment, ShmError};
use crate::{
    ids::{Gid, SessionId},
    wait::ExternalLeader,
};

/// The memory, doorbell and identity that publishers and subscribers of a process share. Starts no
/// thread. Clones are the same context; all methods may be called from any thread.
#[derive(Clone)]
pub struct Context {
    inner: Arc<Inner>,
}

struct Inner {
    session: Arc<SessionSegment>,
    entities: AtomicU32,
    /// The other contexts, each mapped once.
    peers: Mutex<HashMap<SessionId, Weak<PeerSession>>>,
}

impl Context {
    /// A new context of this process.
    ///
    /// # Errors
    /// Memory or descriptors are short, or the system has no memfds or pidfds (Linux 5.3).
    pub fn new() -> Result<Self, ShmError> {
        Ok(Self::of(SessionSegment::create(SessionId::random())?))
    }

    fn of(session: Arc<SessionSegment>) -> Self {
        let (entities, peers) = (AtomicU32::new(1), Mutex::default());
        Self { inner: Arc::new(Inner { session, entities, peers }) }
    }

    /// Its id.
    pub fn id(&self) -> SessionId {
        self.session().id()
    }

    /// Blocks until `ready`, which is asked again whenever something was published to a subscriber
    /// of this context or [`notify`](Self::notify) was called, or until `timeout` has passed.
    /// Returns what `ready` said last.
    pub fn wait(&self, ready: impl FnMut() -> bool, timeout: Option<Duration>) -> bool {
        self.session().wait(ready, timeout)
    }

    /// Makes every [`wait`](Self::wait) look again.
    pub fn notify(&self) {
        self.session().notify();
    }

    /// A descriptor for an event loop, asynchronous ones too, which becomes readable when there is
    /// something to look for. How to use it, with an example: [`ExternalLeader`].
    ///
    /// # Errors
    /// The context has one already.
    pub fn event(&self) -> Result<ExternalLeader, ShmError> {
        self.session().external_leader()
    }

    pub(super) fn session(&self) -> &Arc<SessionSegment> {
        &self.inner.session
    }

    pub(super) fn next_gid(&self) -> Gid {
        Gid::new(self.id(), self.inner.entities.fetch_add(1, Ordering::Relaxed))
    }

    /// The context `id` as seen from this one.
    pub(super) fn peer(
        &self,
        id: SessionId,
        descriptors: PeerDescriptors,
    ) -> Result<Peer, ShmError> {
        if id == self.id() {
            return Ok(Peer::Local(Arc::clone(self.session())));
        }
        if descriptors.process().is_none() {
            return Err(ShmError::Refused { what: "its pidfd names no process" });
        }
        let mut peers = self.inner.peers.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = peers.get(&id).and_then(Weak::upgrade) {
            return Ok(Peer::Remote(known));
        }
        let session = PeerSession::map(id, descriptors)?;
        peers.retain(|_, peer| peer.strong_count() > 0);
        peers.insert(id, Arc::downgrade(&session));
        Ok(Peer::Remote(session))
    }
}

impl fmt::Debug for Context {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Context").field(&self.id()).finish()
    }
}
