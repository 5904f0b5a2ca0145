//! Keys in memory that is not swapped out, not part of a core file, and empty in a forked child. A child
//! that uses a key of its parent is aborted: zeros are a key that everybody knows.

// Mapped memory has no safe interface.
#![allow(unsafe_code)]

use std::{
    io,
    panic::{RefUnwindSafe, UnwindSafe},
    ptr::{self, NonNull},
    sync::{Mutex, MutexGuard, Once, PoisonError},
};

use axon_shm::internal::{Made, PerProcess};

use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mlock, mmap_anonymous};
use secrecy::ExposeSecret;
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

/// Locks are not inherited by a fork: a child's keys are in memory of its own, which it locked.
static ARENA: PerProcess<Mutex<Arena>> = PerProcess::new();

type Own = &'static Made<Mutex<Arena>>;

fn arena() -> io::Result<Own> {
    let empty = |_| Mutex::new(Arena { free: Vec::new(), slots: 0 });
    ARENA.get(empty, |_, _| ()).map_err(io::Error::other)
}

fn lock(arena: Own) -> MutexGuard<'static, Arena> {
    // Each operation leaves the list whole, so what a panicking thread held is sound.
    arena.value().lock().unwrap_or_else(PoisonError::into_inner)
}

/// A key in locked memory, erased on drop. Neither `Clone` nor `Debug`.
pub(crate) struct LockedKey {
    slot: NonNull<Slot>,
    arena: Own,
}

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
    let arena = arena()?;
    let mut held = lock(arena);
    let grown = if held.slots == 0 { Some(held.grow()?) } else { None };
    drop(held);
    grown.into_iter().for_each(Grown::warn);
    Ok(())
}

impl LockedKey {
    /// Copies a key; erasing `key` stays with the caller.
    ///
    /// # Errors
    /// The system gives no memory.
    pub(crate) fn copy_of(key: &[u8; 32]) -> io::Result<Self> {
        let (arena, mut grown) = (arena()?, None);
        let mut held = lock(arena);
        let slot = loop {
            match held.free.pop() {
                Some(slot) => break slot,
                None => grown = Some(held.grow()?),
            }
        };
        drop(held);
        // Without the lock: a log that nobody reads must not hold up other keys.
        grown.into_iter().for_each(Grown::warn);
        // Straight from there to here: a value in between would be left on the stack.
        // SAFETY: a slot out of the list is mapped, writable, and nobody else's.
        unsafe { slot.copy_from_nonoverlapping(NonNull::from(key), 1) };
        Ok(Self { slot, arena })
    }

    /// Whether the calling process is a fork of the one that made it, and so has no key here.
    pub(crate) fn is_forked(&self) -> bool {
        self.arena.is_forked()
    }
}

impl ExposeSecret<[u8; 32]> for LockedKey {
    /// The key. Aborts a process that [is a fork](Self::is_forked) of the one that made it.
    fn expose_secret(&self) -> &[u8; 32] {
        if self.is_forked() {
            abort_forked();
        }
        // SAFETY: the slot is mapped as long as the process lives, and `copy_of` wrote it in this
        // process, as was just asked. It changes in `drop` alone.
        unsafe { self.slot.as_ref() }
    }
}

/// Neither locks nor allocates: other threads of the parent may have held any lock at the fork.
#[cold]
fn abort_forked() -> ! {
    const TEXT: &[u8] = b"axon: a forked process used a key of its parent, which is not there; \
        open a session of its own in each process\n";
    // It ends whether or not somebody reads this.
    let _ = rustix::io::write(rustix::stdio::stderr(), TEXT);
    std::process::abort()
}

impl Drop for LockedKey {
    fn drop(&mut self) {
        // SAFETY: the slot is mapped as long as the process lives, in a forked child as well; that
        // nobody else refers to it is what `&mut self` says.
        unsafe { self.slot.as_mut() }.zeroize();
        // A forked child has locked none of its parent's slots, and uses none.
        if !self.arena.is_forked() {
            // There is room for every slot, so that this allocates nothing.
            lock(self.arena).free.push(self.slot);
        }
    }
}

