//! The process at the other end of a unix socket, as reported by the kernel.

#![allow(unsafe_code)]

use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};

use rustix::{
    io::Errno,
    process::{Pid, PidfdFlags, pidfd_open},
};

/// The process at the other end, as the kernel recorded it at connect time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PeerProcess {
    /// The user id of the process.
    pub uid: u32,
    /// The process id; 0 if the process is in a PID namespace that this one does not see.
    pub pid: u32,
}

/// Returns the process at the other end (SO_PEERCRED).
///
/// # Errors
/// The error of the system call.
pub fn peer_process(socket: impl AsFd) -> rustix::io::Result<PeerProcess> {
    // rustix is not used: its process ids are never 0, and this one may be.
    let mut found = libc::ucred { pid: 0, uid: u32::MAX, gid: u32::MAX };
    // SAFETY: the option's value is a `ucred`, of which all bit patterns are valid.
    unsafe { option(socket.as_fd(), libc::SO_PEERCRED, &mut found) }?;
    Ok(PeerProcess { uid: found.uid, pid: u32::try_from(found.pid).unwrap_or(0) })
}

/// Returns a pidfd of the process at the other end, which refers to no other process, even when that one has ended.
///
/// # Errors
/// ESRCH if the process has ended and was reaped, if the kernel has no descriptor for that; otherwise the error of the
/// system call.
pub fn peer_pidfd(socket: impl AsFd) -> rustix::io::Result<OwnedFd> {
    let mut found: libc::c_int = -1;
    // SAFETY: the option's value is an `int`.
    match unsafe { option(socket.as_fd(), libc::SO_PEERPIDFD, &mut found) } {
        // SAFETY: it is a descriptor that the kernel has just made for this call.
        Ok(()) => Ok(unsafe { OwnedFd::from_raw_fd(found) }),
        // Before Linux 6.5 there is only its number, which another process could have by now.
        Err(Errno::NOPROTOOPT) => {
            let pid = peer_process(socket)?.pid.cast_signed();
            let pid = Pid::from_raw(pid).ok_or(Errno::NODATA)?;
            Ok(pidfd_open(pid, PidfdFlags::empty())?)
        }
        Err(error) => Err(error),
    }
}

/// Reads an option of the socket.
///
/// # Safety
/// Its value is a `T`, of which all bit patterns are valid.
unsafe fn option<T>(
    socket: BorrowedFd<'_>,
    name: libc::c_int,
    value: &mut T,
) -> rustix::io::Result<()> {
    let mut len = libc::socklen_t::try_from(size_of::<T>()).expect("a few bytes");
    // SAFETY: `len` says how long `value` is, and both live as long as the call; what the kernel writes
    // there is a `T`, as the caller says.
    let done = unsafe {
        libc::getsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            name,
            (&raw mut *value).cast(),
            &raw mut len,
        )
    };
    if done != 0 {
        let errno = std::io::Error::last_os_error().raw_os_error().unwrap_or(libc::EINVAL);
        return Err(Errno::from_raw_os_error(errno));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};

    use super::*;

    #[test]
    fn the_other_end_of_a_pair_is_this_process() {
        let (a, _b) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .unwrap();
        let found = peer_process(&a).unwrap();
        assert_eq!(found.pid, std::process::id());
        assert_eq!(found.uid, rustix::process::getuid().as_raw());
    }
}
