//! Memory that two processes share, without any protocol.
#![allow(unsafe_code)]

use std::{
    ffi::c_void,
    os::fd::{AsFd, OwnedFd},
    ptr::{self, NonNull},
    sync::atomic::{AtomicU32, AtomicU64},
};

use rustix::{
    fs::{MemfdFlags, ftruncate, memfd_create},
    mm::{MapFlags, ProtFlags, mmap, munmap},
};

use super::super::Result;

/// A mapping that both processes may write.
///
/// Words are atomic. Bytes are not: before a process copies bytes, a word must have told it that
/// the other process does not access them at the same time.
pub(crate) struct SharedPages {
    base: NonNull<c_void>,
    len: usize,
}

impl SharedPages {
    /// Creates memory of `len` bytes. Returns it with the descriptor by which the other process
    /// maps it.
    pub(crate) fn create(len: usize) -> Result<(Self, OwnedFd)> {
        let fd = memfd_create("bench-raw", MemfdFlags::CLOEXEC)?;
        ftruncate(&fd, len as u64)?;
        Ok((Self::map(&fd, len)?, fd))
    }

    /// Maps memory that the other process created.
    pub(crate) fn map(fd: impl AsFd, len: usize) -> Result<Self> {
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a new mapping at an address that the kernel chooses aliases nothing.
        let base = unsafe { mmap(ptr::null_mut(), len, access, MapFlags::SHARED, fd, 0) }?;
        Ok(Self { base: NonNull::new(base).ok_or("memory was mapped at address zero")?, len })
    }

    /// Returns the word at byte `at`, which must be a multiple of eight.
    #[inline]
    pub(crate) fn word(&self, at: usize) -> &AtomicU64 {
        assert!(at.is_multiple_of(8) && at + 8 <= self.len);
        // SAFETY: the word is inside the mapping, which starts at a page boundary, and it is
        // aligned; both were checked above.
        let word = unsafe { self.base.cast::<u8>().add(at) }.cast::<AtomicU64>();
        // SAFETY: the word lives as long as the mapping, every bit pattern is a valid word, and an
        // atomic word may be written by the other process as well.
        unsafe { word.as_ref() }
    }

    /// Returns the four bytes at byte `at`, which must be a multiple of four. A futex needs four
    /// bytes.
    #[inline]
    pub(crate) fn half(&self, at: usize) -> &AtomicU32 {
        assert!(at.is_multiple_of(4) && at + 4 <= self.len);
        // SAFETY: the word is inside the mapping, which starts at a page boundary, and it is
        // aligned; both were checked above.
        let word = unsafe { self.base.cast::<u8>().add(at) }.cast::<AtomicU32>();
        // SAFETY: the reasons are those in `word`.
        unsafe { word.as_ref() }
    }

    /// Copies `bytes` to `at`.
    #[inline]
    pub(crate) fn copy_in(&self, at: usize, bytes: &[u8]) {
        let to = self.bytes(at, bytes.len());
        // SAFETY: the mapping has this many bytes at `to`. No reference points to them, so nothing
        // overlaps.
        unsafe { to.copy_from_nonoverlapping(NonNull::from(bytes).cast(), bytes.len()) };
    }

    /// Fills `bytes` from `at`.
    #[inline]
    pub(crate) fn copy_out(&self, at: usize, bytes: &mut [u8]) {
        let from = self.bytes(at, bytes.len());
        // SAFETY: the reasons are those in `copy_in`, with source and destination exchanged.
        unsafe { from.copy_to_nonoverlapping(NonNull::from(&mut *bytes).cast(), bytes.len()) };
    }

    fn bytes(&self, at: usize, len: usize) -> NonNull<u8> {
        assert!(at.checked_add(len).is_some_and(|end| end <= self.len));
        // SAFETY: the address is inside the mapping, as was checked above.
        unsafe { self.base.cast::<u8>().add(at) }
    }
}

impl Drop for SharedPages {
    fn drop(&mut self) {
        // SAFETY: the range is the mapping, and no borrow of it outlives `self`.
        let _ = unsafe { munmap(self.base.as_ptr(), self.len) };
    }
}
