//! Where a daemon's socket is: an abstract name, or a path in the runtime directory.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    os::{
        fd::OwnedFd,
        unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt},
    },
    path::{Path, PathBuf},
};

use rustix::{
    fs::{FlockOperation, OFlags, flock},
    io::Errno,
    net::{
        AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
    },
};

use super::message::PROTOCOL;
use crate::config::Config;

/// Where the daemon of a user and domain listens.
#[derive(Clone, Debug)]
pub enum Address {
    /// A name in the abstract namespace (written with an `@` in front): a kill frees it, and no
    /// file system is needed.
    Abstract(String),
    /// A path under `AXON_RUNTIME_DIR`, with its lock file.
    Path {
        /// The socket.
        socket: PathBuf,
        /// Locked by the daemon as long as it lives.
        lock: PathBuf,
    },
}

/// A socket that listens (close-on-exec and non-blocking), and what keeps it ours.
#[derive(Debug)]
pub struct Bound {
    listener: OwnedFd,
    lock: Lock,
}

/// Keeps an address ours until it is dropped.
#[derive(Debug)]
pub struct Lock {
    _file: Option<File>,
}

impl Bound {
    /// The listener, which may be closed before the lock is given up.
    pub fn into_parts(self) -> (OwnedFd, Lock) {
        (self.listener, self.lock)
    }
}

/// The turn to start a daemon, until it is dropped or its process ends.
#[derive(Debug)]
pub(crate) struct Turn {
    _kept: Option<OwnedFd>,
}

/// Why an address could not be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AddressError {
    /// Nobody listens.
    #[error("no daemon listens there")]
    Absent,
    /// Somebody listens, but has too many callers waiting to take another.
    #[error("the daemon there has too many callers waiting")]
    Busy,
    /// Another daemon has it.
    #[error("another daemon has the address")]
    Taken,
    /// A path or directory is not usable.
    #[error("AXON_RUNTIME_DIR {}: {reason}", path.display())]
    Directory {
        /// Which.
        path: PathBuf,
        /// What is wrong and what would be right.
        reason: String,
    },
    /// The system refused.
    #[error("{0}")]
    System(#[from] Errno),
}

impl Address {
    /// The address that `config` stands for.
    pub fn of(config: &Config) -> Self {
        match &config.runtime_dir {
            Some(dir) if config.socket_in_runtime_dir => Self::Path {
                socket: dir.join(format!("axon-{}.sock", config.domain)),
                lock: dir.join(format!("axon-{}.lock", config.domain)),
            },
            _ => {
                let uid = rustix::process::geteuid().as_raw();
                Self::Abstract(format!("axon/{uid}/{}/{PROTOCOL}", config.domain))
            }
        }
    }

    /// Connects to the daemon there, without waiting for one that does not answer.
    ///
    /// # Errors
    /// [`AddressError::Absent`] when there is none.
    pub fn connect(&self) -> Result<OwnedFd, AddressError> {
        let socket = seqpacket(SocketFlags::CLOEXEC | SocketFlags::NONBLOCK)?;
        match connect(&socket, &self.name()?) {
            Ok(()) => Ok(socket),
            Err(Errno::CONNREFUSED | Errno::NOENT) => Err(AddressError::Absent),
            Err(Errno::AGAIN) => Err(AddressError::Busy),
            Err(errno) => Err(errno.into()),
        }
    }

