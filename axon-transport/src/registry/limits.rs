//! How much a session may have, and how it breaks the protocol.

use crate::ids::Gid;

/// Packets that may wait for one session before it is told everything anew instead.
pub const MAX_QUEUE: usize = if cfg!(test) { 24 } else { 4096 };
/// Their bytes, likewise.
pub const MAX_QUEUE_BYTES: usize = if cfg!(test) { 64 << 10 } else { 4 << 20 };
/// Segments of one session's memory: as many descriptors of the daemon's.
pub const MAX_SEGMENTS: usize = if cfg!(test) { 256 } else { 1024 };
/// Pairs that the endpoints of one session may make when they are announced: what a thousand
/// publishers and as many subscriptions make. The gateway's stand-ins are bounded by its links.
pub const MAX_PAIRS: usize = if cfg!(test) { 1 << 10 } else { 1 << 20 };
/// Pairs of all sessions.
pub const MAX_ALL_PAIRS: usize = if cfg!(test) { 1 << 18 } else { 1 << 22 };
/// Refused endpoints of one session that are remembered for status.
pub(super) const MAX_REFUSED: usize = 64;
/// Bytes of the status in one packet.
pub(super) const STATUS_SLICE: usize = 24 * 1024;
/// Sessions of one daemon.
pub const MAX_SESSIONS: usize = 4096;
/// Those of one process.
pub const MAX_OF_PROCESS: usize = 256;
/// Remembered GIDs of endpoints that ended while there was no daemon to tell.
pub(super) const MAX_TOMBSTONES: usize = 4096;
/// Pairs of a publisher that ended and a reader that never learned of its grant, kept for readers whose sessions are not
/// here.
pub(super) const MAX_UNMET: usize = if cfg!(test) { 4 } else { 4096 };
/// Remembered grants of an earlier daemon's time to readers that are not here.
pub(super) const MAX_EARLIER_GRANTS: usize = 256;
/// Grants of publishers that were killed, with their rings, kept for readers whose sessions are not here.
pub(super) const MAX_LEFT: usize = if cfg!(test) { 2 } else { 16 };

/// What a session did that no session does. It is disconnected.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Violation {
    /// A message that only a daemon sends, or a second HELLO.
    #[error("an unexpected message")]
    Unexpected,
    /// Descriptors where none belong, or not those that do.
    #[error("a message with {0} descriptors")]
    Descriptors(usize),
    /// An endpoint of another session, or a role that is not the session's.
    #[error("endpoint {0} is not its own")]
    NotItsOwn(Gid),
    /// A segment of memory that it announced before, or with its introduction.
    #[error("segment {0} of its memory")]
    Segments(u32),
    /// Too many sessions.
    #[error("more than {MAX_SESSIONS} sessions")]
    Sessions,
}
