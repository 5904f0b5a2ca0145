//! Keys in memory that is not swapped out, not part of a core file, and empty in a forked child. A child that uses a
//! key of its parent is aborted, because it would use a key of zeros, which anybody can guess.

use std::{
    io,
    panic::{RefUnwindSafe, UnwindSafe},
    sync::{Mutex, MutexGuard, Once, PoisonError},
};

use axon_shm::internal::{LockedPages, Made, PerProcess};
use secrecy::ExposeSecret;
use zeroize::Zeroize;

/// Bytes that are mapped at a time: 512 keys.
const CHUNK: usize = 16 << 10;

type Slot = [u8; 32];

/// Slots in chunks that stay mapped until the process ends.
struct Arena {
    free: Vec<&'static mut Slot>,
    /// Those in use as well.
    slots: usize,
}

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
pub struct LockedKey {
    /// `None` only while it is dropped.
    slot: Option<&'static mut Slot>,
    arena: Own,
}

// It changes in `copy_of` and in `drop` alone, neither of which panics halfway.
impl UnwindSafe for LockedKey {}
impl RefUnwindSafe for LockedKey {}

/// Maps the first chunk, so that a system that locks no memory is warned about at once.
///
/// # Errors
/// The system gives no memory.
pub fn prepare() -> io::Result<()> {
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
    pub fn copy_of(key: &[u8; 32]) -> io::Result<Self> {
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
        slot.copy_from_slice(key);
        Ok(Self { slot: Some(slot), arena })
    }

    /// Whether the calling process is a fork of the one that made it, and so has no key here.
    pub fn is_forked(&self) -> bool {
        self.arena.is_forked()
    }
}

impl ExposeSecret<[u8; 32]> for LockedKey {
    /// The key. Aborts a process that [is a fork](Self::is_forked) of the one that made it.
    fn expose_secret(&self) -> &[u8; 32] {
        if self.is_forked() {
            abort_forked();
        }
        self.slot.as_deref().expect("it is there until it is dropped")
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
        let Some(slot) = self.slot.take() else { return };
        slot.zeroize();
        // A forked child has locked none of its parent's slots, and uses none.
        if !self.arena.is_forked() {
            // There is room for every slot, so that this allocates nothing.
            lock(self.arena).free.push(slot);
        }
    }
}

impl Arena {
    fn grow(&mut self) -> io::Result<Grown> {
        let LockedPages { bytes, locked, advised } = LockedPages::map(CHUNK)?;
        let (fresh, _) = bytes.as_chunks_mut();
        self.slots += fresh.len();
        self.free.reserve(self.slots - self.free.len());
        self.free.extend(fresh);
        Ok(Grown { locked, advised })
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
mod tests;
