//! Decides when files are read again: once they have changed, and are still.

use std::time::{Duration, Instant};

use super::file::{FileStamp, NamedFile};

/// Maximum time for which the watcher waits for a writer to finish.
const LONGEST_WRITE: Duration = Duration::from_secs(5);

/// The result of a look at the files.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum FilesChange {
    /// The files are as they were when they were read.
    Same,
    /// A file is being written.
    Changing,
    /// A file is being written, and has been for too long.
    Restless,
    /// The files changed and no longer change: they must be read.
    Changed,
}

/// The watched files, and their stamps.
#[derive(Debug)]
pub(super) struct FileWatcher {
    files: Vec<NamedFile>,
    /// The stamps at the time when the files were read.
    read: Option<Vec<FileStamps>>,
    /// The stamps at the last look.
    seen: Vec<FileStamps>,
    restless_since: Option<Instant>,
}

/// The stamp of a file, or the reason why it cannot be used.
type FileStamps = Result<FileStamp, String>;

impl FileWatcher {
    /// Creates a watcher of files that are about to be read for the first time.
    pub(super) fn new(files: Vec<NamedFile>) -> Self {
        let seen: Vec<_> = files.iter().map(NamedFile::stamp).collect();
        Self { files, read: Some(seen.clone()), seen, restless_since: None }
    }

    /// Returns whether no file is watched.
    pub(super) fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// Looks, at least some time after the last look: two writes in one tick of the file system's
    /// clock leave one and the same stamp.
    pub(super) fn look(&mut self, now: Instant) -> FilesChange {
        let seen = self.stamps();
        if self.read.as_ref() == Some(&seen) {
            self.seen = seen;
            self.restless_since = None;
            return FilesChange::Same;
        }
        if seen == self.seen {
            return FilesChange::Changed;
        }
        self.seen = seen;
        if now.duration_since(*self.restless_since.get_or_insert(now)) < LONGEST_WRITE {
            return FilesChange::Changing;
        }
        // The files must be read once they are still, even if their stamps return to the old ones.
        self.read = None;
        self.restless_since = Some(now);
        FilesChange::Restless
    }

    /// Called after a look returned `Changed` and the files were read. Returns whether the files stayed the same
    /// meanwhile. If not, the caller may have read half of one version and half of another.
    pub(super) fn confirm(&mut self) -> bool {
        let seen = self.stamps();
        if seen != self.seen {
            self.seen = seen;
            return false;
        }
        self.read = Some(seen);
        self.restless_since = None;
        true
    }

    fn stamps(&self) -> Vec<FileStamps> {
        self.files.iter().map(NamedFile::stamp).collect()
    }
}