    /// Takes the address, or says that another daemon has it. A stale socket file is replaced.
    ///
    /// # Errors
    /// [`AddressError::Taken`] when another daemon has it.
    pub fn bind(&self) -> Result<Bound, AddressError> {
        let lock = match self {
            Self::Abstract(_) => None,
            Self::Path { socket, lock } => {
                if let Some(dir) = socket.parent() {
                    private_directory(dir)?;
                }
                let file = OpenOptions::new()
                    .create(true)
                    .truncate(false)
                    .write(true)
                    .mode(0o600)
                    .open(lock)
                    .map_err(|e| directory(lock, &e))?;
                match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                    Ok(()) => {}
                    Err(Errno::WOULDBLOCK) => return Err(AddressError::Taken),
                    Err(errno) => return Err(errno.into()),
                }
                // A kill leaves the file behind; whoever holds the lock may remove it.
                if let Err(e) = std::fs::remove_file(socket)
                    && e.kind() != std::io::ErrorKind::NotFound
                {
                    return Err(directory(socket, &e));
                }
                Some(file)
            }
        };
        let listener = seqpacket(SocketFlags::CLOEXEC | SocketFlags::NONBLOCK)?;
        match bind(&listener, &self.name()?) {
            Ok(()) => {}
            Err(Errno::ADDRINUSE) => return Err(AddressError::Taken),
            Err(errno) => return Err(errno.into()),
        }
        listen(&listener, 512)?;
        Ok(Bound { listener, lock: Lock { _file: lock } })
    }

    /// The turn to start a daemon here; `None` where another thread or process has it. What keeps it
    /// is a bound name or a locked file: where neither can be had, nobody is kept from trying.
    pub(crate) fn turn(&self) -> Option<Turn> {
        match self.try_turn() {
            Ok(kept) => Some(Turn { _kept: Some(kept) }),
            Err(Errno::ADDRINUSE | Errno::WOULDBLOCK) => None,
            Err(_) => Some(Turn { _kept: None }),
        }
    }

    fn try_turn(&self) -> Result<OwnedFd, Errno> {
        match self {
            Self::Abstract(name) => {
                let socket = seqpacket(SocketFlags::CLOEXEC)?;
                let name = format!("{name}/start");
                bind(&socket, &SocketAddrUnix::new_abstract_name(name.as_bytes())?)?;
                Ok(socket)
            }
            Self::Path { socket, .. } => {
                // What is wrong with it, the daemon says.
                let _ = socket.parent().map(private_directory);
                let flags = OFlags::CREATE | OFlags::WRONLY | OFlags::CLOEXEC;
                let file = rustix::fs::open(socket.with_extension("start"), flags, 0o600.into())?;
                flock(&file, FlockOperation::NonBlockingLockExclusive)?;
                Ok(file)
            }
        }
    }

    fn name(&self) -> Result<SocketAddrUnix, AddressError> {
        match self {
            Self::Abstract(name) => Ok(SocketAddrUnix::new_abstract_name(name.as_bytes())?),
            Self::Path { socket, .. } => SocketAddrUnix::new(socket.as_path()).map_err(|_| {
                let reason = "a socket's path has at most 107 bytes; choose a shorter directory";
                AddressError::Directory { path: socket.clone(), reason: reason.into() }
            }),
        }
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Abstract(name) => write!(f, "@{name}"),
            Self::Path { socket, .. } => write!(f, "{}", socket.display()),
        }
    }
}

/// Makes `dir` with mode 0700, or checks that nobody but this user can write to it.
///
/// # Errors
/// Names the directory and what is wrong with it.
pub fn private_directory(dir: &Path) -> Result<(), AddressError> {
    DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(|e| directory(dir, &e))?;
    let meta = std::fs::metadata(dir).map_err(|e| directory(dir, &e))?;
    let uid = rustix::process::geteuid().as_raw();
    let refuse = |reason: String| AddressError::Directory { path: dir.into(), reason };
    if meta.uid() != uid {
        return Err(refuse(format!("belongs to uid {}, not to {uid}", meta.uid())));
    }
    if meta.mode() & 0o022 != 0 {
        let mode = meta.mode() & 0o777;
        return Err(refuse(format!("others may write to it (mode {mode:o}); make it 0700")));
    }
    Ok(())
}

fn seqpacket(flags: SocketFlags) -> Result<OwnedFd, Errno> {
    socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)
}

fn directory(path: &Path, error: &std::io::Error) -> AddressError {
    AddressError::Directory { path: path.into(), reason: error.to_string() }
}
