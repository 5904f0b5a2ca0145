//! A sealer that fetches the next key automatically.

use core::fmt;
use core::time::Duration;

use crate::aead::{Aead, DefaultAead};
use crate::channel::{Channel, KeyId};
use crate::key::{KmeKey, RandomError};
use crate::mask::Delivery;
use crate::seal::{Retirement, Sealer, Slot};

/// The source of a [`RotatingSealer`]'s keys, which also learns when a key is retired.
pub trait KeySource {
    /// Returns the next key that the receiver is known to hold, or `None` if there is none now. It
    /// does not block.
    ///
    /// It must never return the same key twice. The caller's KME delivers each key_ID once.
    fn next_key(&mut self) -> Option<(KeyId, KmeKey)>;

    /// Called when a key seals no more messages. The receiver has to be told, as with RETIRE.
    fn retired(&mut self, retirement: Retirement);
}

/// The reason why there is no slot for a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RotateError {
    /// The source has no key. The message waits, or is dropped and counted.
    #[error("no key is ready: the demand for keys exceeds what the KME supplies")]
    NoKey,
    /// The system gave no random bytes for the next key's nonce.
    #[error(transparent)]
    Random(#[from] RandomError),
}

/// Seals messages, and takes a new key from its [`KeySource`] whenever one is spent.
pub struct RotatingSealer<S: KeySource, A: Aead = DefaultAead> {
    channel: Channel,
    source: S,
    sealer: Option<Sealer<A>>,
}

impl<S: KeySource> RotatingSealer<S> {
    /// Makes a sealer that takes its first key with the first message, with the default AEAD.
    pub fn new(channel: Channel, source: S) -> Self {
        Self::with_aead(channel, source)
    }
}

impl<S: KeySource, A: Aead> RotatingSealer<S, A> {
    /// As [`RotatingSealer::new`], with the AEAD that the caller chooses.
    pub fn with_aead(channel: Channel, source: S) -> Self {
        Self { channel, source, sealer: None }
    }

    /// Returns a permit for one message, under the next key if the current one is spent.
    ///
    /// # Errors
    /// [`RotateError::NoKey`] while the source has none. The call can be repeated.
    pub fn slot(&mut self, now: Duration, delivery: Delivery) -> Result<Slot<'_, A>, RotateError> {
        if self.sealer.as_ref().is_none_or(|sealer| sealer.spent(now).is_some()) {
            if let Some(sealer) = self.sealer.take() {
                self.source.retired(sealer.retire());
            }
            let (key_id, key) = self.source.next_key().ok_or(RotateError::NoKey)?;
            self.sealer = Some(Sealer::with_aead(&self.channel, key_id, key)?);
        }
        let sealer = self.sealer.as_mut().ok_or(RotateError::NoKey)?;
        sealer.slot(now, delivery).map_err(|_| RotateError::NoKey)
    }

    /// Returns how many messages the current key can still seal. Its age is not considered.
    pub fn remaining(&self) -> u8 {
        self.sealer.as_ref().map_or(0, Sealer::remaining)
    }

    /// Returns the source of keys.
    pub fn source_mut(&mut self) -> &mut S {
        &mut self.source
    }

    /// Consumes the sealer. Returns the source, and the sealer of the current key if there is one.
    pub fn into_parts(self) -> (S, Option<Sealer<A>>) {
        (self.source, self.sealer)
    }
}

impl<S: KeySource, A: Aead> fmt::Debug for RotatingSealer<S, A> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RotatingSealer")
            .field("channel", &self.channel)
            .field("sealer", &self.sealer)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{IndexMask, KEY_MAX_AGE, Kind, Route, TopicHash};
    use alloc::vec::Vec;

    #[derive(Default)]
    struct Source {
        given: u8,
        stock: u8,
        retired: Vec<Retirement>,
    }

    impl KeySource for Source {
        fn next_key(&mut self) -> Option<(KeyId, KmeKey)> {
            self.stock = self.stock.checked_sub(1)?;
            self.given += 1;
            Some((KeyId::new([self.given]).unwrap(), KmeKey::take(&mut [self.given; 32])))
        }

        fn retired(&mut self, retirement: Retirement) {
            self.retired.push(retirement);
        }
    }

    fn seal(sealer: &mut RotatingSealer<Source>, now: Duration) -> Result<u8, RotateError> {
        let route = Route { kind: Kind::Topic, topic: TopicHash([0; 16]) };
        let slot = sealer.slot(now, Delivery::Reliable)?;
        let index = slot.index();
        slot.seal_into(route, &[b"x"], &mut [0; 100]).unwrap();
        Ok(index)
    }

    #[test]
    fn a_new_key_every_ten_messages_and_none_when_the_source_is_dry() {
        let channel = Channel::new("a", "b", []).unwrap();
        let mut sealer = RotatingSealer::new(channel, Source { stock: 2, ..Source::default() });
        for message in 0..20 {
            assert_eq!(seal(&mut sealer, Duration::ZERO), Ok(message % 10));
        }
        assert_eq!(seal(&mut sealer, Duration::ZERO), Err(RotateError::NoKey));
        assert_eq!(seal(&mut sealer, Duration::ZERO), Err(RotateError::NoKey));
        sealer.source_mut().stock = 1;
        assert_eq!(seal(&mut sealer, Duration::ZERO), Ok(0));

        let (source, last) = sealer.into_parts();
        let retired: Vec<_> =
            source.retired.iter().map(|r| (r.key_id.as_bytes()[0], r.used)).collect();
        assert_eq!(retired, [(1, IndexMask::ALL), (2, IndexMask::ALL)]);
        assert_eq!(last.unwrap().retire().used.bits(), 1);
    }

    #[test]
    fn an_hour_after_its_first_message_a_key_is_replaced() {
        let channel = Channel::new("a", "b", []).unwrap();
        let mut sealer = RotatingSealer::new(channel, Source { stock: 2, ..Source::default() });
        let start = Duration::from_secs(5);
        assert_eq!(seal(&mut sealer, start), Ok(0));
        assert_eq!(seal(&mut sealer, start + KEY_MAX_AGE - Duration::from_nanos(1)), Ok(1));
        assert_eq!(seal(&mut sealer, start + KEY_MAX_AGE), Ok(0));
        assert_eq!(sealer.source_mut().retired[0].used.bits(), 0b11);
    }
}
