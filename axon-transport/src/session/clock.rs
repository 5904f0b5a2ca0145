//! The two clocks: one for what people read, one for what is waited for.

pub(super) use axon_shm::internal::{monotonic, wall};
