//! The rings of one that writes: one that all readers share, or one for each of them.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use crate::{
    ids::Gid,
    shm::{Grant, Location, ReaderInfo, RingOptions, SessionSegment, ShmError, Writer},
};

pub(super) enum Rings {
    /// A publisher's samples, or a client's requests.
    Shared(Arc<Writer>),
    /// A server's responses, which are nobody's but the client's who asked.
    Each(Arc<Lanes>),
}

/// A server's rings by client. Each is made when its client comes, and goes with it.
pub(super) struct Lanes {
    session: Arc<SessionSegment>,
    options: RingOptions,
    rings: Mutex<BTreeMap<Gid, Arc<Writer>>>,
}

impl Rings {
    pub(super) fn shared(&self) -> Option<&Arc<Writer>> {
        match self {
            Self::Shared(writer) => Some(writer),
            Self::Each(_) => None,
        }
    }

    /// Serves a reader: what it is granted, and in which ring.
    pub(super) fn attach(&self, reader: ReaderInfo) -> Result<(Grant, Location), ShmError> {
        let writer = match self {
            Self::Shared(writer) => writer.clone(),
            Self::Each(lanes) => lanes.ring_for(reader.gid)?,
        };
        Ok((writer.attach(reader)?, writer.location()))
    }

    /// Whether it is one of them that is there.
    pub(super) fn has(&self, at: Location) -> bool {
        match self {
            Self::Shared(writer) => writer.location() == at,
            Self::Each(lanes) => lanes.lock().values().any(|ring| ring.location() == at),
        }
    }

    /// Whether it was attached.
    pub(super) fn detach(&self, reader: Gid) -> bool {
        match self {
            Self::Shared(writer) => writer.detach(reader),
            Self::Each(lanes) => lanes.lock().remove(&reader).is_some(),
        }
    }

    /// Forgets the readers whose process has ended, and names them.
    pub(super) fn drop_dead(&self) -> Vec<Gid> {
        match self {
            Self::Shared(writer) => writer.drop_dead(),
            Self::Each(lanes) => {
                let mut gone = Vec::new();
                lanes.lock().retain(|reader, ring| {
                    let dead = !ring.drop_dead().is_empty();
                    gone.extend(dead.then_some(*reader));
                    !dead
                });
                gone
            }
        }
    }

    /// Who is served; a relay shows as those that it stands for.
    pub(super) fn readers(&self) -> Vec<Gid> {
        match self {
            Self::Shared(writer) => writer.readers(),
            Self::Each(lanes) => lanes.lock().keys().copied().collect(),
        }
    }

    /// Looks after the memory of large samples; whether there is more to do later.
    pub(super) fn tend(&self, now: Instant) -> bool {
        match self {
            Self::Shared(writer) => writer.tend(now),
            Self::Each(lanes) => {
                let rings: Vec<_> = lanes.lock().values().cloned().collect();
                rings.iter().filter(|ring| ring.tend(now)).count() > 0
            }
        }
    }

    /// Opens memory for large samples before they come. What lacks then, the next publish says.
    pub(super) fn prepare(&self) {
        if let Self::Shared(writer) = self {
            let _ = writer.prepare();
        }
    }
}

impl Lanes {
    pub(super) fn new(session: Arc<SessionSegment>, options: RingOptions) -> Self {
        Self { session, options, rings: Mutex::default() }
    }

    /// The ring of a client; `None` when it is not, or no more, served.
    pub(super) fn ring(&self, client: &Gid) -> Option<Arc<Writer>> {
        self.lock().get(client).cloned()
    }

    fn ring_for(&self, client: Gid) -> Result<Arc<Writer>, ShmError> {
        if let Some(ring) = self.ring(&client) {
            return Ok(ring);
        }
        let ring = Arc::new(Writer::create(self.session.clone(), self.options)?);
        self.lock().insert(client, ring.clone());
        Ok(ring)
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Gid, Arc<Writer>>> {
        self.rings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
