//! The address of a daemon's socket: a path in the runtime directory, or an abstract name.
//!
//! Any user of the host may bind an abstract name first, so a path is preferred if this user has a directory of its
//! own. Under `AXON_RUNTIME_DIR` the path is the whole address. Under `XDG_RUNTIME_DIR` the daemon also listens at
//! the name, for processes of the same user that start without that variable, as services do. A process that has the
//! variable tries the path first.

use std::{
    fs::{DirBuilder, File, OpenOptions},
    os::{
        fd::OwnedFd,
        unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt},
    },
    path::{Path, PathBuf},
    time::Duration,
};

use rustix::{
    fs::{FlockOperation, OFlags, flock},
    io::Errno,
    net::{
        AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
    },
};

use axon_shm::internal::{OwnLimit, peer_process};

use crate::{config::Config, wire::session::PROTOCOL};

/// The address at which the daemon of a user and domain listens.
#[derive(Clone, Debug)]
pub struct Address {
    place: Option<SocketFiles>,
    /// A name in the abstract namespace: the end of the process frees it, and it needs no file system.
    name: Option<String>,
}

/// A socket in the file system, and its lock file.
#[derive(Clone, Debug)]
struct SocketFiles {
    socket: PathBuf,
    /// Locked by the daemon as long as it lives.
    lock: PathBuf,
    /// True if other users may connect. The daemon closes the connections of users that it does not trust.
    shared: bool,
}

/// The listening sockets of an address (close-on-exec and non-blocking), and the lock that keeps the address for this
/// process.
#[derive(Debug)]
pub struct Bound {
    listeners: Vec<OwnedFd>,
    lock: Lock,
}

/// Keeps an address for this process until it is dropped.
#[derive(Debug)]
pub struct Lock {
    _file: Option<File>,
}

impl Bound {
    /// Returns the listeners, at least one, and the lock. The listeners may be closed before the lock is dropped.
    pub fn into_parts(self) -> (Vec<OwnedFd>, Lock) {
        (self.listeners, self.lock)
    }
}

/// The turn to start a daemon, until it is dropped or its process ends.
#[derive(Debug)]
pub(crate) struct SpawnLock {
    _kept: Option<OwnedFd>,
}

/// The reason why an address could not be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AddressError {
    /// No process listens.
    #[error("no daemon listens there")]
    Absent,
    /// A process listens, but has too many callers waiting to accept another.
    #[error("the daemon there has too many callers waiting")]
    Busy,
    /// Another daemon has the address.
    #[error("another daemon has the address")]
    Taken,
    /// A path or directory is not usable.
    #[error("the runtime directory (AXON_RUNTIME_DIR, or XDG_RUNTIME_DIR) {}: {reason}", path.display())]
    Directory {
        /// The path or directory.
        path: PathBuf,
        /// The error, and the remedy.
        reason: String,
    },
    /// A system call failed.
    #[error("the session socket: {0}{own}", own = OwnLimit(&(*.0).into()))]
    System(#[from] Errno),
}

/// Pause between attempts to reach the owner of a name.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);
/// Maximum number of attempts to reach the owner of a name that may be about to listen.
const CALLS: u32 = 20;

impl Address {
    /// Returns the address that `config` describes.
    pub fn of(config: &Config) -> Self {
        let domain = config.domain;
        let name = || {
            let uid = rustix::process::geteuid().as_raw();
            format!("axon/{uid}/{domain}/{PROTOCOL}")
        };
        let place = |dir: &Path, stem: String| SocketFiles {
            socket: dir.join(format!("{stem}.sock")),
            lock: dir.join(format!("{stem}.lock")),
            shared: !config.trusted_uids.is_empty(),
        };
        match &config.runtime_dir {
            Some(dir) if config.socket_in_runtime_dir => {
                Self { place: Some(place(dir, format!("axon-{domain}"))), name: None }
            }
            Some(dir) => {
                // The path contains the network namespace like the name: a daemon serves one network namespace.
                let namespace =
                    std::fs::metadata("/proc/thread-self/ns/net").map_or(0, |m| m.ino());
                let stem = format!("axon-{domain}-{namespace}");
                Self { place: Some(place(dir, stem)), name: Some(name()) }
            }
            None => Self { place: None, name: Some(name()) },
        }
    }

