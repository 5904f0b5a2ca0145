//! The context that the publishers and subscribers of a process share without a daemon: its memory, its doorbell,
//! and the other contexts that it has mapped.

use std::{
    collections::HashMap,
    fmt,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use crate::{
    direct::{
        connect::{PublisherAnswer, SegmentUpdate},
        segment_channels::SegmentChannels,
    },
    error::ShmError,
    ids::{Gid, SessionId},
    os::descriptors::PassedFd,
    ring::layout::Location,
    session::{
        leader::ExternalLeader,
        peer::{PeerDescriptors, PeerSession, RingPeer},
        segment::SessionSegment,
        segment_message::{SegmentName, SegmentOpened},
    },
};

/// Most segments of one other context that are kept to be mapped later.
const MAX_KEPT_SEGMENTS: usize = 64;

/// The memory, doorbell and identity that publishers and subscribers of a process share. It starts no thread. Clones
/// share the same context. All methods may be called from any thread.
///
/// ```
/// use axon_shm::{Context, Publisher, PublisherOptions, qos::Qos};
///
/// let context = Context::new()?;
/// let options = PublisherOptions::new(Qos::default());
/// let [left, right] = [Publisher::new(&context, options)?, Publisher::new(&context, options)?];
/// assert_ne!(left.gid(), right.gid());
/// # Ok::<(), axon_shm::ShmError>(())
/// ```
#[derive(Clone)]
pub struct Context {
    inner: Arc<ContextInner>,
}

struct ContextInner {
    session: Arc<SessionSegment>,
    entities: AtomicU32,
    /// The other contexts; each is mapped once.
    peers: Mutex<HashMap<SessionId, MappedContext>>,
    lines: Arc<SegmentChannels>,
    /// Segments that other contexts passed and that could not be mapped yet.
    unmapped: Mutex<Vec<Unmapped>>,
    /// Pending requests of this context's subscribers, with the answers of its own publishers.
    own: Mutex<HashMap<Gid, OwnQuestion>>,
}

type Unmapped = (Weak<PeerSession>, SegmentOpened, PassedFd);

/// A pending request of a subscriber of this context.
struct OwnQuestion {
    lane: Location,
    granted: Option<PublisherAnswer>,
}

/// Registers a subscriber's request until the answer arrives; dropping it removes the request.
pub(crate) struct SubscriberQuestion<'a> {
    context: &'a Context,
    reader: Gid,
}

impl SubscriberQuestion<'_> {
    /// Returns this context as the peer, for an answer `granted` that names this context. The context's id, memory and
    /// pidfd prove nothing, because every peer has them. So a publisher of this context must have granted exactly this.
    pub(crate) fn answered(&self, granted: &PublisherAnswer) -> Result<RingPeer, ShmError> {
        match self.context.own()?.get(&self.reader) {
            Some(own) if own.granted.as_ref() == Some(granted) => Ok(self.context.local()),
            _ => Err(ShmError::Refused { what: "no publisher of this context has granted that" }),
        }
    }
}

impl Drop for SubscriberQuestion<'_> {
    fn drop(&mut self) {
        if let Ok(mut own) = self.context.own() {
            own.remove(&self.reader);
        }
    }
}

/// Another context, which this one has mapped.
struct MappedContext {
    session: Weak<PeerSession>,
    /// Device and inode of its first segment.
    memory: (u64, u64),
}

impl Context {
    /// Creates a context of this process.
    ///
    /// # Errors
    /// Memory or descriptors are short, or the system has no sealed memfds.
    pub fn new() -> Result<Self, ShmError> {
        Ok(Self::of(SessionSegment::create(SessionId::random())?))
    }

    fn of(session: Arc<SessionSegment>) -> Self {
        let (entities, peers) = (AtomicU32::new(1), Mutex::default());
        let lines = Arc::new(SegmentChannels::new(session.id()));
        let told = Arc::clone(&lines);
        session.on_segment(move |event| told.tell(event));
        let (unmapped, own) = (Mutex::default(), Mutex::default());
        Self { inner: Arc::new(ContextInner { session, entities, peers, lines, unmapped, own }) }
    }

    /// Handles an update that another context sent over its own line: it opened or dropped a segment. Ignores updates
    /// about segments of other contexts.
    pub(crate) fn hear(&self, from: &Arc<PeerSession>, news: SegmentUpdate) {
        let (SegmentUpdate::Opened(SegmentOpened { session, .. }, _)
        | SegmentUpdate::Gone(SegmentName { session, .. })) = &news;
        if *session != from.id() {
            return;
        }
        match news {
            SegmentUpdate::Opened(opened, fd) => match from.add_segment(opened.segment.into(), &fd)
            {
                // A refused segment is reported when the reader needs it.
                Ok(()) | Err(ShmError::Refused { .. }) => {}
                Err(_) => {
                    let mut unmapped = self.unmapped();
                    let of = |other: &&Unmapped| other.0.as_ptr() == Arc::as_ptr(from);
                    // The other context announces it on each of its lines.
                    let known = unmapped.iter().filter(of).any(|(_, other, _)| *other == opened);
                    if !known && unmapped.iter().filter(of).count() < MAX_KEPT_SEGMENTS {
                        unmapped.push((Arc::downgrade(from), opened, fd));
                    }
                }
            },
            SegmentUpdate::Gone(gone) => {
                self.unmapped().retain(|(_, opened, _)| {
                    (opened.session, opened.segment.number) != (gone.session, gone.number)
                });
                from.remove_segment(gone.number);
            }
        }
    }

