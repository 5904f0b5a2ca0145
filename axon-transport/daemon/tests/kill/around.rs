//! The situation of the doomed process: a fork of it, or resources that the system refuses to it.
#![allow(unsafe_code)]

use std::{
    io,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use nix::{
    errno::Errno,
    libc,
    sys::wait::{WaitStatus, waitpid},
    unistd::{ForkResult, fork, pause},
};
use rustix::{
    io::{Errno as Refusal, dup},
    process::{Resource, Rlimit, setrlimit},
};

use crate::group::{self, Group};

/// Bytes of memory that are too few for any sample, because rings leave more than that to other processes.
const LITTLE: u64 = 6 << 20;
const DESCRIPTORS: u64 = 256;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Around {
    Nothing,
    /// A forked child of the process holds all its descriptors and lives on.
    Child,
    /// The process is stopped for a while instead of killed.
    Stopped,
    /// All memory of the process is locked, including later maps.
    Locked,
    /// The process may have 256 descriptors, and all are in use.
    NoDescriptor,
    /// The control group of the process has no memory left.
    NoMemory,
}

impl Around {
    /// Creates the situation. Called in the doomed process, just before the operation.
    pub(crate) fn begin(self) {
        self.try_begin().expect("what was tried before");
    }

    fn try_begin(self) -> io::Result<()> {
        match self {
            Self::Nothing | Self::Stopped => Ok(()),
            Self::Child => {
                // SAFETY: this process has one thread, and its child only waits for its end.
                if let ForkResult::Child = unsafe { fork() }? {
                    loop {
                        pause();
                    }
                }
                Ok(())
            }
            // SAFETY: the call takes only flags.
            Self::Locked => match unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } {
                0 => Ok(()),
                _ => Err(io::Error::last_os_error()),
            },
            Self::NoDescriptor => {
                let limit = Rlimit { current: Some(DESCRIPTORS), maximum: Some(DESCRIPTORS) };
                setrlimit(Resource::Nofile, limit)?;
                loop {
                    match dup(io::stderr()) {
                        // The descriptor stays open.
                        Ok(fd) => std::mem::forget(fd),
                        Err(Refusal::MFILE) => return Ok(()),
                        Err(errno) => return Err(errno.into()),
                    }
                }
            }
            Self::NoMemory => group::join(&group()?),
        }
    }

    /// Tries the situation in a child process. Returns the reason if it is not possible here.
    pub(crate) fn refused(self) -> Option<String> {
        if self == Self::Child {
            return None;
        }
        if self == Self::NoMemory
            && let Err(error) = group()
        {
            return Some(error.to_string());
        }
        // SAFETY: this process has one thread.
        match unsafe { fork() } {
            Err(error) => Some(error.to_string()),
            Ok(ForkResult::Child) => {
                let code = self.try_begin().err().map_or(0, |e| e.raw_os_error().unwrap_or(255));
                // SAFETY: ends the process at once.
                unsafe { libc::_exit(code) }
            }
            Ok(ForkResult::Parent { child }) => match waitpid(child, None) {
                Ok(WaitStatus::Exited(_, 0)) => None,
                Ok(WaitStatus::Exited(_, code)) => Some(Errno::from_raw(code).to_string()),
                other => Some(format!("{other:?}")),
            },
        }
    }
}

static GROUP: Mutex<Option<Group>> = Mutex::new(None);

/// Returns the control group without memory, which the first call creates.
fn group() -> io::Result<PathBuf> {
    let mut group = GROUP.lock().unwrap_or_else(PoisonError::into_inner);
    if group.is_none() {
        *group = Some(Group::new(LITTLE).map_err(io::Error::other)?);
    }
    Ok(group.as_ref().map(Group::path).map_or_else(PathBuf::new, Path::to_owned))
}

/// Removes the control group when it is dropped.
pub(crate) struct Tidy;

impl Drop for Tidy {
    fn drop(&mut self) {
        *GROUP.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}