    /// Connects to the daemon at the address, without waiting for a daemon that does not answer.
    ///
    /// # Errors
    /// [`AddressError::Absent`] if there is no daemon.
    pub fn connect(&self) -> Result<OwnedFd, AddressError> {
        let at_place = |place: &SocketFiles| path_name(&place.socket).and_then(|path| call(&path));
        let at_name = |name: &String| abstract_name(name).and_then(|name| call(&name));
        match (&self.place, &self.name) {
            (Some(place), None) => at_place(place),
            (None, Some(name)) => at_name(name),
            (Some(place), Some(name)) => {
                // XDG_RUNTIME_DIR may come from another user's login, and another user may have bound the name: neither
                // must keep this user from a daemon of its own.
                let own = |socket: &OwnedFd| is_own(socket);
                match at_place(place) {
                    Err(AddressError::Busy) => Err(AddressError::Busy),
                    // This process has no descriptors left, which does not mean that there is no daemon.
                    Err(AddressError::System(errno @ (Errno::MFILE | Errno::NFILE))) => {
                        Err(errno.into())
                    }
                    called => called.ok().filter(own).map_or_else(
                        || at_name(name).ok().filter(own).ok_or(AddressError::Absent),
                        Ok,
                    ),
                }
            }
            (None, None) => Err(AddressError::Absent),
        }
    }

    /// Binds the address. A stale socket file is replaced.
    ///
    /// # Errors
    /// [`AddressError::Taken`] if another daemon has the address.
    pub fn bind(&self) -> Result<Bound, AddressError> {
        let mut listeners = Vec::new();
        let mut lock = Lock { _file: None };
        match self.place.as_ref().map(SocketFiles::bind) {
            None => {}
            Some(Ok((listener, file))) => {
                listeners.push(listener);
                lock = Lock { _file: Some(file) };
            }
            // XDG_RUNTIME_DIR may name the directory of a login that has ended: the abstract name is enough.
            Some(Err(error @ AddressError::Directory { .. })) if self.name.is_some() => {
                tracing::warn!(%error, "the session socket has an abstract name only");
            }
            Some(Err(error)) => return Err(error),
        }
        if let Some(name) = &self.name {
            match bind_name(name) {
                Ok(listener) => listeners.push(listener),
                Err(AddressError::Taken) if !listeners.is_empty() && !is_served(name)? => {
                    tracing::warn!(
                        name,
                        "another user has the daemon's abstract name: processes without \
                         XDG_RUNTIME_DIR do not find this daemon; set AXON_RUNTIME_DIR for all"
                    );
                }
                Err(error) => return Err(error),
            }
        }
        Ok(Bound { listeners, lock })
    }

    /// Returns whether another user can take the address before this user's daemon.
    pub(crate) fn is_open_to_others(&self) -> bool {
        self.place.is_none()
    }

    /// Removes the socket file of a daemon that ends.
    pub fn remove(&self) {
        if let Some(place) = &self.place {
            let _ = std::fs::remove_file(&place.socket);
        }
    }

    /// Takes the turn to start a daemon here. Returns `None` if another thread or process has it. A bound name or a
    /// locked file holds the turn: if neither is possible, every caller gets a turn.
    pub(crate) fn turn(&self) -> Option<SpawnLock> {
        match self.try_turn() {
            Ok(kept) => Some(SpawnLock { _kept: Some(kept) }),
            Err(Errno::ADDRINUSE | Errno::WOULDBLOCK) => None,
            Err(_) => Some(SpawnLock { _kept: None }),
        }
    }

    fn try_turn(&self) -> Result<OwnedFd, Errno> {
        if let Some(place) = &self.place {
            // The daemon reports errors of the directory. Nothing is written to another user's directory.
            let ours = place.socket.parent().map(private_directory).is_none_or(|made| made.is_ok());
            if !ours {
                return if self.name.is_some() { self.name_turn() } else { Err(Errno::ACCESS) };
            }
            let flags = OFlags::CREATE | OFlags::WRONLY | OFlags::CLOEXEC;
            let file = place.socket.with_extension("start");
            match rustix::fs::open(file, flags, 0o600.into()) {
                Ok(file) => {
                    flock(&file, FlockOperation::NonBlockingLockExclusive)?;
                    return Ok(file);
                }
                Err(errno) if self.name.is_none() => return Err(errno),
                Err(_) => {}
            }
        }
        self.name_turn()
    }

