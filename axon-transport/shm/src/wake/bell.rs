//! The sending end of a doorbell, which other processes hold.

use std::{
    os::fd::{AsFd, BorrowedFd},
    time::Duration,
};

use rustix::{
    io::Errno,
    net::{AddressFamily, SendFlags, SocketType, send, sockopt},
};

use crate::os::descriptors::PassedFd;

/// Number of attempts to ring if the kernel has no memory for it, with a [`NAP`] after each.
const TRIES: u32 = 100;
const NAP: Duration = Duration::from_millis(1);

/// The end of a pair of unix sockets that rings. A process that holds it can only ring: it cannot take rings away. It
/// can keep another process from ringing only by closing the bell for all, which the receiver detects.
pub(crate) struct DoorbellSender(PassedFd);

impl DoorbellSender {
    pub(super) fn new(fd: PassedFd) -> Self {
        Self(fd)
    }

    /// Wraps the end that another session passed, if it is a unix socket that preserves packets.
    pub(crate) fn received(fd: PassedFd) -> Option<Self> {
        // Neither query reaches a file system, and neither does a send on a socket that passes both checks.
        let unix = sockopt::socket_domain(&fd) == Ok(AddressFamily::UNIX);
        let packets = sockopt::socket_type(&fd) == Ok(SocketType::SEQPACKET);
        (unix && packets).then_some(Self(fd))
    }

    /// Rings, without waiting for the process at the other end. Kernels before 6.9 may first search for unreachable
    /// sockets. A full queue counts as success: it holds rings that nobody has heard yet. Returns false if the kernel
    /// had no memory during the time that a publish may wait; then nobody was woken.
    pub(crate) fn ring(&self) -> bool {
        for _ in 0..TRIES {
            match send(&self.0, &[1], SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
                Err(Errno::NOBUFS | Errno::NOMEM) => std::thread::sleep(NAP),
                Err(Errno::INTR) => {}
                _ => return true,
            }
        }
        tracing::error!(
            "could not ring the peer's doorbell (ENOBUFS or ENOMEM); the next sample will wake it"
        );
        false
    }
}

impl AsFd for DoorbellSender {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
