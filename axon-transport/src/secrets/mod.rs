//! Keys in locked memory.

mod arena;
#[cfg(test)]
mod residue;

pub(crate) use arena::{LockedKey, prepare};
#[cfg(test)]
pub(crate) use residue::left_on_the_stack;
