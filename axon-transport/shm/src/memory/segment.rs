//! Sealed memfds and the maps over them: the only place that maps memory.

#![allow(unsafe_code)]

use std::{
    ffi::c_void,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    ptr::{self, NonNull},
    slice,
    sync::{Arc, atomic::AtomicU64},
};

use rustix::{
    fs::{
        FallocateFlags, MemfdFlags, SealFlags, fallocate, fcntl_add_seals, fcntl_get_seals, fstat,
        fstatfs, ftruncate, memfd_create,
    },
    io::Errno,
    mm::{Advice, MapFlags, MprotectFlags, ProtFlags, madvise, mmap, mprotect, munlock, munmap},
};

use crate::{
    error::ShmError,
    limits::{ALIGN, MAX_SEGMENT},
    memory::{
        available,
        quota::{Quota, Share},
    },
    os::{atfork::KeptAddress, fork::ForkToken},
};

/// Bytes that one system call commits.
const PIECE: u64 = 1 << 20;

/// The seals of a segment. No process can remove them: the file keeps its size, and only existing maps can write to it.
fn seals() -> SealFlags {
    SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL
}

/// The purpose of an ftruncate, for errors. A limit on the size of files can make it fail.
pub(super) const SIZING: &str = "sizing a memfd, whose length `ulimit -f` must allow";

/// Memory that only this process writes. It is sparse until [`OwnMapping::commit`].
pub(crate) struct OwnMapping {
    fd: OwnedFd,
    map: Arc<Map>,
}

impl OwnMapping {
    /// Creates a sealed memfd of `len` bytes, a multiple of [`ALIGN`].
    pub(crate) fn create(name: &str, len: u64) -> Result<Self, ShmError> {
        debug_assert!(len.is_multiple_of(ALIGN));
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let fd = match memfd_create(name, flags | MemfdFlags::NOEXEC_SEAL) {
            // Kernels before 6.3 do not know the flag.
            Err(Errno::INVAL) => memfd_create(name, flags),
            other => other,
        }
        .map_err(ShmError::system("creating a memfd"))?;
        ftruncate(&fd, len).map_err(ShmError::system(SIZING))?;
        // FUTURE_WRITE forbids later writable maps, so this process's map is made first.
        let map = Map::new(fd.as_fd(), len, Access::Write)?;
        fcntl_add_seals(&fd, seals()).map_err(ShmError::system("sealing a memfd"))?;
        Ok(Self { fd, map: Arc::new(map) })
    }

    /// Backs the range with memory. An access then neither faults nor gets the process killed for exceeding its control
    /// group's limit.
    pub(crate) fn commit(&self, from: u64, to: u64) -> Result<(), ShmError> {
        available::check(to - from)?;
        // In pieces, because older kernels undo a whole call on any signal. A frequent signal could otherwise keep a
        // large call from ever succeeding.
        let mut done = from;
        while done < to {
            let len = (to - done).min(PIECE);
            match fallocate(&self.fd, FallocateFlags::empty(), done, len) {
                Ok(()) => done += len,
                Err(Errno::INTR) => {}
                Err(Errno::NOSPC | Errno::NOMEM) => {
                    let available = available::bytes().unwrap_or(0);
                    return Err(ShmError::NoMemory { needed: to - done, available });
                }
                Err(errno) => return Err(ShmError::system("committing shared memory")(errno)),
            }
        }
        Ok(())
    }

    /// Prepares committed memory for writing, so that the first write to each page does not fault.
    pub(crate) fn touch(&self, from: u64, to: u64) {
        let len = usize::try_from(to - from).expect("a segment is mapped whole");
        let start = self.address(from, len);
        // Kernels before 5.14 do not know the advice; then each page faults at its first access.
        // SAFETY: the range is inside the mapping, as was just checked, and belongs to this process. The advice does
        // not change its content.
        let _ = unsafe { madvise(start.as_ptr().cast(), len, Advice::LinuxPopulateWrite) };
    }

