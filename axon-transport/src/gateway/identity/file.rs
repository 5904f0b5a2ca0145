//! A file of the identity: what it must be, how it is read, and how a change of it shows.

use std::{
    fs::{File, Metadata, OpenOptions},
    io::Read,
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::{Path, PathBuf},
};

use axon_tls::identity::TrustFile;
use zeroize::Zeroizing;

use crate::gateway::GatewayError;

/// Larger than any key in PEM.
const LARGEST_KEY: u64 = 64 << 10;
/// Room for some ten thousand certificates that were revoked.
const LARGEST_PEM: u64 = 4 << 20;

/// A file that a setting names.
#[derive(Clone, Debug)]
pub(super) struct Named {
    pub(super) variable: &'static str,
    pub(super) path: PathBuf,
    largest: u64,
    secret: bool,
}

/// What `stat` tells of a file, which differs when its content does: who preserves the time of
/// writing cannot preserve that of the change.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Stamp {
    place: (u64, u64),
    len: u64,
    written: (i64, i64),
    changed: (i64, i64),
    mode: u32,
}

impl Named {
    /// The file at `path`, if the setting is given.
    ///
    /// # Errors
    /// It is not.
    pub(super) fn new(variable: &'static str, path: Option<&Path>) -> Result<Self, GatewayError> {
        let path = path.ok_or(GatewayError::Missing(variable))?.to_owned();
        let secret = variable == "AXON_CLASSIC_KEY";
        let largest = match variable {
            "AXON_CLASSIC_KEY" => LARGEST_KEY,
            "AXON_CLASSIC_TRUST" => TrustFile::MAX_LEN as u64,
            _ => LARGEST_PEM,
        };
        Ok(Self { variable, path, largest, secret })
    }

    /// The failure of this file.
    pub(super) fn unusable(&self, reason: impl std::fmt::Display) -> GatewayError {
        GatewayError::File {
            variable: self.variable,
            path: self.path.clone(),
            reason: reason.to_string(),
        }
    }

    /// How the file is now; why it cannot be used if that shows from outside.
    pub(super) fn stamp(&self) -> Result<Stamp, String> {
        self.judge(&std::fs::metadata(&self.path).map_err(|e| e.to_string())?)
    }

    /// The whole file, into a buffer that never moves and is erased.
    ///
    /// # Errors
    /// It is not what the settings demand of it, cannot be read, or is too large.
    pub(super) fn read(&self) -> Result<Zeroizing<Vec<u8>>, GatewayError> {
        self.try_read().map_err(|reason| self.unusable(reason))
    }

    fn try_read(&self) -> Result<Zeroizing<Vec<u8>>, String> {
        let text = |e: std::io::Error| e.to_string();
        let mut file = open(&self.path).map_err(text)?;
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

    /// What the settings demanded of the file holds for what takes its place, too.
    fn judge(&self, file: &Metadata) -> Result<Stamp, String> {
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
        Ok(Stamp {
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
