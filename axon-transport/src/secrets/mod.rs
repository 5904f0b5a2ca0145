//! Secrets in the daemon's memory: keys in locked pages, and an allocator that erases what it frees.

mod arena;
mod heap;
#[cfg(test)]
mod residue;

pub(crate) use arena::{LockedKey, prepare};
pub use heap::ErasingHeap;
pub(crate) use heap::erase_from_now_on;
#[cfg(test)]
pub(crate) use residue::left_on_the_stack;
