//! The two clocks: wall-clock time for timestamps, monotonic time for timeouts.

pub(super) use axon_shm::internal::{monotonic, wall};
