//! Blocks that a ring keeps for its next samples of up to 4 KiB, so that a publisher in steady state allocates
//! nothing. Plain data, no shared memory.

use std::collections::BTreeMap;

use crate::{alloc::heap::Block, ring::layout::Location};

/// What a ring keeps for lengths that it seems not to need any more, in bytes.
const MAX_IDLE_BYTES: u64 = 64 << 10;

/// Blocks by their length, those that were used last to be used next.
#[derive(Debug, Default)]
pub(crate) struct Blocks {
    free: BTreeMap<u64, Vec<Location>>,
    bytes: u64,
}

impl Blocks {
    /// One of `len` bytes.
    pub(crate) fn take(&mut self, len: u64) -> Option<Block> {
        let at = self.free.get_mut(&len)?.pop()?;
        self.bytes -= len;
        Some(Block { at, len })
    }

    /// Nobody counts on what is in it any more.
    pub(crate) fn put(&mut self, block: Block) {
        self.free.entry(block.len).or_default().push(block.at);
        self.bytes += block.len;
    }

    /// Whether so much is here that it should go back before more is asked for.
    pub(crate) fn are_many(&self) -> bool {
        self.bytes > MAX_IDLE_BYTES
    }

    /// Gives all of them away.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = Block> + use<> {
        self.bytes = 0;
        std::mem::take(&mut self.free)
            .into_iter()
            .flat_map(|(len, all)| all.into_iter().map(move |at| Block { at, len }))
    }
}