impl Arena {
    fn grow(&mut self) -> io::Result<Grown> {
        let (access, private) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::PRIVATE);
        // SAFETY: a new mapping, wherever the system puts it, that replaces none.
        let chunk = unsafe { mmap_anonymous(ptr::null_mut(), CHUNK, access, private) }?;
        // SAFETY: the mapping just made, of that length.
        let locked = unsafe { mlock(chunk, CHUNK) };
        // SAFETY: as above. What is left out of core files is not changed.
        let kept_out = unsafe { madvise(chunk, CHUNK, Advice::LinuxDontDump) };
        // SAFETY: as above. A forked child finds zeros where this process has keys, and uses none.
        let wiped = unsafe { madvise(chunk, CHUNK, Advice::LinuxWipeOnFork) };
        let first = NonNull::new(chunk.cast::<Slot>()).ok_or(io::ErrorKind::OutOfMemory)?;
        let fresh = CHUNK / size_of::<Slot>();
        self.slots += fresh;
        self.free.reserve(self.slots - self.free.len());
        for at in 0..fresh {
            // SAFETY: within the mapping, whose start is aligned to a page.
            self.free.push(unsafe { first.add(at) });
        }
        Ok(Grown { locked, advised: kept_out.and(wiped) })
    }
}

/// What the system did for a new chunk.
struct Grown {
    locked: rustix::io::Result<()>,
    advised: rustix::io::Result<()>,
}

impl Grown {
    /// Says once what it does not do for keys, and what to do about it.
    fn warn(self) {
        static LOCKED: Once = Once::new();
        static ADVISED: Once = Once::new();
        let Self { locked, advised } = self;
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
}

#[cfg(test)]
mod tests {
    use std::{io::Read, os::fd::AsRawFd};

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
            assert_eq!(*key.expose_secret(), [at as u8 | 1; 32]);
        }
        for key in keys.iter().step_by(500) {
            let flags = flags(key.slot.as_ptr().addr());
            for flag in ["lo", "dd", "wf"] {
                assert!(flags.iter().any(|f| f == flag), "{flag} is not among {flags:?}");
            }
        }
        let slots: Vec<_> = keys.iter().map(|key| key.slot).collect();
        drop(keys);
        // Under the lock, so that no other test's key takes one of them.
        let arena = lock(arena().unwrap());
        for slot in slots.iter().filter(|slot| arena.free.contains(slot)) {
            // SAFETY: mapped for good, and nobody's as long as the lock is held.
            assert_eq!(unsafe { slot.read() }, [0; 32]);
        }
    }

    #[test]
    fn a_forked_child_finds_no_key() {
        let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
        let slot = key.slot;
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
        assert_eq!(*key.expose_secret(), [0x5a; 32]);
    }

    #[test]
    fn a_forked_child_that_uses_its_parents_key_is_aborted_with_a_message() {
        let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
        let (mut said, says) = io::pipe().unwrap();
        // SAFETY: the child makes two system calls, and then what is tested: that neither locks nor
        // allocates. It ends without running anything of its parent's.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let no_core = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
            // SAFETY: reads the limit that it is given.
            unsafe { libc::setrlimit(libc::RLIMIT_CORE, &raw const no_core) };
            // SAFETY: both descriptors are open; the child is the only one with this standard error.
            unsafe { libc::dup2(says.as_raw_fd(), 2) };
            let used = std::hint::black_box(key.expose_secret())[0];
            // SAFETY: it ends the process at once.
            unsafe { libc::_exit(i32::from(used)) };
        }
        drop(says);
        let mut text = String::new();
        said.read_to_string(&mut text).unwrap();
        let mut status = -1;
        // SAFETY: waits for the child just made, and writes its status.
        assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
        assert!(libc::WIFSIGNALED(status), "the child went on with a key of zeros");
        assert_eq!(libc::WTERMSIG(status), libc::SIGABRT);
        assert!(text.contains("forked"), "{text:?}");
        assert_eq!(*key.expose_secret(), [0x5a; 32]);
    }

    #[test]
    fn a_forked_childs_own_keys_are_locked_though_the_parents_list_was() {
        let key = LockedKey::copy_of(&[0x5a; 32]).unwrap();
        // Held at the fork, as another thread could hold it.
        let held = lock(arena().unwrap());
        // SAFETY: the child, one of many threads, allocates: its allocator is ready for that after a
        // fork (glibc). It ends without running anything of its parent's.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let (own, parents) = (LockedKey::copy_of(&[0x5b; 32]), key.slot);
            let is_locked = |own: LockedKey| {
                let flags = flags(own.slot.as_ptr().addr());
                own.slot != parents
                    && ["lo", "dd", "wf"].iter().all(|f| flags.iter().any(|g| g == f))
            };
            // Given up in the child, its slot stays out of the child's list.
            drop(key);
            let found = own.is_ok_and(is_locked);
            // SAFETY: it ends the process at once.
            unsafe { libc::_exit(i32::from(!found)) };
        }
        drop(held);
        let mut status = -1;
        // SAFETY: waits for the child just made, and writes its status.
        assert_eq!(unsafe { libc::waitpid(child, &raw mut status, 0) }, child);
        assert_eq!(status, 0, "the child's key is not locked, or it has none");
        assert_eq!(*key.expose_secret(), [0x5a; 32]);
    }
}
