//! Descriptors that an application left open across exec: a port that its daemon kept open would
//! stay taken when the application is long gone.

#![allow(unsafe_code)]

/// Has every descriptor but the standard streams closed when this process execs, as it is about to.
pub(super) fn close_inherited() {
    // SAFETY: the system call takes plain integers and closes nothing: it only marks descriptors,
    // which no owner of one can tell.
    unsafe { libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int) };
}
