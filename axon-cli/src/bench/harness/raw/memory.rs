//! Memory that two processes share, as bare as it gets.
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

/// A map that both processes may write.
///
/// Words are atomic. Bytes are plain: who copies them has to know from a word that the other
/// process does not touch them meanwhile.
pub(crate) struct SharedPages {
    base: NonNull<c_void>,
    len: usize,
}

impl SharedPages {
    /// New memory of `len` bytes, and the descriptor by which the other process maps it.
    pub(crate) fn create(len: usize) -> Result<(Self, OwnedFd)> {
        let fd = memfd_create("bench-raw", MemfdFlags::CLOEXEC)?;
        ftruncate(&fd, len as u64)?;
        Ok((Self::map(&fd, len)?, fd))
    }

    /// Maps what the other process made.
    pub(crate) fn map(fd: impl AsFd, len: usize) -> Result<Self> {
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a fresh mapping at an address of the kernel's choice aliases nothing.
        let base = unsafe { mmap(ptr::null_mut(), len, access, MapFlags::SHARED, fd, 0) }?;
        Ok(Self { base: NonNull::new(base).ok_or("memory was mapped at address zero")?, len })
    }

    /// The word at byte `at`, a multiple of eight.
    #[inline]
    pub(crate) fn word(&self, at: usize) -> &AtomicU64 {
        assert!(at.is_multiple_of(8) && at + 8 <= self.len);
        // SAFETY: inside the mapping, which starts at a page, and aligned, as was just checked.
        let word = unsafe { self.base.cast::<u8>().add(at) }.cast::<AtomicU64>();
        // SAFETY: it lives as long as the mapping, every bit pattern is a valid word, and that the
        // other process writes it too is what an atomic word is for.
        unsafe { word.as_ref() }
    }

    /// The four bytes at byte `at`, a multiple of four: what a futex can be.
    #[inline]
    pub(crate) fn half(&self, at: usize) -> &AtomicU32 {
        assert!(at.is_multiple_of(4) && at + 4 <= self.len);
        // SAFETY: inside the mapping, which starts at a page, and aligned, as was just checked.
        let word = unsafe { self.base.cast::<u8>().add(at) }.cast::<AtomicU32>();
        // SAFETY: as in `word`.
        unsafe { word.as_ref() }
    }

    /// Copies `bytes` to `at`.
    #[inline]
    pub(crate) fn copy_in(&self, at: usize, bytes: &[u8]) {
        let to = self.bytes(at, bytes.len());
        // SAFETY: as many bytes of the mapping, which no reference points to, so nothing overlaps.
        unsafe { to.copy_from_nonoverlapping(NonNull::from(bytes).cast(), bytes.len()) };
    }

    /// Fills `bytes` from `at`.
    #[inline]
    pub(crate) fn copy_out(&self, at: usize, bytes: &mut [u8]) {
        let from = self.bytes(at, bytes.len());
        // SAFETY: as in `copy_in`, the other way round.
        unsafe { from.copy_to_nonoverlapping(NonNull::from(&mut *bytes).cast(), bytes.len()) };
    }

    fn bytes(&self, at: usize, len: usize) -> NonNull<u8> {
        assert!(at.checked_add(len).is_some_and(|end| end <= self.len));
        // SAFETY: inside the mapping, as was just checked.
        unsafe { self.base.cast::<u8>().add(at) }
    }
}

impl Drop for SharedPages {
    fn drop(&mut self) {
        // SAFETY: the range is the mapping, and no borrow of it outlives `self`.
        let _ = unsafe { munmap(self.base.as_ptr(), self.len) };
    }
}
