//! Shared memory: sealed memfds, the maps over them, and limits for both. Also private pages for secrets.

pub(crate) mod available;
pub(crate) mod copy;
pub(crate) mod locked;
pub(crate) mod prefetch;
pub(crate) mod probe;
pub(crate) mod quota;
pub(crate) mod segment;
