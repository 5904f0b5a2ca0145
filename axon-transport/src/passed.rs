//! Descriptors that go from process to process, and how those of others are closed.
//!
//! Closing one may block for as long as whoever sent it likes: a TCP socket that lingers over unsent
//! data, a file of a user's own file system, a unix socket in whose queue either of them waits. None
//! is therefore closed on a thread that has anything else to do.

use std::{
    fmt, io,
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd, RawFd},
    sync::{Mutex, MutexGuard, TryLockError},
    thread,
};

use rustix::{
    fs::{fcntl_get_seals, fstat},
    io::Errno,
    process::{WaitId, WaitIdOptions, waitid},
};

use crate::session::signals;

/// A memfd that holds less, in blocks of 512 bytes, is closed at once.
const SMALL: i64 = (1 << 20) / 512;

/// A descriptor to be sent to another process, or [received](Self::received) from one. One that was
/// received is closed without making the thread that drops it wait.
pub struct PassedFd {
    /// `None` only while it is dropped.
    fd: Option<OwnedFd>,
    /// Whether closing it may block.
    suspect: bool,
}

impl PassedFd {
    /// One that another process sent, and that can be anything.
    pub fn received(fd: OwnedFd) -> Self {
        Self { fd: Some(fd), suspect: true }
    }

    /// Another descriptor of the same thing.
    ///
    /// # Errors
    /// The process has no descriptors left.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self { fd: Some(self.as_fd().try_clone_to_owned()?), suspect: self.suspect })
    }

    /// Whether it is memory that can be sealed. Asks no file system.
    pub(crate) fn is_memfd(&self) -> bool {
        fcntl_get_seals(self).is_ok()
    }

    /// Whether it stands for a process. Takes no lock of what it is, which whoever sent it could
    /// keep.
    pub(crate) fn is_pidfd(&self) -> bool {
        is_pidfd(self.as_fd())
    }

    /// Closing it has turned out not to block.
    pub(crate) fn harmless(mut self) -> Self {
        self.suspect = false;
        self
    }
}

impl From<OwnedFd> for PassedFd {
    /// One of our own.
    fn from(fd: OwnedFd) -> Self {
        Self { fd: Some(fd), suspect: false }
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
        if let Some(fd) = self.fd.take()
            && self.suspect
            && !closes_at_once(&fd)
        {
            close_elsewhere(fd);
        }
    }
}

/// Only a pidfd can be waited for, though by nobody but the process's parent (Linux 5.4).
fn is_pidfd(fd: BorrowedFd<'_>) -> bool {
    let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
    matches!(waitid(WaitId::PidFd(fd), look), Ok(_) | Err(Errno::CHILD))
}

/// Whether it is a memfd that gives little memory back. Asks nothing that a file system of somebody
/// else's could answer late.
fn closes_at_once(fd: &OwnedFd) -> bool {
    fcntl_get_seals(fd).is_ok() && fstat(fd).is_ok_and(|found| found.st_blocks < SMALL)
}

/// Threads that close, at most. One more is started for each descriptor, since all the others may
/// be blocked, and ends when none is left.
const THREADS: usize = 32;

struct Closing {
    /// The process that the threads are in: a forked child has none of its parent's.
    process: u32,
    threads: usize,
    waiting: Vec<OwnedFd>,
}

static CLOSING: Mutex<Closing> =
    Mutex::new(Closing { process: 0, threads: 0, waiting: Vec::new() });

fn close_elsewhere(fd: OwnedFd) {
    // In a forked child that has never used it, where it is locked for ever, or nearly never: the
    // parent has another descriptor of the same thing then, and closing this one frees nothing.
    let Some(mut closing) = lock() else { return };
    let process = std::process::id();
    if closing.process != process {
        *closing = Closing { process, threads: 0, waiting: Vec::new() };
    }
    closing.waiting.push(fd);
    if closing.threads == THREADS {
        return;
    }
    closing.threads += 1;
    drop(closing);
    let blocked = signals::Blocked::all();
    let started = thread::Builder::new().name("axon-close".into()).spawn(close_all);
    drop(blocked);
    if let Err(error) = started {
        // The next one that is closed starts a thread for both.
        tracing::error!(%error, "no thread to close another process's descriptor on");
        if let Some(mut closing) = lock() {
            closing.threads -= 1;
        }
    }
}

fn close_all() {
    loop {
        let Some(mut closing) = lock() else { continue };
        let Some(fd) = closing.waiting.pop() else {
            closing.threads -= 1;
            return;
        };
        drop(closing);
        drop(fd);
    }
}

