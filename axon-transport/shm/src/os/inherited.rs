//! Removes the state that a daemon inherits from the application that starts it and must not keep.
//!
//! - Descriptors that the application left open across exec: a port that the daemon kept open would stay in use long
//!   after the application has ended.
//! - A limit on the size of files: the signal that enforces the limit would end the daemon at a log line.

#![allow(unsafe_code)]

/// Marks every descriptor except the standard streams to be closed when this process execs, which it is about to do.
pub fn close_inherited() {
    // SAFETY: the system call takes plain integers and closes nothing: it only marks descriptors,
    // which no owner of one can tell.
    let marked = unsafe {
        libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int)
    };
    // Linux before 5.11 does not know the flag, before 5.9 not the system call.
    if marked != 0 {
        mark_listed();
    }
}

/// Marks the descriptors that /proc lists, one by one.
fn mark_listed() {
    let Ok(entries) = std::fs::read_dir("/proc/self/fd") else { return };
    for entry in entries.flatten() {
        let number = entry.file_name().to_str().and_then(|name| name.parse::<libc::c_int>().ok());
        if let Some(fd) = number.filter(|fd| *fd > 2) {
            // SAFETY: as above; one that was closed meanwhile, such as that of the listing, is EBADF.
            unsafe { libc::fcntl(fd, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
}

/// Makes a write beyond RLIMIT_FSIZE (`ulimit -f`) fail with EFBIG instead of ending the process.
pub fn survive_file_size_limit() {
    // SAFETY: SIG_IGN installs no handler, and no other code of this process handles SIGXFSZ.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}

#[cfg(test)]
mod tests {
    use std::os::fd::AsRawFd as _;

    use super::*;

    #[test]
    fn every_listed_descriptor_is_marked_but_the_standard_streams() {
        let file = std::fs::File::open("/dev/null").unwrap();
        // SAFETY: plain integers, on a descriptor that `file` keeps open.
        let flags = || unsafe { libc::fcntl(file.as_raw_fd(), libc::F_GETFD) };
        // SAFETY: as above.
        unsafe { libc::fcntl(file.as_raw_fd(), libc::F_SETFD, 0) };
        assert_eq!(flags(), 0);
        mark_listed();
        assert_eq!(flags(), libc::FD_CLOEXEC);
        // SAFETY: plain integers.
        let standard = [1, 2].map(|fd| unsafe { libc::fcntl(fd, libc::F_GETFD) });
        assert_eq!(standard, [0, 0]);
    }
}
