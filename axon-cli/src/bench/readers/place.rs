//! The memory that a publish by the raw limit and its readers share.

use std::{
    os::fd::OwnedFd,
    sync::atomic::{AtomicU32, AtomicU64},
};

use super::super::harness::{Result, SharedPages};

/// Readers of which each has words of its own.
pub(super) const READERS_AT_MOST: usize = 16;
/// Bytes between two words that must not share a line, or two lines that are fetched together.
const APART: usize = 256;
const MESSAGE: usize = 0;
const TOLD: usize = APART;
const READ: usize = 2 * APART;
const PAYLOAD: usize = 8192;

pub(super) struct ReadersMemory(SharedPages);

impl ReadersMemory {
    /// New, for messages of `size` bytes, and the descriptor by which readers map it.
    pub(super) fn create(size: usize) -> Result<(Self, OwnedFd)> {
        let (memory, fd) = SharedPages::create(PAYLOAD + size)?;
        Ok((Self(memory), fd))
    }

    pub(super) fn map(fd: &OwnedFd, size: usize) -> Result<Self> {
        Ok(Self(SharedPages::map(fd, PAYLOAD + size)?))
    }

    /// The number of the raw limit's last message, a futex.
    pub(super) fn message(&self) -> &AtomicU32 {
        self.0.half(MESSAGE)
    }

    /// The number of the last message of which readers were told, a futex.
    pub(super) fn told(&self) -> &AtomicU32 {
        self.0.half(TOLD)
    }

    /// The number of the last message that this reader has copied out.
    pub(super) fn read_by(&self, reader: usize) -> &AtomicU32 {
        self.0.half(READ + reader * APART)
    }

    /// When that was.
    pub(super) fn read_at(&self, reader: usize) -> &AtomicU64 {
        self.0.word(READ + reader * APART + 8)
    }

    pub(super) fn copy_in(&self, bytes: &[u8]) {
        self.0.copy_in(PAYLOAD, bytes);
    }

    pub(super) fn copy_out(&self, bytes: &mut [u8]) {
        self.0.copy_out(PAYLOAD, bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_all_readers_end_before_the_payload() {
        const { assert!(READ + READERS_AT_MOST * APART <= PAYLOAD) };
    }
}
