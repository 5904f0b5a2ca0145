//! A record of the key_IDs that have occurred, so that no key is used twice.

use std::collections::{HashSet, VecDeque};
use std::fmt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use sha2::{Digest, Sha256};

#[cfg(unix)]
mod file;

/// Remembers key_IDs, so that each key is handed out once even if a KME repeats keys.
///
/// A key_ID is identified by the SHA-256 of its text in lower case, because a KME may answer in another letter case.
/// Nothing of a key is kept. In memory, 8 bytes of each digest are compared. If two key_IDs share them, which happens
/// for one pair in 2^64, a key is lost but none is used twice.
///
/// It is cheap to clone, and all clones are the same ledger. Pools of one KME may share a ledger. If two KMEs number
/// their keys instead of naming them by UUIDs, each needs its own ledger.
#[derive(Clone)]
pub struct Ledger {
    inner: Arc<Mutex<LedgerInner>>,
    in_file: bool,
}

enum LedgerInner {
    Memory(Memory),
    #[cfg(unix)]
    File(file::FileLedger),
}

/// The reason why a ledger cannot be opened, or cannot record.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LedgerError {
    /// The file cannot be opened, read, or repaired.
    #[error("ledger {path}: {source}", path = path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file is no ledger. It was not changed.
    #[error("{path} is no ledger: {reason}; it was left as it is", path = path.display())]
    NotALedger {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: &'static str,
    },
    /// Other users may read or write the file.
    #[error("ledger {path} has mode {mode:o}: others could change it; chmod 600", path = path.display())]
    NotPrivate {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// Another process, or another [`Ledger`] of this process, has the file open.
    #[error("ledger {path} is in use by another process", path = path.display())]
    Locked {
        /// The file.
        path: PathBuf,
    },
    /// Key_IDs could not be written to stable storage, so their keys must not be used.
    #[error("ledger {path}: key_IDs could not be recorded: {source}", path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The system lost an earlier write. Nothing is recorded any more until the ledger is opened again.
    #[error("ledger {path}: storage failed before; open it anew once that is repaired", path = path.display())]
    Broken {
        /// The file.
        path: PathBuf,
    },
}

/// The first bytes of a digest.
type Short = u64;
type Sha = [u8; 32];

impl Ledger {
    /// Number of key_IDs that a ledger in memory remembers by default. About 32 bytes each: 2 MiB.
    pub const DEFAULT_CAPACITY: usize = 65_536;

    /// Creates a ledger that ends with the process and remembers the last `capacity` key_IDs, at least one. They take
    /// about 32 bytes each.
    #[must_use]
    pub fn memory(capacity: usize) -> Self {
        let memory = Memory { capacity: capacity.max(1), ..Memory::default() };
        Self { inner: Arc::new(Mutex::new(LedgerInner::Memory(memory))), in_file: false }
    }

    /// Opens a ledger in a file, which is created (mode 0600) if it does not exist. It forgets nothing: each key takes
    /// 32 bytes in the file and about 16 in memory. Key_IDs are on stable storage before [`record`](Self::record)
    /// returns.
    ///
    /// The file is locked (`flock`) against a second ledger as long as a clone lives. A record that a crash tore is cut
    /// off: its key was not handed out. The call blocks on the disk.
    ///
    /// # Errors
    /// [`LedgerError`]: the file cannot be opened, is no ledger, is accessible to others, or is in use.
    #[cfg(unix)]
    pub fn file(path: impl Into<PathBuf>) -> Result<Self, LedgerError> {
        Self::file_of(path, usize::MAX)
    }

    /// Like [`file`](Self::file), but remembers at least the last `capacity` key_IDs and at most twice as many. A full
    /// file gets the name `PATH.old`, and a new one begins.
    ///
    /// # Errors
    /// [`LedgerError`], as for [`file`](Self::file), for either file.
    #[cfg(unix)]
    pub fn file_of(path: impl Into<PathBuf>, capacity: usize) -> Result<Self, LedgerError> {
        let file = file::FileLedger::open(path.into(), capacity)?;
        Ok(Self { inner: Arc::new(Mutex::new(LedgerInner::File(file))), in_file: true })
    }

