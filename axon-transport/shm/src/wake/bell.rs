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

/// How often, and after how long each time, a ring that the kernel has no memory for is tried again.
const TRIES: u32 = 100;
const NAP: Duration = Duration::from_millis(1);

/// One end of a pair of unix sockets. A process that holds it can ring, and nothing worse: it cannot take
/// rings away, nor keep another from ringing but by closing the bell for all, which is noticed.
pub(crate) struct DoorbellSender(PassedFd);

impl DoorbellSender {
    pub(super) fn new(fd: PassedFd) -> Self {
        Self(fd)
    }

    /// The end that another session handed over, if it is what it should be.
    pub(crate) fn received(fd: PassedFd) -> Option<Self> {
        // Neither question reaches a file system, nor does ringing what answers so.
        let unix = sockopt::socket_domain(&fd) == Ok(AddressFamily::UNIX);
        let packets = sockopt::socket_type(&fd) == Ok(SocketType::SEQPACKET);
        (unix && packets).then_some(Self(fd))
    }

    /// Rings, without waiting for the process at the other end; kernels before 6.9 may first look for
    /// sockets that nobody can reach any more. That there is no room is as good: then rings stand
    /// there that nobody has heard yet. `false` when the kernel had no memory for it for as long as a
    /// publish may wait, and nobody was woken.
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
