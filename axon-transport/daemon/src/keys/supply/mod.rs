//! Keys for `messages10`: ten messages each, fetched ahead, announced, proven, used, retired (docs/formats.md,
//! section 4).
//!
//! Each host is master for the messages that it sends: its [`KeySender`] requests keys, and the peer's [`KeyReceiver`]
//! fetches the same keys. There is one pair for each peer SAE, and it outlives connections. The rules of
//! [`etsi_qkd014::pool`] decide when to draw from the KME, and how many keys.

mod connection_keys;
mod demand;
mod disagreement;
mod key_plan;
mod pool;
mod receiver;
mod sender;
mod sender_connections;
mod sender_statistics;

#[cfg(test)]
mod tests;

use axon_envelope::{ChannelError, RandomError};

pub use demand::SupplyWarning;
pub use disagreement::Disagreement;
pub use receiver::{KeyReceiver, ReceiverStatistics};
pub use sender::{KeySender, NoKey};
pub use sender_statistics::SenderStatistics;

use super::KeyViolation;

/// Most keys of one direction that are announced and not retired.
pub const MAX_UNRETIRED: usize = 4096;

/// The reason for which the supply of a link stops.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SupplyError {
    /// The peer violated the protocol.
    #[error(transparent)]
    Violation(#[from] KeyViolation),
    /// The SAE IDs do not make a channel.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The system returned no random bytes.
    #[error(transparent)]
    Random(#[from] RandomError),
    /// A message arrived on a connection that is not attached.
    #[error("connection {0} is not attached to this supply")]
    Unattached(u64),
}

impl SupplyError {
    /// Returns the application error code to close the connection with (docs/formats.md, section 6).
    pub fn code(&self) -> u64 {
        match self {
            Self::Violation(violation) => violation.code(),
            _ => 0x50,
        }
    }
}
