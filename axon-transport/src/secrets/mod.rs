//! Secrets in the daemon's memory: keys in locked pages, and an allocator that erases what it frees.

mod arena;
mod heap;

pub(crate) use arena::{LockedKey, prepare};
pub use heap::ErasingHeap;
pub(crate) use heap::erase_from_now_on;
