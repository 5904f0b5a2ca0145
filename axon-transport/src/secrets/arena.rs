//! Keys in memory that is not swapped out, not part of a core file, and empty in a forked child.

// Mapped memory has no safe interface.
#![allow(unsafe_code)]

use std::{
    io,
    panic::{RefUnwindSafe, UnwindSafe},
    ptr::{self, NonNull},
    sync::{Mutex, MutexGuard, Once, PoisonError},
};

use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mlock, mmap_anonymous};
use zeroize::Zeroize;

/// Bytes that are mapped at a time: 512 keys.
const CHUNK: usize = 16 << 10;

type Slot = [u8; 32];

/// Slots in chunks that stay mapped until the process ends.
struct Arena {
    free: Vec<NonNull<Slot>>,
    /// Those in use as well.
    slots: usize,
}

// SAFETY: a slot in the list is memory that nobody else refers to, and is the process's, not a
// thread's.
unsafe impl Send for Arena {}

static ARENA: Mutex<Arena> = Mutex::new(Arena { free: Vec::new(), slots: 0 });

fn arena() -> MutexGuard<'static, Arena> {
    // Each operation leaves the list whole, so what a panicking thread held is sound.
    ARENA.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A key in locked memory, erased on drop. Neither `Clone` nor `Debug`.
pub(crate) struct LockedKey(NonNull<Slot>);

impl UnwindSafe for LockedKey {}
impl RefUnwindSafe for LockedKey {}

// SAFETY: it is the only reference to its slot, and gives out shared references alone.
unsafe impl Send for LockedKey {}
// SAFETY: as above.
unsafe impl Sync for LockedKey {}

/// Maps the first chunk, so that a system that locks no memory is warned about at once.
///
/// # Errors
/// The system gives no memory.
pub(crate) fn prepare() -> io::Result<()> {
    let mut arena = arena();
    if arena.slots == 0 { arena.grow() } else { Ok(()) }
}

impl LockedKey {
    /// Copies a key; erasing `key` stays with the caller.
    ///
    /// # Errors
    /// The system gives no memory.
    pub(crate) fn copy_of(key: &[u8; 32]) -> io::Result<Self> {
        let mut arena = arena();
        let slot = loop {
            match arena.free.pop() {
                Some(slot) => break slot,
                None => arena.grow()?,
            }
        };
        // Straight from there to here: a value in between would be left on the stack.
        // SAFETY: a slot out of the list is mapped, writable, and nobody else's.
        unsafe { slot.copy_from_nonoverlapping(NonNull::from(key), 1) };
        Ok(Self(slot))
    }
}

impl AsRef<[u8; 32]> for LockedKey {
    fn as_ref(&self) -> &[u8; 32] {
        // SAFETY: the slot is mapped as long as the process lives, was written by `copy_of`, and
        // changes only in `drop`.
        unsafe { self.0.as_ref() }
    }
}

impl Drop for LockedKey {
    fn drop(&mut self) {
        // SAFETY: as in `as_ref`; that nobody else refers to the slot is what `&mut self` says.
        unsafe { self.0.as_mut() }.zeroize();
        // There is room for every slot, so that this allocates nothing.
        arena().free.push(self.0);
    }
}

impl Arena {
    fn grow(&mut self) -> io::Result<()> {
        let (access, private) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::PRIVATE);
        // SAFETY: a new mapping, wherever the system puts it, that replaces none.
        let chunk = unsafe { mmap_anonymous(ptr::null_mut(), CHUNK, access, private) }?;
        // SAFETY: the mapping just made, of that length.
        let locked = unsafe { mlock(chunk, CHUNK) };
        // SAFETY: as above. What is left out of core files is not changed.
        let kept_out = unsafe { madvise(chunk, CHUNK, Advice::LinuxDontDump) };
        // SAFETY: as above. A forked child finds zeros where this process has keys, and uses none.
        let wiped = unsafe { madvise(chunk, CHUNK, Advice::LinuxWipeOnFork) };
        warn(locked, kept_out.and(wiped));
        let first = NonNull::new(chunk.cast::<Slot>()).ok_or(io::ErrorKind::OutOfMemory)?;
        let fresh = CHUNK / size_of::<Slot>();
        self.slots += fresh;
        self.free.reserve(self.slots - self.free.len());
        for at in 0..fresh {
            // SAFETY: within the mapping, whose start is aligned to a page.
            self.free.push(unsafe { first.add(at) });
        }
        Ok(())
    }
}

