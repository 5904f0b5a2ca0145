//! What a daemon inherits from the application that starts it and must not keep.
//!
//! Descriptors that an application left open across exec: a port that its daemon kept open would
//! stay taken when the application is long gone. A limit on the size of files: the signal that
//! enforces it would end the daemon at a log line.

#![allow(unsafe_code)]

/// Has every descriptor but the standard streams closed when this process execs, as it is about to.
pub(super) fn close_inherited() {
    // SAFETY: the system call takes plain integers and closes nothing: it only marks descriptors,
    // which no owner of one can tell.
    unsafe { libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int) };
}

/// Has a write beyond RLIMIT_FSIZE (`ulimit -f`) fail with EFBIG and not end the process.
pub(super) fn survive_file_size_limit() {
    // SAFETY: SIG_IGN installs no handler, and no other code of this process handles SIGXFSZ.
    unsafe { libc::signal(libc::SIGXFSZ, libc::SIG_IGN) };
}
