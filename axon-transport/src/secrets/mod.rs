//! Keys in locked memory.

mod arena;

pub use arena::{LockedKey, prepare};
