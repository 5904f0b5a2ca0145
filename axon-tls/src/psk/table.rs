//! The keys of a server, by identity.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::fmt;
use std::sync::{Arc, PoisonError, RwLock};

use super::{Psk, PskResolver};
use crate::Error;

/// A [`PskResolver`] with a table of keys, which can change while the server runs.
///
/// All methods can be called from any thread. None blocks for longer than a look-up. A connection that was made on a
/// key continues when the key is removed.
#[derive(Default)]
pub struct PskTable {
    keys: RwLock<HashMap<Vec<u8>, Arc<Psk>>>,
}

impl PskTable {
    /// Makes a table of `psks`.
    ///
    /// # Errors
    /// [`Error::Psk`] if two of them have the same identity.
    pub fn new(psks: impl IntoIterator<Item = Arc<Psk>>) -> Result<Self, Error> {
        let mut keys = HashMap::new();
        for psk in psks {
            match keys.entry(psk.identity().to_vec()) {
                Entry::Vacant(entry) => entry.insert(psk),
                Entry::Occupied(_) => return Err(Error::Psk("two keys have the same identity")),
            };
        }
        Ok(Self { keys: RwLock::new(keys) })
    }

    /// Adds a key. Returns the key that had this identity before.
    pub fn insert(&self, psk: Arc<Psk>) -> Option<Arc<Psk>> {
        let mut keys = self.keys.write().unwrap_or_else(PoisonError::into_inner);
        keys.insert(psk.identity().to_vec(), psk)
    }

    /// Removes the key with exactly this identity and returns it. Handshakes that begin later are refused.
    /// [`Psk::erase()`] also erases the secret.
    pub fn remove(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.keys.write().unwrap_or_else(PoisonError::into_inner).remove(identity)
    }
}

impl PskResolver for PskTable {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        self.keys.read().unwrap_or_else(PoisonError::into_inner).get(identity).cloned()
    }
}

impl fmt::Debug for PskTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let len = self.keys.read().unwrap_or_else(PoisonError::into_inner).len();
        f.debug_struct("PskTable").field("len", &len).finish_non_exhaustive()
    }
}
