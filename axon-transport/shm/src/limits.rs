//! Sizes and limits for the whole crate.

/// Segments are multiples of this many bytes, and memory is committed in them.
pub(super) const ALIGN: u64 = 64 << 10;
/// Objects are whole lines: no two processes write to one, nor does a processor fetch two at once.
pub(super) const LINE: u64 = 128;
/// The largest message in bytes: its length has 32 bits, rounded down to whole lines.
pub(super) const MAX_MESSAGE: u64 = u32::MAX as u64 & !(LINE - 1);
/// The most address space that one segment may take, in bytes.
pub(super) const MAX_SEGMENT: u64 = 64 << 30;
/// The most history that a ring may be asked to keep, in bytes: up to four times this is mapped.
pub(super) const MAX_BUDGET: u64 = MAX_SEGMENT / 4;
