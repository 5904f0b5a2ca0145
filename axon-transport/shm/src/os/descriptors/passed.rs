//! A descriptor of another process, or for one.

use std::{
    fmt, io,
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd},
    sync::{Arc, atomic::Ordering},
};

use rustix::{
    fs::{fcntl_get_seals, fstat},
    io::Errno,
    net::{Shutdown, shutdown},
    process::{WaitId, WaitIdOptions, waitid},
};

use crate::os::closer::{self, FdClass, OPEN};

/// Size in blocks of 512 bytes below which a memfd is closed at once.
const SMALL: i64 = (1 << 20) / 512;

/// A descriptor to be sent to another process, or [received](Self::received) from one. Dropping a received one does not
/// make the dropping thread wait for the close.
pub struct PassedFd {
    /// `None` only while it is dropped. Owned together with the values that [`share`](Self::share) returned.
    fd: Option<Arc<OwnedFd>>,
    origin: FdOrigin,
}

/// The origin of a descriptor, which decides how it is closed.
#[derive(Clone, Copy, PartialEq, Eq)]
enum FdOrigin {
    Own,
    /// Another process sent it.
    Passed,
    /// A socket whose queue may contain descriptors of other processes.
    Connection(FdClass),
}

impl PassedFd {
    /// Wraps a descriptor that another process sent, and that can be of any kind.
    pub fn received(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Passed)
    }

    /// Wraps a connection, with the contents of its queue. When it is dropped, its other end learns that at once.
    pub fn connection(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Connection(FdClass::Stranger))
    }

    /// Marks the connection as one of a process that may have a session.
    pub fn trusted(mut self) -> Self {
        self.origin = FdOrigin::Connection(FdClass::Session);
        self
    }

    fn new(fd: OwnedFd, origin: FdOrigin) -> Self {
        // The counter guards nothing: the functions that read it may miss descriptors that are opened or closed at the
        // moment.
        OPEN.fetch_add(1, Ordering::Relaxed);
        Self { fd: Some(Arc::new(fd)), origin }
    }

    /// Duplicates the descriptor.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self::new(self.as_fd().try_clone_to_owned()?, self.origin_of_copy()))
    }

    /// Returns the same descriptor once more, within this process: it takes no further one, and is closed with the
    /// last of its values.
    #[must_use]
    pub fn share(&self) -> Self {
        Self { fd: self.fd.clone(), origin: self.origin_of_copy() }
    }

    /// Closes the descriptor at once if it is a copy of `other`, whose open file stays. A process that receives many
    /// copies together would otherwise hold all of them until another thread closes them.
    pub(crate) fn close_copy_of(mut self, other: &Self) {
        let file = |fd: &Self| fstat(fd).ok().map(|found| (found.st_dev, found.st_ino));
        if file(&self).is_some_and(|own| Some(own) == file(other)) {
            self.origin = FdOrigin::Own;
        }
    }

    fn origin_of_copy(&self) -> FdOrigin {
        match self.origin {
            // The connection must not end with a copy of its descriptor.
            FdOrigin::Connection(_) => FdOrigin::Passed,
            origin => origin,
        }
    }

    /// Returns whether it is memory that can be sealed, or a file of a tmpfs, which is as good. Calls no file system.
    pub fn is_memfd(&self) -> bool {
        fcntl_get_seals(self).is_ok()
    }

    /// Returns the device and inode of the file, if it is a memfd. Other file systems could delay the answer.
    pub fn memory(&self) -> Option<(u64, u64)> {
        let found = self.is_memfd().then(|| fstat(self).ok()).flatten()?;
        Some((found.st_dev, found.st_ino))
    }

    /// Returns whether it refers to a process. Takes no lock of the file behind it, which its sender could hold. Only a
    /// pidfd can be waited for, though only by the process's parent (Linux 5.4).
    pub fn is_pidfd(&self) -> bool {
        let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        matches!(waitid(WaitId::PidFd(self.as_fd()), look), Ok(_) | Err(Errno::CHILD))
    }

    /// Returns the class that closes it; `None` if it can be closed at once. Calls no file system of another user,
    /// which could delay the answer.
    pub(super) fn lane(&self) -> Option<FdClass> {
        match self.origin {
            FdOrigin::Own => None,
            FdOrigin::Connection(lane) => Some(lane),
            FdOrigin::Passed if self.is_memfd() => {
                let small = fstat(self).is_ok_and(|found| found.st_blocks < SMALL);
                (!small).then_some(FdClass::Memory)
            }
            FdOrigin::Passed => (!self.is_pidfd()).then_some(FdClass::Session),
        }
    }
}

impl From<OwnedFd> for PassedFd {
    /// Wraps a descriptor of this process.
    fn from(fd: OwnedFd) -> Self {
        Self::new(fd, FdOrigin::Own)
    }
}

impl AsFd for PassedFd {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_ref().expect("it is not being dropped").as_fd()
    }
}

impl AsRawFd for PassedFd {
    fn as_raw_fd(&self) -> RawFd {
        self.as_fd().as_raw_fd()
    }
}

impl fmt::Debug for PassedFd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_fd().fmt(f)
    }
}

impl Drop for PassedFd {
    fn drop(&mut self) {
        if matches!(self.origin, FdOrigin::Connection(_)) {
            // This does not touch the queue, so it does not block, and the other end learns of the end before the
            // close.
            let _ = shutdown(&*self, Shutdown::Both);
        }
        let lane = self.lane();
        // Another value shares it: that one closes it.
        let Some(fd) = self.fd.take().and_then(Arc::into_inner) else { return };
        match lane {
            Some(lane) => lane.close(fd),
            None => {
                drop(fd);
                closer::closed();
            }
        }
    }
}
