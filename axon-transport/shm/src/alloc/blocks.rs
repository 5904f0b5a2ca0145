//! Blocks that a ring keeps for its next samples of up to 4 KiB, so that a publisher in steady state allocates
//! nothing. Plain data, no shared memory.

use std::collections::BTreeMap;

use crate::{alloc::heap::Block, ring::layout::Location};

/// Maximum number of free bytes that a ring keeps; more are given back before the ring allocates a block of a length
/// for which it has none.
const MAX_IDLE_BYTES: u64 = 64 << 10;

/// Free blocks by length. The block that was freed last is reused first.
#[derive(Debug, Default)]
pub(crate) struct Blocks {
    free: BTreeMap<u64, Vec<Location>>,
    bytes: u64,
}

impl Blocks {
    /// Returns a block of `len` bytes.
    pub(crate) fn take(&mut self, len: u64) -> Option<Block> {
        let at = self.free.get_mut(&len)?.pop()?;
        self.bytes -= len;
        Some(Block { at, len })
    }

    /// Keeps a block for reuse. No reader counts on its content any more.
    pub(crate) fn put(&mut self, block: Block) {
        self.free.entry(block.len).or_default().push(block.at);
        self.bytes += block.len;
    }

    /// Returns whether the free blocks should be given back before more memory is requested.
    pub(crate) fn are_many(&self) -> bool {
        self.bytes > MAX_IDLE_BYTES
    }

    /// Removes and returns all free blocks.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = Block> + use<> {
        self.bytes = 0;
        std::mem::take(&mut self.free)
            .into_iter()
            .flat_map(|(len, all)| all.into_iter().map(move |at| Block { at, len }))
    }
}
