//! Records the key_IDs that this host's KME returned before, over restarts of the daemon. If a KME returns a key a
//! second time, the daemon detects it and does not use the key.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use etsi_qkd014::pool::{Ledger, LedgerError};
use serde::Serialize;

/// Minimum number of key_IDs that the file remembers: some 16 MiB in two files, and 10 MiB of memory.
const IN_FILE: usize = 262_144;
/// Maximum number of key_IDs that wait to be written until the file can be written again.
const UNWRITTEN: usize = 65_536;
/// Time between two tries to open the file of a daemon that has not ended yet.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// A record of the key_IDs of all keys that the KME gave this host. It holds no key. If its file
/// cannot be kept, the record lasts as long as the daemon, and the log says so once.
#[derive(Clone)]
pub struct UsedKeys(Arc<Mutex<Used>>);

struct Used {
    path: Option<PathBuf>,
    file: Option<Ledger>,
    /// All key_IDs since the start, even if the file is lost.
    memory: Ledger,
    unwritten: VecDeque<String>,
    /// The reason why the file is not kept.
    trouble: Option<String>,
    /// The time of the last attempt to open the file, while another process has it.
    tried: Option<Instant>,
}

/// The state of the record, for status.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct UsedStatistics {
    /// The file.
    pub file: Option<String>,
    /// Key_IDs that are remembered.
    pub key_ids: usize,
    /// The reason why the file is not kept: then the record ends with the daemon.
    pub trouble: Option<String>,
}

impl UsedKeys {
    /// Creates a record in memory, for a tool that makes a few links and ends.
    pub fn in_memory() -> Self {
        Self::with(None)
    }

    /// Opens the record in a file of `directory` for the daemon of `domain`, with mode 0600. Without a directory, or if
    /// the file cannot be kept, the record is in memory, and the log says so. Blocks on the disk.
    pub fn open(directory: Option<&Path>, domain: u32) -> Self {
        let this = Self::with(directory.map(|dir| dir.join(format!("used-keys-{domain}"))));
        let mut used = this.used();
        if used.path.is_some() {
            used.open();
        } else {
            used.fails("there is no runtime directory (AXON_RUNTIME_DIR, XDG_RUNTIME_DIR)".into());
        }
        drop(used);
        this
    }

    fn with(path: Option<PathBuf>) -> Self {
        Self(Arc::new(Mutex::new(Used {
            path,
            file: None,
            memory: Ledger::default(),
            unwritten: VecDeque::new(),
            trouble: None,
            tried: None,
        })))
    }

    /// Records key_IDs, and returns for each whether it is new: only then may its key be used. Blocks on the disk.
    pub fn record(&self, key_ids: &[String]) -> Vec<bool> {
        self.used().record(key_ids)
    }

    /// Returns the state of the record.
    pub fn statistics(&self) -> UsedStatistics {
        let used = self.used();
        UsedStatistics {
            file: used.path.as_ref().map(|path| path.display().to_string()),
            key_ids: used.file.as_ref().map_or(0, Ledger::len).max(used.memory.len()),
            trouble: used.trouble.clone(),
        }
    }

    fn used(&self) -> MutexGuard<'_, Used> {
        // A panic leaves at worst key_IDs that are written once more.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Used {
    fn record(&mut self, key_ids: &[String]) -> Vec<bool> {
        if self.tried.is_some_and(|at| at.elapsed() >= RETRY_INTERVAL) {
            self.open();
        }
        let known = |id: &String| self.file.as_ref().is_some_and(|file| file.contains(id));
        let mut new: Vec<bool> = key_ids.iter().map(|id| !known(id)).collect();
        // A ledger in memory does not fail.
        let here = self.memory.record(key_ids).unwrap_or_else(|_| vec![false; key_ids.len()]);
        new.iter_mut().zip(here).for_each(|(new, here)| *new &= here);
        if self.path.is_some() {
            let fresh = key_ids.iter().zip(&new).filter(|(_, new)| **new);
            self.unwritten.extend(fresh.map(|(id, _)| id.clone()));
            let over = self.unwritten.len().saturating_sub(UNWRITTEN);
            self.unwritten.drain(..over);
            self.write();
        }
        new
    }

    fn write(&mut self) {
        let Some(file) = self.file.as_ref().filter(|_| !self.unwritten.is_empty()) else { return };
        match file.record(&self.unwritten) {
            Ok(_) => {
                self.unwritten.clear();
                if self.trouble.take().is_some() {
                    tracing::info!("the record of used keys is kept in its file again");
                }
            }
            Err(error) => self.fails(error.to_string()),
        }
    }

