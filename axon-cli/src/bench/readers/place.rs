//! The memory that the raw limit of a publish shares with its readers.

use std::{
    os::fd::OwnedFd,
    sync::atomic::{AtomicU32, AtomicU64},
};

use super::super::harness::{Result, SharedPages};

/// The number of readers that have their own words.
pub(super) const READERS_AT_MOST: usize = 16;
/// The distance in bytes between two words that must share neither a cache line nor a pair of lines
/// that are fetched together.
const APART: usize = 256;
const MESSAGE: usize = 0;
const TOLD: usize = APART;
const READ: usize = 2 * APART;
const PAYLOAD: usize = 8192;

pub(super) struct ReadersMemory(SharedPages);

impl ReadersMemory {
    /// Creates memory for messages of `size` bytes. Returns it with the descriptor by which readers
    /// map it.
    pub(super) fn create(size: usize) -> Result<(Self, OwnedFd)> {
        let (memory, fd) = SharedPages::create(PAYLOAD + size)?;
        Ok((Self(memory), fd))
    }

    pub(super) fn map(fd: &OwnedFd, size: usize) -> Result<Self> {
        Ok(Self(SharedPages::map(fd, PAYLOAD + size)?))
    }

    /// Returns the futex with the number of the raw limit's last message.
    pub(super) fn message(&self) -> &AtomicU32 {
        self.0.half(MESSAGE)
    }

    /// Returns the futex with the number of the last message that was announced to readers.
    pub(super) fn told(&self) -> &AtomicU32 {
        self.0.half(TOLD)
    }

    /// Returns the word with the number of the last message that this reader has copied out.
    pub(super) fn read_by(&self, reader: usize) -> &AtomicU32 {
        self.0.half(READ + reader * APART)
    }

    /// Returns the word with the time at which this reader copied the last message out.
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
