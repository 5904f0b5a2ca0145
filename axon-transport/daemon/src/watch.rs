//! Registers descriptors with tokio's reactor.

#![allow(unsafe_code)]

use std::io;

use axon_shm::internal::descriptors::PassedFd;
use tokio::io::unix::AsyncFd;

/// Has the current runtime watch a descriptor.
pub(crate) fn watch(fd: impl Into<PassedFd>) -> io::Result<AsyncFd<PassedFd>> {
    // SAFETY: a `PassedFd` is always the same open descriptor, nobody else closes it, and
    // `AsyncFd` removes it from the reactor before it drops it.
    unsafe { AsyncFd::register(fd.into()) }.map_err(Into::into)
}
