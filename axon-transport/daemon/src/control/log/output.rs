//! The output of log lines: standard error, which for a daemon in the background is a file.

use std::{
    fs::{File, OpenOptions},
    io::{self, Write},
    os::{fd::AsFd, unix::fs::OpenOptionsExt},
    path::{Path, PathBuf},
    sync::{Mutex, OnceLock, PoisonError},
};

/// Size of a log file, in bytes, at which a new one is begun. The previous one is kept.
const MAX_FILE: u64 = 8 << 20;

/// The path of the file that standard error goes to, once [`keep_in`] was called.
static KEPT: OnceLock<Mutex<PathBuf>> = OnceLock::new();

/// Redirects standard error to the file `path`, and rotates the file at 8 MiB: its previous content is then in `path`
/// with `.1` at its end.
///
/// # Errors
/// The file cannot be opened.
pub(in crate::control) fn keep_in(path: &Path) -> io::Result<()> {
    rustix::stdio::dup2_stderr(open(path)?.as_fd())?;
    let _ = KEPT.set(Mutex::new(path.to_owned()));
    Ok(())
}

fn open(path: &Path) -> io::Result<File> {
    OpenOptions::new().create(true).append(true).mode(0o600).open(path)
}

/// Standard error. Writing to it never fails: a line that cannot be written is dropped.
#[derive(Clone, Copy, Debug)]
pub(super) struct LogOutput;

impl Write for LogOutput {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let kept = KEPT.get().map(|kept| kept.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some(path) = &kept {
            rotate(path, line.len() as u64, MAX_FILE);
        }
        let _ = io::stderr().write_all(line);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Begins a new file if `more` bytes would make the present one longer than `most`.
fn rotate(path: &Path, more: u64, most: u64) {
    let stderr = rustix::stdio::stderr();
    // The size is read from the file, because panics and libraries write to it as well.
    let long = rustix::fs::fstat(stderr).is_ok_and(|stat| stat.st_size as u64 + more > most);
    if !long {
        return;
    }
    let mut before = path.as_os_str().to_owned();
    before.push(".1");
    let renewed = std::fs::rename(path, before)
        .and_then(|()| open(path))
        .and_then(|file| Ok(rustix::stdio::dup2_stderr(file.as_fd())?));
    if renewed.is_err() {
        // The directory is gone or full: the size limit still applies.
        let _ = rustix::fs::ftruncate(stderr, 0);
    }
}