/// The lock is held for no longer than a push or pop takes.
fn lock() -> Option<MutexGuard<'static, Closing>> {
    for _ in 0..1000 {
        match CLOSING.try_lock() {
            Ok(closing) => return Some(closing),
            Err(TryLockError::Poisoned(closing)) => return Some(closing.into_inner()),
            Err(TryLockError::WouldBlock) => thread::yield_now(),
        }
    }
    None
}

#[cfg(test)]
pub(crate) mod tests {
    use std::{
        io::{IoSlice, Write},
        mem::MaybeUninit,
        net::{TcpListener, TcpStream},
        time::Duration,
    };

    use rustix::{
        fs::{MemfdFlags, memfd_create},
        net::{
            AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags,
            SocketType, sendmsg, socketpair, sockopt,
        },
    };

    use super::*;

    /// A socket whose last close takes hours, since it lingers over what its peer does not read.
    pub(crate) fn reluctant() -> (OwnedFd, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        sockopt::set_socket_recv_buffer_size(&listener, 4096).unwrap();
        let mut ours = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (peer, _) = listener.accept().unwrap();
        ours.set_nonblocking(true).unwrap();
        sockopt::set_socket_send_buffer_size(&ours, 4096).unwrap();
        while ours.write(&[0; 1 << 16]).is_ok() {}
        sockopt::set_socket_linger(&ours, Some(Duration::from_secs(10_000))).unwrap();
        (ours.into(), peer)
    }

    /// A packet with a descriptor, which is from then on in nobody's hands but the receiver's.
    pub(crate) fn send_away(socket: impl AsFd, bytes: &[u8], fd: OwnedFd) {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        let rights = [fd.as_fd()];
        assert!(control.push(SendAncillaryMessage::ScmRights(&rights)));
        sendmsg(socket, &[IoSlice::new(bytes)], &mut control, SendFlags::empty()).unwrap();
    }

    pub(crate) fn pair() -> (OwnedFd, OwnedFd) {
        socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap()
    }

    #[test]
    fn a_descriptor_of_another_keeps_nobody_waiting() {
        // Each would not return for hours.
        let mut peers = Vec::new();
        for _ in 0..THREADS + 2 {
            let (fd, peer) = reluctant();
            drop(PassedFd::received(fd));
            peers.push(peer);
        }
        // Threads that are blocked keep later ones waiting, and end when they can go on.
        peers.clear();
        let (ours, theirs) = pair();
        drop(PassedFd::received(ours));
        let mut byte = [0];
        assert_eq!(rustix::io::read(&theirs, &mut byte), Ok(0), "it is closed in the end");
    }

    #[test]
    fn nor_does_one_that_hides_in_a_socket() {
        let (fd, _peer) = reluctant();
        let (ours, theirs) = pair();
        send_away(&theirs, b"x", fd);
        // The queue of `ours` holds the last reference.
        drop(theirs);
        drop(PassedFd::received(ours));
    }

    #[test]
    fn what_closes_at_once_is_told_without_asking_its_file_system() {
        let memfd = memfd_create("test", MemfdFlags::CLOEXEC).unwrap();
        assert!(closes_at_once(&memfd));
        rustix::io::write(&memfd, &vec![1; 2 << 20]).unwrap();
        assert!(!closes_at_once(&memfd), "it gives much memory back");
        assert!(!closes_at_once(&tempfile::tempfile().unwrap().into()));
    }

    #[test]
    fn only_a_pidfd_is_one() {
        use rustix::{
            event::{EventfdFlags, epoll, eventfd},
            process::{PidfdFlags, getpid, getppid, pidfd_open},
        };
        let of = |pid| PassedFd::received(pidfd_open(pid, PidfdFlags::empty()).unwrap());
        assert!(of(getpid()).is_pidfd() && of(getppid().unwrap()).is_pidfd());
        let mut child = std::process::Command::new("true").spawn().unwrap();
        let ended = of(rustix::process::Pid::from_child(&child));
        assert!(ended.is_pidfd());
        child.wait().unwrap();
        assert!(ended.is_pidfd(), "also of one that has ended");
        let others: [OwnedFd; 5] = [
            epoll::create(epoll::CreateFlags::CLOEXEC).unwrap(),
            eventfd(0, EventfdFlags::CLOEXEC).unwrap(),
            std::fs::File::open("/dev/null").unwrap().into(),
            // Its directory names a process, too.
            std::fs::File::open("/proc/self").unwrap().into(),
            pair().0,
        ];
        others.map(PassedFd::received).iter().for_each(|fd| assert!(!fd.is_pidfd(), "{fd:?}"));
    }
}
