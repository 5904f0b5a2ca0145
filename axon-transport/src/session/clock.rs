//! The two clocks: wall-clock time for timestamps, monotonic time for timeouts.

pub use axon_shm::internal::{from_unix_nanos, unix_nanos};
pub(super) use axon_shm::internal::{monotonic, wall};
