//! The reasons why an envelope did not open: those that the sender may learn, and those that stay
//! on this host.

use core::fmt;

use crate::header::HeaderError;

/// The reason why an envelope did not open.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The bytes are not an AXQKD001 envelope. This is found before any key is used.
    #[error("malformed envelope: {0}")]
    Header(#[from] HeaderError),
    /// The caller's buffer is shorter than the plaintext. The opener's state is unchanged, and the
    /// envelope can be opened into a larger buffer.
    #[error("a buffer of {given} bytes for a plaintext of {needed}")]
    BufferTooSmall {
        /// The length of the plaintext.
        needed: usize,
        /// The length of the caller's buffer.
        given: usize,
    },
    /// All cryptographic failures. The sender must not learn more than this.
    #[error("envelope refused")]
    Refused(Refusal),
}

impl OpenError {
    /// Returns the reason of a refusal, for this host's own log and counters.
    ///
    /// **Never send it to the peer**, as text, as an error code or as a different reaction: it
    /// tells an attacker which keys are valid and which indexes are used.
    pub fn cause(&self) -> Option<RefusalCause> {
        match self {
            Self::Refused(refusal) => Some(refusal.cause()),
            _ => None,
        }
    }
}

/// A refusal whose output does not contain its cause, so that an error that is passed on by
/// accident does not reveal it.
pub struct Refusal(pub(super) RefusalCause);

impl Refusal {
    /// Returns the cause, for this host's own log and counters; see [`OpenError::cause`].
    pub fn cause(&self) -> RefusalCause {
        self.0
    }
}

impl fmt::Debug for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Refusal")
    }
}

/// The cause of a refusal. It is only for this host: see [`OpenError::cause`].
///
/// If several apply, the first in this order is given, with one exception: an index that has opened
/// under a key that is still held is `Replayed`, even if the key's time is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum RefusalCause {
    /// The header names a sender other than the channel's.
    WrongSender,
    /// The header names a kind or topic other than the caller expects.
    WrongRoute,
    /// The index is ten or more.
    IndexOutOfRange,
    /// The opener never had the key, or has forgotten it.
    UnknownKey,
    /// The key, or this index of it, is retired: all ten messages have opened, RETIRE came, or the
    /// key is too old.
    Retired,
    /// This index has opened already.
    Replayed,
    /// The tag is wrong: the key, receiver or context is another one, or a byte was changed.
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
