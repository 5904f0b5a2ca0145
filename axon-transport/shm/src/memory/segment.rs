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

/// Bytes that are committed at a time.
const PIECE: u64 = 1 << 20;

/// What no process can undo: the file keeps its size, and only maps made before can write to it.
fn seals() -> SealFlags {
    SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL
}

/// The step that a limit on the length of files forbids.
pub(super) const SIZING: &str = "sizing a memfd, whose length `ulimit -f` must allow";

/// Memory that this process alone writes, sparse until [`OwnMapping::commit`].
pub(crate) struct OwnMapping {
    fd: OwnedFd,
    map: Arc<Map>,
}

impl OwnMapping {
    /// A new sealed memfd of `len` bytes, a multiple of [`ALIGN`].
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
        // FUTURE_WRITE forbids writable maps from then on, so ours is made first.
        let map = Map::new(fd.as_fd(), len, Access::Write)?;
        fcntl_add_seals(&fd, seals()).map_err(ShmError::system("sealing a memfd"))?;
        Ok(Self { fd, map: Arc::new(map) })
    }

    /// Backs `range` with memory, so that touching it can neither fault nor get the process
    /// killed for exceeding its control group's limit.
    pub(crate) fn commit(&self, from: u64, to: u64) -> Result<(), ShmError> {
        available::check(to - from)?;
        // In pieces, since older kernels undo a whole call on any signal: one that comes often
        // could otherwise keep a large one from ever getting through.
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

    /// Makes ready to be written what has been committed, so that writing it for the first time
    /// costs no fault a page.
    pub(crate) fn touch(&self, from: u64, to: u64) {
        let len = usize::try_from(to - from).expect("a segment is mapped whole");
        let start = self.address(from, len);
        // Kernels before 5.14 do not know the advice; then each page is touched in its turn.
        // SAFETY: inside the mapping, as was just checked, which is ours to write; what is in it
        // stays as it is.
        let _ = unsafe { madvise(start.as_ptr().cast(), len, Advice::LinuxPopulateWrite) };
    }

    /// The address of `len` bytes at `at`, to be written otherwise than by words.
    #[inline]
    pub(crate) fn address(&self, at: u64, len: usize) -> NonNull<u8> {
        let at = usize::try_from(at).expect("a segment is mapped whole");
        assert!(at.checked_add(len).is_some_and(|end| end <= self.map.bytes));
        // SAFETY: inside the mapping, as was just checked.
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
    /// Of a writable map.
    place: Option<KeptAddress>,
    /// Of another session's memory.
    share: Option<Share>,
}

/// What `fstatfs` says of an ordinary memfd (linux/magic.h).
const TMPFS_MAGIC: i64 = 0x0102_1994;

// SAFETY: what `base` points to is plain memory, and unmapping it works from any thread. The other fields
// may go anywhere by themselves.
unsafe impl Send for Map {}
// SAFETY: as above: all access is atomic, but for bytes whose address an `OwnMapping` gives away, and the
// caller that asks for it answers for that (what is lent is one loan's alone).
unsafe impl Sync for Map {}

impl Map {
    /// Maps another process's segment read-only once its seals and its size hold: it can then
    /// never shrink under the map, which would turn a read into a SIGBUS. For as long as it is
    /// mapped it counts towards `quota`.
    pub(crate) fn open(fd: BorrowedFd<'_>, quota: &Arc<Quota>) -> Result<Self, ShmError> {
        // The call fails on anything but a memfd or a file of a tmpfs; what may not shrink is sealed so.
        let found =
            fcntl_get_seals(fd).map_err(|_| ShmError::Refused { what: "it is not a memfd" })?;
        if !found.contains(seals()) {
            return Err(ShmError::Refused { what: "its seals are missing" });
        }
        // Huge pages can be sealed just so, and still be missing at the first access.
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
        // Without access first: in a process that called mlockall, mapping a sparse segment
        // readable would allocate all of it.
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
        // From here on dropping it unmaps.
        let mut map = Self { base, bytes, owner, place: None, share: None };
        // SAFETY: the range is the mapping just made; locking has no effect on its contents.
        unsafe { munlock(base.as_ptr(), bytes) }
            .map_err(ShmError::system("unlocking a segment"))?;
        // SAFETY: as above; nothing of it has been touched or borrowed yet.
        let _ = unsafe { madvise(base.as_ptr(), bytes, Advice::LinuxDontDump) };
        if access == Access::Write {
            // A child that could write would be a second writer of our words.
            // SAFETY: as above; the map is not reached in a child (see `is_forked`).
            unsafe { madvise(base.as_ptr(), bytes, Advice::LinuxDontFork) }
                .map_err(ShmError::system("keeping a segment from forks"))?;
            map.place = Some(KeptAddress::keep(base, bytes)?);
        }
        let protection = match access {
            Access::Read => MprotectFlags::READ,
            Access::Write => MprotectFlags::READ | MprotectFlags::WRITE,
        };
        // SAFETY: the range is the mapping just made, nothing of it is borrowed.
        unsafe { mprotect(base.as_ptr(), bytes, protection) }
            .map_err(ShmError::system("opening a segment to access"))?;
        Ok(map)
    }

    /// The segment's words. Those of another session's segment must only be loaded, relaxed or
    /// acquire: the map is read-only.
    #[inline]
    pub(crate) fn words(&self) -> &[AtomicU64] {
        // SAFETY: page-aligned, `bytes` long and mapped readable for as long as `self` lives; the
        // seals keep the file at least that long. Every bit pattern is a valid word, and other
        // writers are allowed for by the words being atomic. Small relaxed and acquire loads are
        // defined on read-only memory.
        unsafe { slice::from_raw_parts(self.base.as_ptr().cast::<AtomicU64>(), self.bytes / 8) }
    }

    #[inline]
    pub(crate) fn is_forked(&self) -> bool {
        self.owner.is_forked()
    }
}

impl Drop for Map {
    fn drop(&mut self) {
        // Before the memory goes: its place must not be kept in a child that it is no longer in.
        drop(self.place.take());
        // In a forked child a writable map is absent, and what keeps its place stays there.
        if !self.is_forked() {
            // SAFETY: the range is ours, and no borrow of it outlives `self`.
            let _ = unsafe { munmap(self.base.as_ptr(), self.bytes) };
        }
    }
}