    /// Maps segments that could not be mapped when they arrived, if that is possible now.
    pub(crate) fn hear_again(&self) {
        // The lock is held: a segment that is dropped meanwhile is either found in this list or already mapped.
        self.unmapped().retain(|(from, opened, fd)| {
            let mapped = |from: Arc<PeerSession>| from.add_segment(opened.segment.into(), fd);
            !matches!(
                from.upgrade().map(mapped),
                None | Some(Ok(()) | Err(ShmError::Refused { .. }))
            )
        });
    }

    fn unmapped(&self) -> MutexGuard<'_, Vec<Unmapped>> {
        self.inner.unmapped.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn lines(&self) -> &SegmentChannels {
        &self.inner.lines
    }

    /// Returns the context's id.
    #[inline]
    pub fn id(&self) -> SessionId {
        self.session().id()
    }

    /// Blocks until `ready` returns true or until `timeout` has passed. `ready` is called again whenever a sample was
    /// published to a subscriber of this context or [`notify`](Self::notify) was called. Returns the last result of
    /// `ready`.
    pub fn wait(&self, ready: impl FnMut() -> bool, timeout: Option<Duration>) -> bool {
        self.session().wait(ready, timeout)
    }

    /// Makes every [`wait`](Self::wait) call its `ready` again.
    pub fn notify(&self) {
        self.session().notify();
    }

    /// Returns a descriptor for an event loop, also an asynchronous one. It becomes readable when subscribers should be
    /// checked. [`ExternalLeader`] describes its use, with an example.
    ///
    /// # Errors
    /// The context has one already.
    pub fn event(&self) -> Result<ExternalLeader, ShmError> {
        self.session().external_leader()
    }

    #[inline]
    pub(crate) fn session(&self) -> &Arc<SessionSegment> {
        &self.inner.session
    }

    pub(crate) fn next_gid(&self) -> Gid {
        Gid::new(self.id(), self.inner.entities.fetch_add(1, Ordering::Relaxed))
    }

    /// Registers that a subscriber of this context is about to send a request with `lane`.
    pub(crate) fn asking(
        &self,
        reader: Gid,
        lane: Location,
    ) -> Result<SubscriberQuestion<'_>, ShmError> {
        self.own()?.insert(reader, OwnQuestion { lane, granted: None });
        Ok(SubscriberQuestion { context: self, reader })
    }

    /// Returns this context as the peer, if a subscriber of it has sent this request.
    pub(crate) fn asked_itself(&self, reader: Gid, lane: Location) -> Result<RingPeer, ShmError> {
        match self.own()?.get(&reader) {
            Some(own) if own.lane == lane => Ok(self.local()),
            _ => Err(ShmError::Refused { what: "no subscriber of this context asks for that" }),
        }
    }

    /// Registers the answer of a publisher of this context, if a subscriber of this context asked.
    pub(crate) fn granted_itself(&self, granted: &PublisherAnswer) -> Result<(), ShmError> {
        if let Some(own) = self.own()?.get_mut(&granted.reader) {
            own.granted = Some(*granted);
        }
        Ok(())
    }

    fn local(&self) -> RingPeer {
        RingPeer::Local(Arc::clone(self.session()))
    }

    fn own(&self) -> Result<MutexGuard<'_, HashMap<Gid, OwnQuestion>>, ShmError> {
        // A thread of the parent may have held the lock when this process was forked.
        if self.session().is_forked() {
            return Err(ShmError::Forked);
        }
        Ok(self.inner.own.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Returns another context `id`, and maps it if it is not mapped yet.
    pub(crate) fn peer(
        &self,
        id: SessionId,
        descriptors: PeerDescriptors,
    ) -> Result<RingPeer, ShmError> {
        // A thread of the parent may have held the lock below when this process was forked.
        if self.session().is_forked() {
            return Err(ShmError::Forked);
        }
        let refuse = |what| Err(ShmError::Refused { what });
        let process = descriptors
            .process()
            .map_err(|source| ShmError::System { what: "looking up a process", source })?;
        let Some(process) = process else {
            return refuse(
                "its pidfd names no process here: containers must share their processes (--pid)",
            );
        };
        let Some(memory) = descriptors.segment.memory() else {
            return refuse("its first segment is no memfd");
        };
        let mut peers = self.inner.peers.lock().unwrap_or_else(PoisonError::into_inner);
        peers.retain(|_, known| known.session.strong_count() > 0);
        if let Some(known) = peers.get(&id)
            && let Some(session) = known.session.upgrade()
        {
            // Ids are no secret. Without this check the owner of an id would get the session of another process that
            // used the id first.
            if known.memory != memory || !session.is_of(process) {
                return refuse("another process has this context's id");
            }
            return Ok(RingPeer::Remote(session));
        }
        let others: Vec<_> = peers.values().filter_map(|other| other.session.upgrade()).collect();
        let session = PeerSession::map_among(id, descriptors, &others)?;
        peers.insert(id, MappedContext { session: Arc::downgrade(&session), memory });
        Ok(RingPeer::Remote(session))
    }
}

impl fmt::Debug for Context {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Context").field(&self.id()).finish()
    }
}
