//! The data that a reader sends to a publisher when it attaches.

use crate::{ids::Gid, qos::Qos, ring::layout::Location, session::peer::RingPeer};

/// A reader that wants to attach.
#[derive(Clone)]
pub struct ReaderInfo {
    /// The subscription.
    pub gid: Gid,
    /// Its lane in its session's memory.
    pub lane: Location,
    /// What it requests.
    pub qos: Qos,
    /// Its session.
    pub peer: RingPeer,
    /// The subscriptions elsewhere that it stands for when it is a relay; `None` when it reads for itself.
    pub stands_for: Option<Vec<Gid>>,
}

impl ReaderInfo {
    /// Whether it reads for subscriptions elsewhere.
    pub(crate) fn is_relay(&self) -> bool {
        self.stands_for.as_ref().is_some_and(|gids| !gids.is_empty())
    }
}

/// What a reader says besides who it is.
#[derive(Clone, Copy, Debug, Default)]
pub struct Terms {
    /// The last number that it has, where it was attached before.
    pub after: Option<u64>,
    /// It carries samples to another process: they are taken when that process has them, and kept for it
    /// for a while when the reader's own ends.
    pub carries: bool,
}
