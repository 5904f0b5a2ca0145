//! The sending keys of one connection: announced ones, READY ones, and the one in use.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
    time::Duration,
};

use axon_envelope::{
    Channel, ChannelError, Delivery, KEY_MAX_AGE, KeyId, KmeKey, MAX_HEADER_LEN, RandomError,
    Retirement, Sealer, Slot, TAG_LEN,
};

use super::NoKey;
use crate::keys::{Exporters, exporters::Exporter, proof};

/// The keys that a [`KeySender`](super::KeySender) uses on one connection.
pub(super) struct ConnectionKeys {
    connection: u64,
    channel: Channel,
    exporter: Exporter,
    announced: HashMap<KeyId, AnnouncedKey>,
    /// READY keys, in the order of use. Only the first may have sealed messages.
    ready: VecDeque<Sealer>,
    /// The time at which the first key of `ready` was first handed out.
    begun: Option<Duration>,
}

/// A key that the peer has not answered for.
pub(super) struct AnnouncedKey {
    pub(super) key: KmeKey,
    /// The time of its request, if its lead time is to be measured.
    pub(super) asked: Option<Duration>,
    /// The time of its first announcement, on any connection.
    pub(super) since: Duration,
}

/// The keys of a connection that is no longer used.
pub(super) struct ReleasedKeys {
    /// The key that sealed messages.
    pub(super) retired: Option<Retirement>,
    /// The READY keys that sealed nothing.
    pub(super) unused: Vec<(KeyId, KmeKey)>,
    pub(super) announced: HashMap<KeyId, AnnouncedKey>,
}

impl ConnectionKeys {
    /// Creates the state of a connection without keys.
    ///
    /// # Errors
    /// The SAE IDs do not make a channel.
    pub(super) fn new(
        connection: u64,
        (local, peer): (&str, &str),
        exporters: &Exporters,
    ) -> Result<Self, ChannelError> {
        Ok(Self {
            connection,
            channel: Channel::new(local, peer, exporters.envelope())?,
            exporter: Arc::clone(exporters.ready()),
            announced: HashMap::new(),
            ready: VecDeque::new(),
            begun: None,
        })
    }

    /// Returns the connection.
    pub(super) fn connection(&self) -> u64 {
        self.connection
    }

    /// Returns the number of READY keys, including the key in use.
    pub(super) fn ready(&self) -> usize {
        self.ready.len()
    }

    /// Returns the number of keys that the peer has not answered for.
    pub(super) fn announced(&self) -> usize {
        self.announced.len()
    }

    /// Returns the number of keys that are announced or READY and have sealed no message.
    pub(super) fn ahead(&self) -> usize {
        let begun = usize::from(self.begun.is_some() && !self.ready.is_empty());
        self.announced.len() + self.ready.len() - begun
    }

    /// Adds a key that the peer has proven to hold.
    ///
    /// # Errors
    /// The system returns no random bytes.
    pub(super) fn add_ready(&mut self, key_id: KeyId, key: KmeKey) -> Result<(), RandomError> {
        self.ready.push_back(Sealer::new(&self.channel, key_id, key)?);
        Ok(())
    }

    /// Adds a key that is announced on this connection.
    pub(super) fn announce(&mut self, key_id: KeyId, key: AnnouncedKey) {
        self.announced.insert(key_id, key);
    }

    /// Returns whether a proof of READY is right. `None`: the key is not announced.
    pub(super) fn proves(&self, key_id: &KeyId, proof: &[u8; 32]) -> Option<bool> {
        let waiting = self.announced.get(key_id)?;
        Some(proof::verify(&waiting.key, key_id, &self.exporter, proof))
    }

    /// Takes a key that is announced.
    pub(super) fn take_announced(&mut self, key_id: &KeyId) -> Option<AnnouncedKey> {
        self.announced.remove(key_id)
    }

    /// Returns the keys that the peer has owed an answer for since this time or longer.
    pub(super) fn unanswered(&self, since: Option<Duration>) -> Vec<KeyId> {
        let late = |key: &AnnouncedKey| Some(key.since) <= since;
        self.announced.iter().filter(|(_, key)| late(key)).map(|(id, _)| id.clone()).collect()
    }

    /// Returns when a key was first announced that the peer has not answered for.
    pub(super) fn unanswered_since(&self) -> Option<Duration> {
        self.announced.values().map(|key| key.since).min()
    }

    /// Returns when the key in use reaches its maximum age.
    pub(super) fn spent_at(&self) -> Option<Duration> {
        self.begun.map(|at| at + KEY_MAX_AGE)
    }

    /// Returns a permit to seal one message.
    ///
    /// # Errors
    /// No key is READY.
    pub(super) fn slot(&mut self, now: Duration, delivery: Delivery) -> Result<Slot<'_>, NoKey> {
        let first = self.ready.front_mut().ok_or(NoKey::None)?;
        self.begun.get_or_insert(now);
        first.slot(now, delivery).map_err(|_| NoKey::None)
    }

    /// Returns the bytes that an envelope has at most in addition to its plaintext.
    pub(super) fn overhead(&self) -> usize {
        self.ready.iter().map(Sealer::overhead).max().unwrap_or(MAX_HEADER_LEN + TAG_LEN)
    }

    /// Returns the number of messages that the READY keys can seal.
    pub(super) fn remaining(&self) -> u32 {
        self.ready.iter().map(|key| u32::from(key.remaining())).sum()
    }

    /// Retires the key in use if it sealed all its messages or reached its maximum age.
    pub(super) fn retire_spent(&mut self, now: Duration) -> Option<Retirement> {
        let first = self.ready.front()?;
        let is_old = self.begun.is_some_and(|at| now.saturating_sub(at) >= KEY_MAX_AGE);
        if !is_old && first.spent(now).is_none() {
            return None;
        }
        self.begun = None;
        self.ready.pop_front().map(Sealer::retire)
    }

    /// Takes all keys from the connection that sealed no message.
    pub(super) fn release_unused(&mut self) -> ReleasedKeys {
        let in_use = self.begun.and_then(|begun| Some((begun, self.ready.pop_front()?)));
        let released = self.release();
        if let Some((begun, key)) = in_use {
            self.begun = Some(begun);
            self.ready.push_back(key);
        }
        released
    }

    /// Takes all keys from the connection.
    pub(super) fn release(&mut self) -> ReleasedKeys {
        let (mut retired, mut unused) = (None, Vec::new());
        for sealer in self.ready.drain(..) {
            match sealer.into_unused() {
                Ok(key) => unused.push(key),
                // Only the first key seals.
                Err(begun) => {
                    debug_assert!(retired.is_none(), "one key seals at a time");
                    retired = Some(begun.retire());
                }
            }
        }
        self.begun = None;
        ReleasedKeys { retired, unused, announced: std::mem::take(&mut self.announced) }
    }
}
