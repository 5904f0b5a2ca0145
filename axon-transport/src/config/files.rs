//! The file system as validation accesses it. Tests replace it.

use std::{
    fs::{File, Metadata, OpenOptions},
    io::{self, Read},
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::{Path, PathBuf},
};

/// Largest file that validation reads, in bytes.
pub(super) const LARGEST: u64 = 4 << 20;

/// The file system as [`Config::resolve`](super::Config::resolve) reads it. No method writes.
pub trait Files {
    /// Returns the whole content of `path`. A file larger than 4 MiB is an error.
    fn read(&self, path: &Path) -> io::Result<Vec<u8>>;

    /// Returns the kind and mode of the file at `path`. Follows links.
    fn facts(&self, path: &Path) -> io::Result<FileFacts>;

    /// Checks that this process may read `path`.
    fn readable(&self, path: &Path) -> io::Result<()>;

    /// Returns the directory that relative paths in the environment are relative to.
    fn current_dir(&self) -> io::Result<PathBuf>;
}

/// The result of `stat` for a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct FileFacts {
    /// The kind of file.
    pub kind: FileKind,
    /// Permission bits.
    pub mode: u32,
}

impl FileFacts {
    /// Creates the facts of a file of this kind, with these permission bits.
    pub fn new(kind: FileKind, mode: u32) -> Self {
        Self { kind, mode }
    }
}

/// The kind of the file that a path leads to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// A regular file.
    Regular,
    /// A directory.
    Directory,
    /// A device, socket or pipe.
    Other,
}

/// The real file system.
#[derive(Clone, Copy, Debug, Default)]
pub struct OsFiles;

impl Files for OsFiles {
    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        open(path)?.take(LARGEST + 1).read_to_end(&mut bytes)?;
        if bytes.len() as u64 > LARGEST {
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, "larger than 4 MiB"));
        }
        Ok(bytes)
    }

    fn facts(&self, path: &Path) -> io::Result<FileFacts> {
        std::fs::metadata(path).map(|m| FileFacts { kind: kind(&m), mode: m.mode() & 0o7777 })
    }

    fn readable(&self, path: &Path) -> io::Result<()> {
        open(path).map(drop)
    }

    fn current_dir(&self) -> io::Result<PathBuf> {
        std::env::current_dir()
    }
}

fn kind(metadata: &Metadata) -> FileKind {
    if metadata.is_file() {
        FileKind::Regular
    } else if metadata.is_dir() {
        FileKind::Directory
    } else {
        FileKind::Other
    }
}

/// Opens a file without blocking: a pipe in a file's place must not hang the start.
fn open(path: &Path) -> io::Result<File> {
    const O_NONBLOCK: i32 = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(path)
}