    fn name_turn(&self) -> Result<OwnedFd, Errno> {
        let name = format!("{}/start", self.name.as_deref().unwrap_or_default());
        let socket = seqpacket(SocketFlags::CLOEXEC)?;
        bind(&socket, &SocketAddrUnix::new_abstract_name(name.as_bytes())?)?;
        Ok(socket)
    }
}

impl SocketFiles {
    /// Takes the lock, then listens at the path.
    fn bind(&self) -> Result<(OwnedFd, File), AddressError> {
        let Self { socket, lock, shared } = self;
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
        // A kill leaves the file behind; only the holder of the lock may remove it.
        if let Err(e) = std::fs::remove_file(socket)
            && e.kind() != std::io::ErrorKind::NotFound
        {
            return Err(directory(socket, &e));
        }
        let listener = listen_at(&path_name(socket)?)?;
        if *shared {
            // A connecting process needs write permission, and the umask takes that from other users.
            let mode = std::fs::Permissions::from_mode(0o666);
            std::fs::set_permissions(socket, mode).map_err(|e| directory(socket, &e))?;
        }
        Ok((listener, file))
    }
}

fn bind_name(name: &str) -> Result<OwnedFd, AddressError> {
    listen_at(&abstract_name(name)?)
}

fn listen_at(name: &SocketAddrUnix) -> Result<OwnedFd, AddressError> {
    let listener = seqpacket(SocketFlags::CLOEXEC | SocketFlags::NONBLOCK)?;
    match bind(&listener, name) {
        Ok(()) => {}
        Err(Errno::ADDRINUSE) => return Err(AddressError::Taken),
        Err(errno) => return Err(errno.into()),
    }
    listen(&listener, 512)?;
    Ok(listener)
}

fn call(name: &SocketAddrUnix) -> Result<OwnedFd, AddressError> {
    let socket = seqpacket(SocketFlags::CLOEXEC | SocketFlags::NONBLOCK)?;
    match connect(&socket, name) {
        Ok(()) => Ok(socket),
        Err(Errno::CONNREFUSED | Errno::NOENT) => Err(AddressError::Absent),
        Err(Errno::AGAIN) => Err(AddressError::Busy),
        Err(errno) => Err(errno.into()),
    }
}

/// Returns whether a process of this user listens at a name that is bound.
fn is_served(name: &str) -> Result<bool, AddressError> {
    let name = abstract_name(name)?;
    for _ in 0..CALLS {
        match call(&name) {
            Ok(socket) => return Ok(is_own(&socket)),
            // A starting daemon has bound the name and does not listen yet.
            Err(_) => std::thread::sleep(RETRY_INTERVAL),
        }
    }
    Ok(false)
}

fn is_own(socket: &OwnedFd) -> bool {
    let own = rustix::process::geteuid().as_raw();
    peer_process(socket).is_ok_and(|peer| peer.uid == own)
}

fn abstract_name(name: &str) -> Result<SocketAddrUnix, AddressError> {
    Ok(SocketAddrUnix::new_abstract_name(name.as_bytes())?)
}

fn path_name(socket: &Path) -> Result<SocketAddrUnix, AddressError> {
    SocketAddrUnix::new(socket).map_err(|_| {
        let reason = "a socket's path has at most 107 bytes; choose a shorter directory";
        AddressError::Directory { path: socket.into(), reason: reason.into() }
    })
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match (&self.place, &self.name) {
            (Some(place), _) => write!(f, "{}", place.socket.display()),
            (None, Some(name)) => write!(f, "@{name}"),
            (None, None) => Ok(()),
        }
    }
}

/// Creates `dir` with mode 0700, or checks that only this user can write to it.
///
/// # Errors
/// An error that names the directory and the reason.
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
