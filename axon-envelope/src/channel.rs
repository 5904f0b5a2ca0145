//! The identities of a channel: SAE IDs, the context of the connection, and key_IDs.

use alloc::sync::Arc;
use alloc::vec::Vec;
use core::borrow::Borrow;
use core::fmt;

use zeroize::Zeroizing;

/// The longest SAE ID and the longest key_ID, in bytes. The shortest has 1 byte.
pub const MAX_ID_LEN: usize = 255;

/// The longest context, in bytes.
pub const MAX_CONTEXT_LEN: usize = u16::MAX as usize;

/// An ID that is empty or longer than [`MAX_ID_LEN`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("an ID of {0} bytes: an SAE ID or key_ID has 1 to 255")]
pub struct IdError(pub usize);

/// The name of a key, as the sender's KME wrote it.
///
/// It is compared byte for byte: two spellings of one UUID are two key_IDs. A clone is cheap.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeyId(Arc<[u8]>);

impl KeyId {
    /// Makes a key_ID.
    ///
    /// # Errors
    /// [`IdError`] unless it has 1 to [`MAX_ID_LEN`] bytes.
    pub fn new(id: impl AsRef<[u8]>) -> Result<Self, IdError> {
        Ok(Self(checked_id(id.as_ref())?.into()))
    }

    /// Returns the bytes of the ID.
    pub fn as_bytes(&self) -> &[u8] {
        &self.0
    }
}

impl AsRef<[u8]> for KeyId {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

// Slices compare and hash as the derived implementations of `Arc<[u8]>` do. Look-ups by `&[u8]`
// depend on this.
impl Borrow<[u8]> for KeyId {
    fn borrow(&self) -> &[u8] {
        &self.0
    }
}

/// Shows printable ASCII unchanged and escapes all other bytes, so that a peer's key_ID cannot
/// forge a log line.
impl fmt::Display for KeyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0.escape_ascii())
    }
}

impl fmt::Debug for KeyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "KeyId({self})")
    }
}

/// One direction of one connection: the SAE that seals, the SAE that opens, and the context on
/// which both agreed.
///
/// Every key derived for the channel is bound to all three, so an envelope for one channel does not
/// open on another. The context is opaque to this crate. It must be new for every connection;
/// otherwise envelopes of an earlier connection open again after both ends have restarted. AXON
/// uses the TLS exporter `EXPORTER-AXQKD001`.
#[derive(Clone)]
pub struct Channel {
    sender: Arc<[u8]>,
    receiver: Arc<[u8]>,
    context: Arc<Zeroizing<Vec<u8>>>,
}

/// The reason why a [`Channel`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChannelError {
    /// The sender's SAE ID is empty or too long.
    #[error("sender: {0}")]
    Sender(IdError),
    /// The receiver's SAE ID is empty or too long.
    #[error("receiver: {0}")]
    Receiver(IdError),
    /// Both ends have the same SAE ID, so a reflected message would open.
    #[error("sender and receiver have the same SAE ID: each end needs an SAE ID of its own")]
    SameSae,
    /// The context is longer than [`MAX_CONTEXT_LEN`].
    #[error("a context of {0} bytes: at most 65,535 are allowed")]
    Context(usize),
}

impl Channel {
    /// Makes a channel.
    ///
    /// # Errors
    /// [`ChannelError`] if an ID does not have 1 to 255 bytes, both are the same, or the context
    /// has more than 65,535 bytes.
    pub fn new(
        sender: impl AsRef<[u8]>,
        receiver: impl AsRef<[u8]>,
        context: impl AsRef<[u8]>,
    ) -> Result<Self, ChannelError> {
        let sender = checked_id(sender.as_ref()).map_err(ChannelError::Sender)?;
        let receiver = checked_id(receiver.as_ref()).map_err(ChannelError::Receiver)?;
        let context = context.as_ref();
        if sender == receiver {
            return Err(ChannelError::SameSae);
        }
        if context.len() > MAX_CONTEXT_LEN {
            return Err(ChannelError::Context(context.len()));
        }
        Ok(Self {
            sender: sender.into(),
            receiver: receiver.into(),
            context: Arc::new(Zeroizing::new(context.to_vec())),
        })
    }

    /// Returns the other direction of the same connection.
    #[must_use]
    pub fn reversed(&self) -> Self {
        Self {
            sender: self.receiver.clone(),
            receiver: self.sender.clone(),
            context: self.context.clone(),
        }
    }

    /// Returns the SAE ID of the end that seals.
    pub fn sender(&self) -> &[u8] {
        &self.sender
    }

    /// Returns the SAE ID of the end that opens.
    pub fn receiver(&self) -> &[u8] {
        &self.receiver
    }

    pub(crate) fn context(&self) -> &[u8] {
        &self.context
    }
}

/// Omits the context, because an exporter value is a secret of the connection.
impl fmt::Debug for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Channel")
            .field("sender", &format_args!("{}", self.sender.escape_ascii()))
            .field("receiver", &format_args!("{}", self.receiver.escape_ascii()))
            .finish_non_exhaustive()
    }
}

fn checked_id(id: &[u8]) -> Result<&[u8], IdError> {
    if (1..=MAX_ID_LEN).contains(&id.len()) { Ok(id) } else { Err(IdError(id.len())) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::{format, vec};

    #[test]
    fn ids_have_1_to_255_bytes() {
        assert_eq!(KeyId::new("").unwrap_err(), IdError(0));
        assert_eq!(KeyId::new(vec![b'x'; 256]).unwrap_err(), IdError(256));
        assert_eq!(KeyId::new(vec![b'x'; 255]).unwrap().as_bytes().len(), 255);
        let err = Channel::new("", "b", []).unwrap_err();
        assert_eq!(err, ChannelError::Sender(IdError(0)));
        let err = Channel::new("a", vec![b'x'; 256], []).unwrap_err();
        assert_eq!(err, ChannelError::Receiver(IdError(256)));
    }

    #[test]
    fn a_channel_to_oneself_and_an_endless_context_are_refused() {
        assert_eq!(Channel::new("a", "a", []).unwrap_err(), ChannelError::SameSae);
        let err = Channel::new("a", "b", vec![0; 65_536]).unwrap_err();
        assert_eq!(err, ChannelError::Context(65_536));
        assert!(Channel::new("a", "b", vec![0; 65_535]).is_ok());
    }

    #[test]
    fn printing_escapes_ids_and_hides_the_context() {
        let id = KeyId::new(b"a\n\xff").unwrap();
        assert_eq!(format!("{id} {id:?}"), r"a\n\xff KeyId(a\n\xff)");
        let channel = Channel::new("alice", "bob", b"exporter").unwrap();
        assert_eq!(format!("{channel:?}"), "Channel { sender: alice, receiver: bob, .. }");
    }
}
