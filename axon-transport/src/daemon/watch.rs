//! Descriptors on tokio's reactor.

#![allow(unsafe_code)]

use std::{io, os::fd::OwnedFd};

use tokio::io::unix::AsyncFd;

/// Has the current runtime watch a descriptor.
pub(crate) fn watch(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: an `OwnedFd` is always the same open descriptor, nobody else closes it, and
    // `AsyncFd` removes it from the reactor before it drops it.
    unsafe { AsyncFd::register(fd) }.map_err(Into::into)
}
