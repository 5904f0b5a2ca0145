//! What a process needs once to publish to others and to be woken by them.

use std::{
    collections::HashMap,
    fmt,
    os::fd::{AsFd, BorrowedFd},
    sync::{
        Arc, Mutex, PoisonError, Weak,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use super::{
    ConnectError, Peer, PeerDescriptors, PeerSession, SegmentEvent, SegmentInfo, SegmentKind,
    SessionSegment, ShmError,
    connect::{Channel, Granted, Handed, News},
};
use crate::{
    ids::{Gid, SessionId},
    passed::PassedFd,
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
    served: Arc<Mutex<Vec<Served>>>,
}

/// A subscriber that is to be told of segments.
struct Served {
    session: SessionId,
    reader: Gid,
    writer: Gid,
    line: PassedFd,
    /// The line had no room.
    behind: bool,
}

impl Served {
    /// Whether what is in the segment may concern the subscriber.
    fn reads(&self, kind: SegmentKind) -> bool {
        match kind {
            SegmentKind::Session => false,
            SegmentKind::Heap => true,
            SegmentKind::Samples(gid) => gid == self.writer,
        }
    }

    fn hand(&mut self, info: SegmentInfo, fd: BorrowedFd<'_>) {
        if self.reads(info.kind) {
            let channel = Channel::new(self.line.as_fd(), Some(Duration::ZERO));
            // A subscriber that is gone needs nothing.
            let handed = channel.hand(self.session, info, fd);
            self.behind |= matches!(handed, Err(ConnectError::Timeout));
        }
    }

    fn withdraw(&self, info: SegmentInfo) {
        if self.reads(info.kind) {
            let channel = Channel::new(self.line.as_fd(), Some(Duration::ZERO));
            // One that cannot be told keeps its map for as long as it reads from here.
            let _ = channel.withdraw(self.session, info.number);
        }
    }
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
        let served = Arc::<Mutex<Vec<Served>>>::default();
        let told = Arc::clone(&served);
        session.on_segment(move |event| {
            let mut served = told.lock().unwrap_or_else(PoisonError::into_inner);
            match event {
                SegmentEvent::Opened(info, fd) => {
                    served.iter_mut().for_each(|served| served.hand(info, fd));
                }
                SegmentEvent::Gone(info) => served.iter().for_each(|served| served.withdraw(info)),
                // Nobody prepares publishers here but their owner.
                SegmentEvent::Low(_) => {}
            }
        });
        Self { inner: Arc::new(Inner { session, entities, peers, served }) }
    }

    /// Hands a subscriber the segments that there are, and from then on those to come.
    pub(super) fn hand_over(&self, line: PassedFd, granted: &Granted) -> Result<(), ConnectError> {
        let Granted { reader, writer, .. } = *granted;
        let session = self.id();
        // In the list first, so that none that comes now is missed; one that comes twice is one.
        self.served().push(Served { session, reader, writer, line, behind: true });
        self.catch_up();
        if self.served().iter().any(|served| served.reader == reader && served.behind) {
            self.forget(reader);
            return Err(ConnectError::Timeout);
        }
        Ok(())
    }

    /// Hands all segments to those that could not be told of some.
    fn catch_up(&self) {
        if self.served().iter().all(|served| !served.behind) {
            return;
        }
        let all: Vec<_> = self
            .session()
            .segments()
            .into_iter()
            .filter_map(|info| self.session().segment(info.number).ok().flatten())
            .collect();
        for served in self.served().iter_mut().filter(|served| served.behind) {
            served.behind = false;
            all.iter().for_each(|(info, fd)| served.hand(*info, fd.as_fd()));
        }
    }

    /// A subscriber is served no more.
    pub(super) fn forget(&self, reader: Gid) {
        if !self.session().is_forked() {
            self.served().retain(|served| served.reader != reader);
            self.catch_up();
        }
    }

    /// A publisher is gone.
    pub(super) fn forget_publisher(&self, writer: Gid) {
        if !self.session().is_forked() {
            self.served().retain(|served| served.writer != writer);
        }
    }

    /// A segment of another context was handed over.
    pub(super) fn add_segment(&self, handed: &Handed, fd: impl AsFd) {
        if let Some(peer) = self.known(&handed.session) {
            // One that is refused shows when it is read.
            let _ = peer.add_segment(handed.info(), fd);
        }
    }

    /// A segment of another context was handed over or given up.
    pub(super) fn hear(&self, news: &News) {
        match news {
            News::Handed(handed, fd) => self.add_segment(handed, fd),
            News::Withdrawn(withdrawn) => {
                if let Some(peer) = self.known(&withdrawn.session) {
                    peer.remove_segment(withdrawn.number);
                }
            }
        }
    }

    fn known(&self, session: &SessionId) -> Option<Arc<PeerSession>> {
        let peers = self.inner.peers.lock().unwrap_or_else(PoisonError::into_inner);
        peers.get(session).and_then(Weak::upgrade)
    }

    fn served(&self) -> std::sync::MutexGuard<'_, Vec<Served>> {
        self.inner.served.lock().unwrap_or_else(PoisonError::into_inner)
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
        // A thread of the parent may have held the lock below when this process was forked.
        if self.session().is_forked() {
            return Err(ShmError::Forked);
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
