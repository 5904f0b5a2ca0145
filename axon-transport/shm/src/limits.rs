//! Sizes and limits for the whole crate.

/// Granularity of segments in bytes: segment sizes are multiples of it, and memory is committed in
/// units of it.
pub(super) const ALIGN: u64 = 64 << 10;
/// Alignment of objects in bytes. An object occupies whole lines, so that no two processes write to
/// the same line and the prefetcher, which fetches pairs of 64-byte lines, does not fetch two
/// objects at once.
pub(super) const LINE: u64 = 128;
/// The largest message in bytes: its length has 32 bits, rounded down to whole lines.
pub(super) const MAX_MESSAGE: u64 = u32::MAX as u64 & !(LINE - 1);
/// The most address space of one segment, in bytes.
pub(super) const MAX_SEGMENT: u64 = 64 << 30;
/// The largest history budget of a ring, in bytes: up to four times this is mapped.
pub(super) const MAX_BUDGET: u64 = MAX_SEGMENT / 4;
