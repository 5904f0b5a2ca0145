//! Allocation of a session's own memory: segments, objects, slots for large samples, and limits for the samples
//! that readers pin.

pub(crate) mod area;
pub(crate) mod blocks;
pub(crate) mod budget;
pub(crate) mod classes;
pub(crate) mod heap;
pub(crate) mod pin_limit;
pub(crate) mod retention;
pub(crate) mod retire_list;
pub(crate) mod segments;
pub(crate) mod slots;
