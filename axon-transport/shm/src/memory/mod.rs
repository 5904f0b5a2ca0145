//! Memory that is shared: sealed memfds, the maps over them, and how much of either there may be. And pages
//! that nobody shares.

pub(crate) mod available;
pub(crate) mod copy;
pub(crate) mod locked;
pub(crate) mod prefetch;
pub(crate) mod probe;
pub(crate) mod quota;
pub(crate) mod segment;
