//! Why an envelope did not open: what may be said aloud, and what stays here.

use core::fmt;

use crate::header::HeaderError;

/// Why an envelope did not open.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// It is no AXQKD001 envelope. Found before any key is looked at.
    #[error("malformed envelope: {0}")]
    Header(#[from] HeaderError),
    /// The caller's buffer is shorter than the plaintext. Nothing has happened; it can be opened
    /// into a larger one.
    #[error("a buffer of {given} bytes for a plaintext of {needed}")]
    BufferTooSmall {
        /// Length of the plaintext.
        needed: usize,
        /// Length of the caller's buffer.
        given: usize,
    },
    /// Every cryptographic failure. The sender must not learn more than this.
    #[error("envelope refused")]
    Refused(Refusal),
}

impl OpenError {
    /// Why the envelope was refused, for this host's own log and counters.
    ///
    /// **Never to be sent to the peer**, not as text, not as an error code and not as a different
    /// reaction: it tells an attacker which keys live and which indexes are spent.
    pub fn cause(&self) -> Option<RefusalCause> {
        match self {
            Self::Refused(refusal) => Some(refusal.cause()),
            _ => None,
        }
    }
}

/// A refusal that prints nothing of its cause, so that an error passed on by accident keeps it.
pub struct Refusal(pub(super) RefusalCause);

impl Refusal {
    /// Why, for this host's own log and counters; see [`OpenError::cause`].
    pub fn cause(&self) -> RefusalCause {
        self.0
    }
}

impl fmt::Debug for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Refusal")
    }
}

/// Why an envelope was refused. For this host alone: see [`OpenError::cause`].
///
/// Where several apply, the first in this order is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum RefusalCause {
    /// The header names another sender than the channel has.
    WrongSender,
    /// The header names another kind or topic than the caller expects.
    WrongRoute,
    /// An index of ten or more.
    IndexOutOfRange,
    /// A key this opener never had, or has forgotten it had.
    UnknownKey,
    /// A key, or an index of it, that is retired: all ten opened, RETIRE came, or too old.
    Retired,
    /// This index has opened already.
    Replayed,
    /// The tag does not fit: another key, receiver or context, or a byte was changed.
    Unauthentic,
}

impl fmt::Display for RefusalCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::WrongSender => "sealed by another sender than this channel's",
            Self::WrongRoute => "sealed for another kind or topic",
            Self::IndexOutOfRange => "index of ten or more",
            Self::UnknownKey => "unknown key_ID",
            Self::Retired => "key or index retired",
            Self::Replayed => "index opened before",
            Self::Unauthentic => "wrong tag: other key, receiver or context, or tampered with",
        })
    }
}