    /// Returns the address of `len` bytes at `at`, for writes that are not in words.
    #[inline]
    pub(crate) fn address(&self, at: u64, len: usize) -> NonNull<u8> {
        let at = usize::try_from(at).expect("a segment is mapped whole");
        assert!(at.checked_add(len).is_some_and(|end| end <= self.map.bytes));
        // SAFETY: the address is inside the mapping, as was just checked.
        unsafe { self.map.base.cast::<u8>().add(at) }
    }

    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        self.map.words()
    }

    #[inline]
    pub(crate) fn is_forked(&self) -> bool {
        self.map.is_forked()
    }

    #[inline]
    pub(crate) fn fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }

    #[inline]
    pub(crate) fn map(&self) -> &Arc<Map> {
        &self.map
    }

    #[inline]
    pub(crate) fn bytes(&self) -> u64 {
        self.map.bytes as u64
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Access {
    Read,
    Write,
}

/// A mapped segment, as words that other processes may read or write at any time.
pub(crate) struct Map {
    base: NonNull<c_void>,
    bytes: usize,
    owner: ForkToken,
    /// Set for a writable map.
    place: Option<KeptAddress>,
    /// Set for another session's memory.
    share: Option<Share>,
}

/// The type that `fstatfs` returns for an ordinary memfd (linux/magic.h).
const TMPFS_MAGIC: i64 = 0x0102_1994;

// SAFETY: `base` points to plain memory, and it can be unmapped from any thread. The other fields are `Send`.
unsafe impl Send for Map {}
// SAFETY: all access is atomic, except to bytes whose address an `OwnMapping` returns. The caller that asks for the
// address is responsible for those: lent bytes belong to one loan alone.
unsafe impl Sync for Map {}

impl Map {
    /// Maps another process's segment read-only, after a check of its seals and its size. The segment can then never
    /// shrink under the map, which would turn a read into a SIGBUS. The map counts towards `quota` as long as it
    /// exists.
    pub(crate) fn open(fd: BorrowedFd<'_>, quota: &Arc<Quota>) -> Result<Self, ShmError> {
        // The call fails on anything but a memfd or a file of a tmpfs.
        let found =
            fcntl_get_seals(fd).map_err(|_| ShmError::Refused { what: "it is not a memfd" })?;
        if !found.contains(seals()) {
            return Err(ShmError::Refused { what: "its seals are missing" });
        }
        // Memory of huge pages can have the same seals, and still be missing at the first access.
        let system = fstatfs(fd).map_err(ShmError::system("sizing up a segment"))?;
        if system.f_type != TMPFS_MAGIC {
            return Err(ShmError::Refused { what: "it is not ordinary memory" });
        }
        let len = fstat(fd).map_err(ShmError::system("sizing up a segment"))?.st_size;
        let len = u64::try_from(len).unwrap_or(0);
        if !(ALIGN..=MAX_SEGMENT).contains(&len) || !len.is_multiple_of(ALIGN) {
            return Err(ShmError::Refused { what: "its size is not a segment's" });
        }
        let share = quota.take(len)?;
        let mut map = Self::new(fd, len, Access::Read)?;
        map.share = Some(share);
        Ok(map)
    }

    fn new(fd: BorrowedFd<'_>, len: u64, access: Access) -> Result<Self, ShmError> {
        let owner = ForkToken::current()?;
        let bytes = usize::try_from(len)
            .map_err(|_| ShmError::Refused { what: "it is larger than memory" })?;
        // Without access first: in a process that called mlockall, mapping a sparse segment readable would allocate all
        // of it.
        // SAFETY: a fresh mapping at an address of the kernel's choice aliases nothing.
        let base = unsafe {
            mmap(
                ptr::null_mut(),
                bytes,
                ProtFlags::empty(),
                MapFlags::SHARED | MapFlags::NORESERVE,
                fd,
                0,
            )
        }
        .map_err(ShmError::system("mapping a segment"))?;
        let base = NonNull::new(base)
            .ok_or(ShmError::Refused { what: "it was mapped at address zero" })?;
        // From here on, dropping the map unmaps it.
        let mut map = Self { base, bytes, owner, place: None, share: None };
        // SAFETY: the range is the mapping just made; locking has no effect on its contents.
        unsafe { munlock(base.as_ptr(), bytes) }
            .map_err(ShmError::system("unlocking a segment"))?;
        // SAFETY: as above; nothing in it has been accessed or borrowed yet.
        let _ = unsafe { madvise(base.as_ptr(), bytes, Advice::LinuxDontDump) };
        if access == Access::Write {
            // A child that could write would be a second writer of our words.
            // SAFETY: as above; a child does not access the map (see `is_forked`).
            unsafe { madvise(base.as_ptr(), bytes, Advice::LinuxDontFork) }
                .map_err(ShmError::system("keeping a segment from forks"))?;
            map.place = Some(KeptAddress::keep(base, bytes)?);
        }
        let protection = match access {
            Access::Read => MprotectFlags::READ,
            Access::Write => MprotectFlags::READ | MprotectFlags::WRITE,
        };
        // SAFETY: the range is the mapping just made; nothing in it is borrowed.
        unsafe { mprotect(base.as_ptr(), bytes, protection) }
            .map_err(ShmError::system("opening a segment to access"))?;
        Ok(map)
    }

    /// Returns the segment's words. The words of another session's segment must only be loaded, relaxed or acquire:
    /// that map is read-only.
    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        // SAFETY: the range is page-aligned, `bytes` long and mapped readable as long as `self` lives, and the seals
        // keep the file at least that long. Every bit pattern is a valid word. The words are atomic, so other writers
        // are permitted. Small relaxed and acquire loads are defined on read-only memory.
        unsafe { slice::from_raw_parts(self.base.as_ptr().cast::<AtomicU64>(), self.bytes / 8) }
    }

    #[inline]
    pub(crate) fn is_forked(&self) -> bool {
        self.owner.is_forked()
    }
}

impl Drop for Map {
    fn drop(&mut self) {
        // Before the memory is unmapped: a child must not keep the address of a map that no longer exists.
        drop(self.place.take());
        // A forked child has no writable map, and the pages that keep its address stay.
        if !self.is_forked() {
            // SAFETY: the range belongs to this map, and no borrow of it outlives `self`.
            let _ = unsafe { munmap(self.base.as_ptr(), self.bytes) };
        }
    }
}
