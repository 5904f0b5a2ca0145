//! The data that a reader sends to a publisher when it attaches.

use crate::{ids::Gid, qos::Qos, ring::layout::Location, session::peer::RingPeer};

/// A reader that wants to attach.
#[derive(Clone)]
pub struct ReaderInfo {
    /// The subscription.
    pub gid: Gid,
    /// Its lane in its session's memory.
    pub lane: Location,
    /// The QoS that it requests.
    pub qos: Qos,
    /// Its session.
    pub peer: RingPeer,
    /// The remote subscriptions that it stands for, if it is a relay; `None` if it reads for itself.
    pub stands_for: Option<Vec<Gid>>,
}

impl ReaderInfo {
    /// Returns whether it reads for remote subscriptions.
    pub(crate) fn is_relay(&self) -> bool {
        self.stands_for.as_ref().is_some_and(|gids| !gids.is_empty())
    }
}

/// The terms of a reader's attachment, beside its identity.
#[derive(Clone, Copy, Debug, Default)]
pub struct Terms {
    /// The last number that it has, if it was attached before.
    pub after: Option<u64>,
    /// True if it carries samples to another process: a sample counts as taken when that process has it, and is kept
    /// for it for a while if the reader's own process ends.
    pub carries: bool,
}
