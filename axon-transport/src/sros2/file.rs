//! Reads the file of an enclave's permissions.

use std::{
    fs::OpenOptions,
    io::{self, Read},
    os::unix::fs::{MetadataExt, OpenOptionsExt},
    path::Path,
};

use super::{PermissionsError, xml::LARGEST};
use crate::config::elevated;

/// Reads a file that only its owner and its group may write.
///
/// # Errors
/// The file cannot be read, is not a regular file, is too large or not UTF-8, or everybody may
/// write it.
pub(super) fn read(path: &Path) -> Result<String, PermissionsError> {
    let malformed = |what: String| PermissionsError::Malformed { path: path.to_owned(), what };
    if axon_shm::internal::is_elevated() {
        // The caller of a privileged program chooses where the keystore is.
        elevated::check_owner(path).map_err(malformed)?;
    }
    let bytes = bytes(path)
        .map_err(|source| PermissionsError::Unreadable { path: path.to_owned(), source })?
        .map_err(|what| malformed(what.to_owned()))?;
    String::from_utf8(bytes).map_err(|_| malformed("not UTF-8".into()))
}

fn bytes(path: &Path) -> io::Result<Result<Vec<u8>, &'static str>> {
    // Opening a pipe in its place must not block.
    const O_NONBLOCK: i32 = rustix::fs::OFlags::NONBLOCK.bits() as i32;
    let file = OpenOptions::new().read(true).custom_flags(O_NONBLOCK).open(path)?;
    let facts = file.metadata()?;
    if !facts.is_file() {
        return Ok(Err("not a regular file"));
    }
    if facts.mode() & 0o002 != 0 {
        return Ok(Err("everybody may write it: chmod o-w"));
    }
    let mut bytes = Vec::new();
    file.take(LARGEST + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > LARGEST {
        return Ok(Err("larger than 1 MiB"));
    }
    Ok(Ok(bytes))
}