    /// Returns whether it remembers this key_ID. Records nothing, and does not block on a disk.
    #[must_use]
    pub fn contains(&self, key_id: &str) -> bool {
        let short = short(&sha(key_id));
        match &*self.inner.lock().unwrap_or_else(PoisonError::into_inner) {
            LedgerInner::Memory(memory) => memory.seen.contains(&short),
            #[cfg(unix)]
            LedgerInner::File(file) => file.contains(&short),
        }
    }

    /// Records key_IDs, and returns for each whether it is new: only then may its key be used. Either all are recorded
    /// or none. A key_ID that occurs twice is new once. With a file the call blocks on the disk, once for all key_IDs.
    ///
    /// # Errors
    /// [`LedgerError`]: it is not certain that anything was recorded, and none of the keys may be used.
    pub fn record<I>(&self, key_ids: I) -> Result<Vec<bool>, LedgerError>
    where
        I: IntoIterator<Item: AsRef<str>>,
    {
        let shas: Vec<Sha> = key_ids.into_iter().map(|id| sha(id.as_ref())).collect();
        match &mut *self.inner.lock().unwrap_or_else(PoisonError::into_inner) {
            LedgerInner::Memory(memory) => {
                Ok(shas.iter().map(|sha| memory.insert(short(sha))).collect())
            }
            #[cfg(unix)]
            LedgerInner::File(file) => file.record(&shas),
        }
    }

    /// Returns the number of key_IDs that it remembers.
    #[must_use]
    pub fn len(&self) -> usize {
        match &*self.inner.lock().unwrap_or_else(PoisonError::into_inner) {
            LedgerInner::Memory(memory) => memory.order.len(),
            #[cfg(unix)]
            LedgerInner::File(file) => file.len(),
        }
    }

    /// Returns whether it remembers none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns whether [`record`](Self::record) blocks on a disk.
    pub(super) fn blocks(&self) -> bool {
        self.in_file
    }
}

impl Default for Ledger {
    /// Creates a ledger in memory with [`DEFAULT_CAPACITY`](Self::DEFAULT_CAPACITY).
    fn default() -> Self {
        Self::memory(Self::DEFAULT_CAPACITY)
    }
}

impl fmt::Debug for Ledger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Ledger").field("in_file", &self.in_file).finish_non_exhaustive()
    }
}

#[derive(Default)]
struct Memory {
    capacity: usize,
    seen: HashSet<Short>,
    /// The key_IDs, the oldest first.
    order: VecDeque<Short>,
}

impl Memory {
    fn insert(&mut self, short: Short) -> bool {
        if !self.seen.insert(short) {
            return false;
        }
        if self.order.len() == self.capacity
            && let Some(oldest) = self.order.pop_front()
        {
            self.seen.remove(&oldest);
        }
        self.order.push_back(short);
        true
    }
}

fn sha(key_id: &str) -> Sha {
    Sha256::digest(key_id.to_ascii_lowercase()).into()
}

fn short(sha: &Sha) -> Short {
    let [a, b, c, d, e, f, g, h, ..] = *sha;
    Short::from_le_bytes([a, b, c, d, e, f, g, h])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_id_is_new_once_regardless_of_letter_case() {
        let ledger = Ledger::default();
        assert_eq!(ledger.record(["a", "b", "A"]).unwrap(), [true, true, false]);
        assert_eq!(ledger.record(["B", "c"]).unwrap(), [false, true]);
        assert_eq!(ledger.clone().record(["C"]).unwrap(), [false], "a clone is the same ledger");
    }

    #[test]
    fn memory_is_bounded_and_forgets_the_oldest() {
        let ledger = Ledger::memory(3);
        for id in ["a", "b", "c", "d"] {
            assert_eq!(ledger.record([id]).unwrap(), [true]);
        }
        assert_eq!(ledger.len(), 3);
        assert_eq!(ledger.record(["b", "c", "d"]).unwrap(), [false; 3]);
        assert_eq!(ledger.record(["a"]).unwrap(), [true], "forgotten");
        assert_eq!(Ledger::memory(0).record(["x", "x"]).unwrap(), [true, false]);
    }
}
