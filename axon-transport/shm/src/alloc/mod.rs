//! A session's memory as its own process gives it out: segments, objects, slots for large samples, and who
//! may keep how much.

pub(crate) mod area;
pub(crate) mod blocks;
pub(crate) mod classes;
pub(crate) mod heap;
pub(crate) mod pin_limit;
pub(crate) mod retention;
pub(crate) mod retire_list;
pub(crate) mod segments;
pub(crate) mod slots;
