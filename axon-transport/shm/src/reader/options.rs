//! The options with which a reader maps a ring.

use crate::{
    ids::Gid,
    qos::Qos,
    ring::{layout::Location, types::Grant},
    session::{lane::Lane, peer::RingPeer},
};

/// The data that a reader needs about the ring that it is granted.
pub struct ReaderOptions {
    /// The subscription.
    pub reader: Gid,
    /// The publisher.
    pub writer: Gid,
    /// The publisher's session.
    pub peer: RingPeer,
    /// The ring's location in that session's memory.
    pub ring: Location,
    /// The lane by which the reader attached.
    pub lane: Lane,
    /// The publisher's grant.
    pub grant: Grant,
    /// The QoS that the subscription requests.
    pub qos: Qos,
    /// The largest sample to expect, in bytes.
    pub max_message: u64,
}