    fn open(&mut self) {
        let Some(path) = &self.path else { return };
        self.tried = None;
        match Ledger::file_of(path, IN_FILE) {
            Ok(file) => {
                self.file = Some(file);
                self.trouble = None;
                self.write();
            }
            Err(error) => {
                if matches!(error, LedgerError::Locked { .. }) {
                    self.tried = Some(Instant::now());
                }
                self.fails(error.to_string());
            }
        }
    }

    fn fails(&mut self, why: String) {
        if self.trouble.is_none() {
            tracing::warn!("{}", self.complaint(&why));
        }
        self.trouble = Some(why);
    }

    /// Returns the log line for a record that cannot be kept, with its remedy.
    fn complaint(&self, why: &str) -> String {
        let remedy = match self.path {
            Some(_) => "Repair it, or move the file away",
            None => "Set AXON_RUNTIME_DIR to a directory of this user",
        };
        format!(
            "the record of used KME keys cannot be kept: {why}. If the KME gives a key again after this \
             daemon was restarted, the daemon does not notice. {remedy}, and restart the daemon; \
             `axon status` shows the state of the record"
        )
    }
}

#[cfg(test)]
mod tests {
    use std::{fs, os::unix::fs::PermissionsExt};

    use super::*;

    fn ids(names: &[&str]) -> Vec<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn without_a_directory_the_log_names_the_setting_and_no_file() {
        let says = |used: &UsedKeys| used.used().complaint("why");
        let none = says(&UsedKeys::open(None, 0));
        assert!(none.contains("Set AXON_RUNTIME_DIR") && !none.contains("file"), "{none}");
        let dir = tempfile::tempdir().unwrap();
        let some = says(&UsedKeys::open(Some(dir.path()), 0));
        assert!(some.contains("move the file away") && !some.contains("Set"), "{some}");
    }

    #[test]
    fn used_keys_outlast_the_daemon() {
        let dir = tempfile::tempdir().unwrap();
        let first = UsedKeys::open(Some(dir.path()), 7);
        assert_eq!(first.record(&ids(&["a", "b", "A"])), [true, true, false]);
        drop(first);
        let next = UsedKeys::open(Some(dir.path()), 7);
        assert_eq!(next.record(&ids(&["b", "c"])), [false, true]);
        let status = next.statistics();
        assert_eq!((status.key_ids, status.trouble), (3, None));
        let path = dir.path().join("used-keys-7");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        // Another domain's daemon has a record of its own.
        let other = UsedKeys::open(Some(dir.path()), 8);
        assert_eq!(other.record(&ids(&["a"])), [true]);
    }

    #[test]
    fn a_record_that_cannot_be_kept_is_kept_in_memory_and_status_says_so() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("used-keys-0");
        fs::write(&path, "somebody's diary, which is longer than a header is").unwrap();
        fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
        for (directory, what) in [
            (Some(dir.path()), "no ledger"),
            (Some(Path::new("/proc")), "/proc/used-keys-0"),
            (None, "AXON_RUNTIME_DIR"),
        ] {
            let used = UsedKeys::open(directory, 0);
            let trouble = used.statistics().trouble.expect(what);
            assert!(trouble.contains(what), "{trouble}");
            assert_eq!(used.record(&ids(&["a"])), [true]);
            assert_eq!(used.record(&ids(&["a", "b"])), [false, true]);
            assert_eq!(used.statistics().trouble, Some(trouble));
        }
        assert!(fs::read_to_string(&path).unwrap().starts_with("somebody"), "left as it was");
    }

    #[test]
    fn used_keys_are_written_once_the_file_is_free() {
        let dir = tempfile::tempdir().unwrap();
        let old = UsedKeys::open(Some(dir.path()), 0);
        old.record(&ids(&["a"]));
        let used = UsedKeys::open(Some(dir.path()), 0);
        assert!(used.statistics().trouble.is_some_and(|why| why.contains("in use")));
        assert_eq!(used.record(&ids(&["b"])), [true]);
        drop(old);
        std::thread::sleep(RETRY_INTERVAL);
        assert_eq!(used.record(&ids(&["a", "b", "c"])), [false, false, true]);
        assert_eq!(used.statistics().trouble, None);
        drop(used);
        let next = UsedKeys::open(Some(dir.path()), 0);
        assert_eq!(next.record(&ids(&["a", "b", "c", "d"])), [false, false, false, true]);
    }
}
