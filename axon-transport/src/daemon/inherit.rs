//! Descriptors that an application left open across exec: a port that its daemon kept open would
//! stay taken when the application is long gone.

#![allow(unsafe_code)]

/// Closes every descriptor but the standard streams. To be called first thing in `main`, while
/// the process has one thread and has opened nothing itself.
pub(super) fn close_inherited() {
    // SAFETY: the system call takes plain integers. No value in this process owns any of these
    // descriptors: it has opened none yet, and std takes no interest in those it was born with
    // but the first three.
    unsafe { libc::close_range(3, libc::c_uint::MAX, 0) };
}
