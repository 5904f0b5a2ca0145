//! The rings of a writing endpoint: one ring for all readers, or for a server one ring for each client.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::Instant,
};

use axon_shm::{
    ShmError,
    internal::{
        Grant, Location, MemoryBudget, ReaderInfo, RingOptions, SessionSegment, Terms, Writer,
    },
};

use crate::ids::Gid;

pub(in crate::session) enum WriterRings {
    /// A publisher's samples, or a client's requests.
    Shared(Arc<Writer>),
    /// A server's responses: each client reads only its own ring.
    Each(Arc<RingsByClient>),
}

/// A server's rings by client. Each is created when its client comes, and is removed with it. If a daemon carries the
/// client and the daemon's process ends, the ring stays for a while: the client may not have all responses.
pub(in crate::session) struct RingsByClient {
    session: Arc<SessionSegment>,
    options: RingOptions,
    room: Arc<ClientLimit>,
    /// The memory budget that they share with rings of other endpoints.
    budget: Option<Arc<MemoryBudget>>,
    rings: Mutex<BTreeMap<Gid, (Arc<Writer>, ClientSlot)>>,
}

/// The number of clients that the servers of a session have and may have. A client counts once for each server that it
/// uses.
#[derive(Debug)]
pub(in crate::session) struct ClientLimit {
    most: usize,
    taken: AtomicUsize,
}

/// The slot of one client of one server in a [`ClientLimit`].
struct ClientSlot(Arc<ClientLimit>);

impl ClientLimit {
    pub(in crate::session) fn new(most: usize) -> Self {
        Self { most, taken: AtomicUsize::new(0) }
    }

    // Relaxed, here and below: the count guards nothing but itself.
    fn take(self: &Arc<Self>) -> Result<ClientSlot, ShmError> {
        let more = |taken| (taken < self.most).then_some(taken + 1);
        match self.taken.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more) {
            Ok(_) => Ok(ClientSlot(Arc::clone(self))),
            Err(_) => Err(ShmError::TooManyClients(self.most)),
        }
    }
}

impl Drop for ClientSlot {
    fn drop(&mut self) {
        self.0.taken.fetch_sub(1, Ordering::Relaxed);
    }
}

impl WriterRings {
    pub(in crate::session) fn shared(&self) -> Option<&Arc<Writer>> {
        match self {
            Self::Shared(writer) => Some(writer),
            Self::Each(_) => None,
        }
    }

    /// Attaches a reader. Returns the grant, the number in front of the granted samples, and the location of the ring.
    pub(in crate::session) fn attach(
        &self,
        reader: ReaderInfo,
        terms: Terms,
    ) -> Result<(Grant, u64, Location), ShmError> {
        let writer = match self {
            Self::Shared(writer) => writer.clone(),
            Self::Each(rings) => rings.ring_for(reader.gid)?,
        };
        let (grant, after) = writer.attach_on(reader, terms)?;
        Ok((grant, after, writer.location()))
    }

    /// Returns whether one of the rings is at this location.
    pub(in crate::session) fn has(&self, at: Location) -> bool {
        match self {
            Self::Shared(writer) => writer.location() == at,
            Self::Each(rings) => rings.lock().values().any(|(ring, _)| ring.location() == at),
        }
    }

    /// Detaches a reader. Returns whether it was attached.
    pub(in crate::session) fn detach(&self, reader: Gid) -> bool {
        match self {
            Self::Shared(writer) => writer.detach(reader),
            Self::Each(rings) => {
                let mut rings = rings.lock();
                let Some((ring, _)) = rings.get(&reader) else { return false };
                let attached = ring.detach(reader);
                if !ring.has_absent_readers() {
                    rings.remove(&reader);
                }
                attached
            }
        }
    }

    /// Counts samples that a relay gave up.
    pub(in crate::session) fn give_up(&self, reader: Gid, samples: u64) {
        if let Self::Shared(writer) = self {
            writer.give_up(reader, samples);
        }
    }

    /// Forgets the readers whose process has ended, and returns them.
    pub(in crate::session) fn drop_dead(&self) -> Vec<Gid> {
        match self {
            Self::Shared(writer) => writer.drop_dead(),
            Self::Each(rings) => {
                let mut gone = Vec::new();
                rings.lock().retain(|reader, (ring, _)| {
                    let dead = !ring.drop_dead().is_empty();
                    gone.extend(dead.then_some(*reader));
                    !dead || ring.has_absent_readers()
                });
                gone
            }
        }
    }

    /// Returns the attached readers; a relay counts as the readers that it stands for.
    pub(in crate::session) fn readers(&self) -> Vec<Gid> {
        match self {
            Self::Shared(writer) => writer.readers(),
            Self::Each(rings) => {
                let rings = rings.lock();
                let read = rings.iter().filter(|(_, (ring, _))| !ring.readers().is_empty());
                read.map(|(client, _)| *client).collect()
            }
        }
    }

    /// Reclaims idle memory of large samples. Returns whether there is more to do later.
    pub(in crate::session) fn reclaim_idle(&self, now: Instant) -> bool {
        match self {
            Self::Shared(writer) => writer.reclaim_idle(now),
            Self::Each(rings) => {
                let absent = rings.drop_abandoned();
                let rings: Vec<_> = rings.lock().values().map(|(ring, _)| ring.clone()).collect();
                rings.iter().filter(|ring| ring.reclaim_idle(now)).count() > 0 || absent
            }
        }
    }

    /// Opens memory for large samples before they come. The next publish reports an error, if the memory is still
    /// missing.
    pub(in crate::session) fn prepare(&self) {
        if let Self::Shared(writer) = self {
            let _ = writer.prepare();
        }
    }
}

impl RingsByClient {
    pub(in crate::session) fn new(
        session: Arc<SessionSegment>,
        options: RingOptions,
        room: Arc<ClientLimit>,
        budget: Option<Arc<MemoryBudget>>,
    ) -> Self {
        Self { session, options, room, budget, rings: Mutex::default() }
    }

    /// Returns the ring of a client; `None` if the client is not, or not any more, served.
    pub(in crate::session) fn ring(&self, client: &Gid) -> Option<Arc<Writer>> {
        self.lock().get(client).map(|(ring, _)| ring.clone())
    }

    /// Drops the rings of clients whose daemon ended and that did not come back by way of the next daemon. Returns
    /// whether clients remain that may still come back.
    fn drop_abandoned(&self) -> bool {
        let mut rings = self.lock();
        let mut absent = false;
        rings.retain(|_, (ring, _)| {
            if !ring.readers().is_empty() {
                return true;
            }
            // Gives up the samples that the ring kept, and logs that.
            ring.drop_dead();
            let kept = ring.has_absent_readers();
            absent |= kept;
            kept
        });
        absent
    }

    fn ring_for(&self, client: Gid) -> Result<Arc<Writer>, ShmError> {
        if let Some(ring) = self.ring(&client) {
            return Ok(ring);
        }
        let place = self.room.take()?;
        let ring = Arc::new(Writer::create_for_calls(self.session.clone(), self.options)?);
        if let Some(budget) = &self.budget {
            ring.share(budget);
        }
        self.lock().insert(client, (ring.clone(), place));
        Ok(ring)
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Gid, (Arc<Writer>, ClientSlot)>> {
        self.rings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
