//! When files are to be read again: once they have changed, and are still.

use std::time::{Duration, Instant};

use super::file::{FileStamp, NamedFile};

/// Somebody who writes for so long is not waited for.
const LONGEST_WRITE: Duration = Duration::from_secs(5);

/// What a look at the files says.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum FilesChange {
    /// They are as they were read.
    Same,
    /// One is being written.
    Changing,
    /// One is being written, and has been for too long.
    Restless,
    /// They changed and are still: they are to be read.
    Changed,
}

/// Files, and what was seen of them.
#[derive(Debug)]
pub(super) struct FileWatcher {
    files: Vec<NamedFile>,
    /// As they were when they were read.
    read: Option<Vec<FileStamps>>,
    /// As they were at the last look.
    seen: Vec<FileStamps>,
    restless_since: Option<Instant>,
}

/// A file, or why there is none to use.
type FileStamps = Result<FileStamp, String>;

impl FileWatcher {
    /// Files that are about to be read for the first time.
    pub(super) fn new(files: Vec<NamedFile>) -> Self {
        let seen: Vec<_> = files.iter().map(NamedFile::stamp).collect();
        Self { files, read: Some(seen.clone()), seen, restless_since: None }
    }

    /// Whether there is anything to look at.
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
        // Whatever they become, they are to be read then.
        self.read = None;
        self.restless_since = Some(now);
        FilesChange::Restless
    }

    /// They were read after a look said `Changed`. Whether they stayed the same meanwhile: if not,
    /// what was read may be half of one and half of the other.
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
