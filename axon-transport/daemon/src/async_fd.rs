//! Registers descriptors with tokio's reactor. tokio deprecates the safe constructors of `AsyncFd` as unsound, since a
//! type may close its descriptor while it is registered. This file guarantees what tokio cannot check.

#![allow(unsafe_code)]

use std::{io, sync::Arc};

use axon_shm::internal::descriptors::PassedFd;
use tokio::io::unix::AsyncFd;

/// Makes the current runtime watch a descriptor.
pub(crate) fn watch(fd: impl Into<PassedFd>) -> io::Result<AsyncFd<PassedFd>> {
    // SAFETY: a `PassedFd` is always the same open descriptor, no other code closes it, and
    // `AsyncFd` removes it from the reactor before it drops it.
    unsafe { AsyncFd::register(fd.into()) }.map_err(Into::into)
}

/// Makes the current runtime watch a descriptor that other code holds as well.
pub(crate) fn watch_shared(fd: &Arc<PassedFd>) -> io::Result<AsyncFd<Arc<PassedFd>>> {
    // SAFETY: as above; the descriptor is closed once its last holder has dropped it.
    unsafe { AsyncFd::register(Arc::clone(fd)) }.map_err(Into::into)
}
