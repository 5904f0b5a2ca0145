//! The limits of sessions, and the violations of the protocol.

use crate::ids::Gid;

/// Most packets that may wait for one session. Beyond this, the session is sent the complete state instead.
pub const MAX_QUEUE: usize = if cfg!(test) { 24 } else { 4096 };
/// Most bytes of those packets.
pub const MAX_QUEUE_BYTES: usize = if cfg!(test) { 64 << 10 } else { 4 << 20 };
/// Most segments of one session's memory. The daemon holds a descriptor for each.
pub const MAX_SEGMENTS: usize = if cfg!(test) { 256 } else { 1024 };
/// Most pairs that the endpoints of one session may make when they are announced: the pairs of a thousand publishers
/// and a thousand subscriptions. The gateway's stand-ins are limited by its links.
pub const MAX_PAIRS: usize = if cfg!(test) { 1 << 10 } else { 1 << 20 };
/// Most pairs of all sessions.
pub const MAX_ALL_PAIRS: usize = if cfg!(test) { 1 << 18 } else { 1 << 22 };
/// Most refused endpoints of one session that are kept for the status.
pub(super) const MAX_REFUSED: usize = 64;
/// Most bytes of the status in one packet.
pub(super) const STATUS_SLICE: usize = 24 * 1024;
/// Most sessions of one daemon.
pub const MAX_SESSIONS: usize = 4096;
/// Most sessions of one process.
pub const MAX_OF_PROCESS: usize = 256;
/// Most remembered GIDs of endpoints that ended while there was no daemon to tell.
pub(super) const MAX_TOMBSTONES: usize = 4096;
/// Most packets about publishers that ended, kept for readers that never learned of their grant and whose sessions are
/// not connected.
pub(super) const MAX_UNMET: usize = if cfg!(test) { 4 } else { 4096 };
/// Most remembered grants from an earlier daemon's time to readers that are not connected.
pub(super) const MAX_EARLIER_GRANTS: usize = 256;
/// Most grants with rings of killed publishers, kept for readers whose sessions are not connected.
pub(super) const MAX_LEFT: usize = if cfg!(test) { 2 } else { 16 };

/// A violation of the protocol. The session that committed it is disconnected.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Violation {
    /// A message that only a daemon sends, or a second HELLO.
    #[error("an unexpected message")]
    Unexpected,
    /// Descriptors with a message that has none, or a wrong number of them.
    #[error("a message with {0} descriptors")]
    Descriptors(usize),
    /// An endpoint of another session, or a role that the session may not have.
    #[error("endpoint {0} is not its own")]
    NotItsOwn(Gid),
    /// A segment that the session announced before, or in its HELLO.
    #[error("segment {0} of its memory")]
    Segments(u32),
    /// Too many sessions.
    #[error("more than {MAX_SESSIONS} sessions")]
    Sessions,
}
