//! Files that settings name: their required properties, reading them, and detecting changes.

use std::{
    fs::{File, Metadata, OpenOptions},
    io::Read,
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::Path,
};

use zeroize::Zeroizing;

/// Larger than any key in PEM.
const LARGEST_KEY: u64 = 64 << 10;
/// Room for some ten thousand certificates that were revoked.
const LARGEST_PEM: u64 = 4 << 20;

/// The requirements of the settings for a file and for its replacements.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FileRules {
    largest: u64,
    secret: bool,
}

/// The metadata of a file. It differs when the content does: a program that preserves the modification time cannot
/// preserve the change time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FileStamp {
    place: (u64, u64),
    len: u64,
    written: (i64, i64),
    changed: (i64, i64),
    mode: u32,
}

impl FileRules {
    /// Requirements for a file with a secret key: only its owner may read it.
    pub(crate) const KEY: Self = Self { largest: LARGEST_KEY, secret: true };
    /// Requirements for a file with certificates.
    pub(crate) const CERTIFICATES: Self = Self::public(LARGEST_PEM);

    /// Rules for a file of trusted keys or certificates: it must not be world-writable.
    pub(crate) const fn public(largest: u64) -> Self {
        Self { largest, secret: false }
    }

    /// Returns the current stamp of the file.
    ///
    /// # Errors
    /// The reason why the file cannot be used, if its metadata shows it.
    pub(crate) fn stamp(&self, path: &Path) -> Result<FileStamp, String> {
        self.judge(&std::fs::metadata(path).map_err(|e| e.to_string())?)
    }

    /// Reads the whole file into a buffer that never moves and is erased.
    ///
    /// # Errors
    /// The file does not meet the requirements of the settings, cannot be read, or is too large.
    pub(crate) fn read(&self, path: &Path) -> Result<Zeroizing<Vec<u8>>, String> {
        let text = |e: std::io::Error| e.to_string();
        let mut file = open(path).map_err(text)?;
        let len = self.judge(&file.metadata().map_err(text)?)?.len;
        // One more than it has: a file that grows meanwhile is seen to.
        let mut bytes = Zeroizing::new(vec![0; usize::try_from(len).unwrap_or(0) + 1]);
        let mut read = 0;
        while read < bytes.len() {
            match file.read(&mut bytes[read..]).map_err(text)? {
                0 => {
                    bytes.truncate(read);
                    return Ok(bytes);
                }
                count => read += count,
            }
        }
        Err("it grew while it was read".into())
    }

    fn judge(&self, file: &Metadata) -> Result<FileStamp, String> {
        if !file.is_file() {
            return Err("it is not a regular file".into());
        }
        if file.len() > self.largest {
            return Err(format!("it is larger than {} KiB", self.largest >> 10));
        }
        if self.secret && file.mode() & 0o077 != 0 {
            let mode = file.mode() & 0o777;
            return Err(format!("others than its owner may read it ({mode:04o}); chmod 600"));
        }
        if !self.secret && file.mode() & 0o002 != 0 {
            return Err("everybody may write it; chmod o-w".into());
        }
        Ok(FileStamp {
            place: (file.dev(), file.ino()),
            len: file.len(),
            written: (file.mtime(), file.mtime_nsec()),
            changed: (file.ctime(), file.ctime_nsec()),
            mode: file.mode(),
        })
    }
}

/// Opens without ever waiting: a pipe put in a file's place must not hang the daemon.
fn open(path: &Path) -> std::io::Result<File> {
    const O_NONBLOCK: i32 = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(path)
}
