//! Registers descriptors with tokio's reactor.

#![allow(unsafe_code)]

use std::{io, sync::Arc};

use axon_shm::internal::descriptors::PassedFd;
use tokio::io::unix::AsyncFd;

/// Has the current runtime watch a descriptor.
pub(crate) fn watch(fd: impl Into<PassedFd>) -> io::Result<AsyncFd<PassedFd>> {
    // SAFETY: a `PassedFd` is always the same open descriptor, nobody else closes it, and
    // `AsyncFd` removes it from the reactor before it drops it.
    unsafe { AsyncFd::register(fd.into()) }.map_err(Into::into)
}

/// The same, for one that others hold as well.
pub(crate) fn watch_shared(fd: &Arc<PassedFd>) -> io::Result<AsyncFd<Arc<PassedFd>>> {
    // SAFETY: as above; it is not closed before the last of those that hold it has dropped it.
    unsafe { AsyncFd::register(Arc::clone(fd)) }.map_err(Into::into)
}