/// Says once what the system does not do for keys, and what to do about it.
fn warn(locked: rustix::io::Result<()>, advised: rustix::io::Result<()>) {
    static LOCKED: Once = Once::new();
    static ADVISED: Once = Once::new();
    if let Err(error) = locked {
        LOCKED.call_once(|| {
            tracing::warn!(
                %error,
                "could not lock the memory of keys (mlock): they may be written to swap space; raise \
                 RLIMIT_MEMLOCK to 1 MiB or more (LimitMEMLOCK= of a systemd unit, `ulimit -l`, \
                 memlock in limits.conf), or turn swap off"
            );
        });
    }
    if let Err(error) = advised {
        ADVISED.call_once(|| {
            tracing::warn!(
                %error,
                "could not keep the memory of keys out of core files and forked processes (madvise): \
                 a kernel from 4.14 on does"
            );
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The flags of the mapping with this address, as the kernel tells them.
    fn flags(address: usize) -> Vec<String> {
        let smaps = std::fs::read_to_string("/proc/self/smaps").unwrap();
        let mut within = false;
        for line in smaps.lines() {
            let range = line.split_once(' ').and_then(|(range, _)| range.split_once('-'));
            let range = range.map(|(a, b)| [a, b].map(|text| usize::from_str_radix(text, 16)));
            if let Some([Ok(start), Ok(end)]) = range {
                within = (start..end).contains(&address);
            } else if let Some(flags) = line.strip_prefix("VmFlags:").filter(|_| within) {
                return flags.split_whitespace().map(str::to_owned).collect();
            }
        }
        panic!("no mapping has {address:#x}");
    }

    #[test]
    fn keys_are_in_locked_memory_and_erased_on_drop() {
        let keys: Vec<_> =
            (0..2000_u32).map(|at| LockedKey::copy_of(&[at as u8 | 1; 32]).unwrap()).collect();
        for (at, key) in (0_u32..).zip(&keys) {
            assert_eq!(*key.as_ref(), [at as u8 | 1; 32]);
        }
        for key in keys.iter().step_by(500) {
            let flags = flags(key.0.as_ptr().addr());
            for flag in ["lo", "dd", "wf"] {
                assert!(flags.iter().any(|f| f == flag), "{flag} is not among {flags:?}");
            }
        }
        let slots: Vec<_> = keys.iter().map(|key| key.0).collect();
        drop(keys);
        // Under the lock, so that no other test's key takes one of them.
        let arena = arena();
        for slot in slots.iter().filter(|slot| arena.free.contains(slot)) {
            // SAFETY: mapped for good, and nobody's as long as the lock is held.
            assert_eq!(unsafe { slot.read() }, [0; 32]);
        }
    }

    #[test]
    fn a_forked_child_finds_no_key() {
        let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
        let slot = key.0;
        // SAFETY: the child reads mapped memory and ends, without a lock or an allocation.
        let child = unsafe { libc::fork() };
        if child == 0 {
            // SAFETY: mapped in the child as well.
            let is_empty = unsafe { slot.read() } == [0; 32];
            // SAFETY: it ends the process at once.
            unsafe { libc::_exit(i32::from(!is_empty)) };
        }
        let mut status = -1;
        // SAFETY: waits for the child just made, and writes its status.
        assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
        assert_eq!(status, 0, "the child found the key");
        assert_eq!(*key.as_ref(), [0x5a; 32]);
    }
}
