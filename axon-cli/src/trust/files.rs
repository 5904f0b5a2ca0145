//! Reads the files of a pinned host. Each failure names the file.

use std::{
    fs::File,
    io::{self, Read},
    path::Path,
};

use axon_tls::identity::{SigningKey, TrustFile};
use zeroize::Zeroizing;

use crate::failure::CliError;

/// The size of the buffer for a key, larger than any key in PEM.
const LARGEST_KEY: usize = 64 << 10;

/// Reads a trust file. An error in a line names the line's number.
pub(super) fn trust(path: &Path) -> Result<TrustFile, CliError> {
    let mut bytes = Vec::new();
    let limit = TrustFile::MAX_LEN as u64 + 1;
    File::open(path)
        .and_then(|file| file.take(limit).read_to_end(&mut bytes))
        .map_err(|error| unread(path, &error))?;
    let text = std::str::from_utf8(&bytes).map_err(|error| {
        let before = &bytes[..error.valid_up_to()];
        let line = before.iter().filter(|byte| **byte == b'\n').count() + 1;
        unusable(path, line, "not text in UTF-8")
    })?;
    TrustFile::parse(text).map_err(|error| unusable(path, error.line(), error.reason()))
}

/// Reads a private key.
pub(super) fn key(path: &Path) -> Result<SigningKey, CliError> {
    // The buffer has its full size from the start, because a buffer that grows leaves its former
    // contents in memory.
    let mut bytes = Zeroizing::new(vec![0; LARGEST_KEY]);
    let len = File::open(path)
        .and_then(|file| fill(file, &mut bytes))
        .map_err(|error| unread(path, &error))?;
    let pem = std::str::from_utf8(&bytes[..len]).map_err(|error| failed(path, &error))?;
    SigningKey::from_pem(pem).map_err(|error| {
        failed(path, &format!("{error}; `axon trust keygen` makes a file that can be used"))
    })
}

/// Describes why a file could not be opened or read, for a user who does not know this tool.
pub(super) fn unread(path: &Path, error: &io::Error) -> CliError {
    match error.kind() {
        io::ErrorKind::NotFound => failed(path, &"there is no such file"),
        io::ErrorKind::PermissionDenied => failed(path, &"this user may not read it"),
        io::ErrorKind::IsADirectory => failed(path, &"is a directory, not a file"),
        _ => failed(path, error),
    }
}

/// Returns a failure that concerns the file at `path`.
pub(super) fn failed(path: &Path, reason: &dyn std::fmt::Display) -> CliError {
    CliError::failed(format!("{}: {reason}", path.display()))
}

fn unusable(path: &Path, line: usize, reason: &str) -> CliError {
    CliError::failed(format!("{}, line {line}: {reason}", path.display()))
}

fn fill(mut file: File, buffer: &mut [u8]) -> io::Result<usize> {
    let mut len = 0;
    while len < buffer.len() {
        match file.read(&mut buffer[len..])? {
            0 => return Ok(len),
            count => len += count,
        }
    }
    Err(io::Error::new(io::ErrorKind::FileTooLarge, "too large for a private key"))
}
