//! Stand-ins: local writers for remote publishers, clients and servers.

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    fmt,
    rc::{Rc, Weak},
};

use axon_shm::{Meta, ids::Gid};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    internal::session::Written,
};

use super::rings::{RingError, RingWriter, Rings};
use crate::engine::account::{Account, Charge};

/// A stand-in. A link and its successor share it.
pub(crate) struct StandIn {
    ring: Rc<dyn RingWriter>,
    gid: Gid,
    /// Whether it writes samples or requests, whose numbers rise. A server answers calls in any order.
    rises: bool,
    /// The number that was written last; 0 is none.
    last: Cell<u64>,
    _place: Charge,
}

impl StandIn {
    /// The remote endpoint's GID.
    pub(crate) fn gid(&self) -> Gid {
        self.gid
    }

    /// Its ring.
    pub(crate) fn ring(&self) -> &dyn RingWriter {
        &*self.ring
    }

    /// Writes a sample. A subscription that sleeps may sleep on until [`announce`](Self::announce).
    ///
    /// # Errors
    /// The ring is full, or the sample is lost.
    pub(crate) fn try_write(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<Written, RingError> {
        let sequence = meta.sequence;
        let written = self.ring.try_write(client, meta, payload)?;
        self.last.set(sequence);
        Ok(written)
    }

    /// Wakes the subscriptions that sleep, for all samples that were written.
    pub(crate) fn announce(&self) {
        self.ring.announce();
    }

    /// The number of the newest sample of a publisher, or request of a client, that is in the ring.
    pub(crate) fn last_sequence(&self) -> Option<u64> {
        Some(self.last.get()).filter(|last| self.rises && *last > 0)
    }
}

impl fmt::Debug for StandIn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("StandIn").field(&self.gid).finish()
    }
}

/// Why there is no stand-in for an endpoint.
#[derive(Debug)]
pub(crate) enum NoStandIn {
    /// The identity that announced it has as many as it may.
    TooMany,
    /// The text says why.
    Failed(String),
}

/// All stand-ins of this host.
#[derive(Default)]
pub(crate) struct StandIns {
    known: RefCell<HashMap<Gid, Weak<StandIn>>>,
    /// When so many are known, those that are gone are forgotten.
    clean_at: Cell<usize>,
}

/// As many are known before those that are gone are forgotten.
const KNOWN: usize = 64;

impl StandIns {
    /// The stand-in for `remote`: the one that exists, or a new one that `account` pays for.
    ///
    /// # Errors
    /// [`NoStandIn`].
    pub(crate) fn get(
        &self,
        rings: &dyn Rings,
        remote: &Endpoint,
        account: &Account,
    ) -> Result<Rc<StandIn>, NoStandIn> {
        let mut known = self.known.borrow_mut();
        if let Some(stand_in) = known.get(&remote.gid).and_then(Weak::upgrade) {
            if stand_in.ring.endpoint() == remote {
                return Ok(stand_in);
            }
            return Err(NoStandIn::Failed(format!("{} stands for another endpoint", remote.gid)));
        }
        let Some(place) = account.stand_ins.charge(1) else { return Err(NoStandIn::TooMany) };
        let stand_in = Rc::new(StandIn {
            ring: rings.open_writer(remote).map_err(NoStandIn::Failed)?,
            gid: remote.gid,
            rises: remote.kind != EndpointKind::Server,
            last: Cell::new(0),
            _place: place,
        });
        // Once for as many as there are: of thousands one comes at a time.
        if known.len() >= self.clean_at.get() {
            known.retain(|_, other| other.strong_count() > 0);
            self.clean_at.set(2 * known.len().max(KNOWN));
        }
        known.insert(remote.gid, Rc::downgrade(&stand_in));
        Ok(stand_in)
    }
}
