//! An allocator that keeps released blocks unchanged for a search.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::trace::Trace;

/// A block that was freed, or left behind by growing, during a recording.
pub(crate) struct Freed {
    address: usize,
    layout: Layout,
    /// The stack of the allocation; unknown for blocks from before the recording.
    pub(crate) born: Option<Trace>,
    /// The stack of the release.
    pub(crate) died: Trace,
}

impl Freed {
    /// Returns the content of the block at its release.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let block = std::ptr::slice_from_raw_parts(self.address as *const u8, self.layout.size());
        // SAFETY: the block has this length, was zeroed when it was allocated during the recording, and belongs only to
        // this value.
        unsafe { &*block }.to_vec()
    }
}

impl Drop for Freed {
    fn drop(&mut self) {
        // SAFETY: it came from `System` with this layout, and its owner gave it back.
        unsafe { wipe_and_free(self.address as *mut u8, self.layout) }
    }
}

/// Returns a lock that each test holds from its start to its end: all threads are recorded, and the search of one test
/// would find the keys of another in memory.
pub(crate) fn turn() -> MutexGuard<'static, ()> {
    static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());
    ONE_AT_A_TIME.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs `work` and returns the blocks that any thread gave back meanwhile.
pub(crate) fn during<T>(work: impl FnOnce() -> T) -> (T, Vec<Freed>) {
    let recording = Recording::start();
    let result = work();
    (result, recording.stop())
}

struct Recording;

impl Recording {
    fn start() -> Self {
        RECORDING.store(true, Ordering::SeqCst);
        Self
    }

    fn stop(self) -> Vec<Freed> {
        drop(self);
        outside(|| {
            let mut ledger = ledger();
            let Ledger { live, freed } = &mut *ledger;
            *live = None;
            std::mem::take(freed)
        })
        .unwrap_or_default()
    }
}

impl Drop for Recording {
    fn drop(&mut self) {
        RECORDING.store(false, Ordering::SeqCst);
    }
}

struct Ledger {
    live: Option<HashMap<usize, Trace>>,
    freed: Vec<Freed>,
}

static LEDGER: Mutex<Ledger> = Mutex::new(Ledger { live: None, freed: Vec::new() });
static RECORDING: AtomicBool = AtomicBool::new(false);

thread_local! {
    // Constant and without a destructor, so that reading it allocates nothing by itself.
    static OUTSIDE: Cell<bool> = const { Cell::new(false) };
}

fn ledger() -> MutexGuard<'static, Ledger> {
    LEDGER.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Does the bookkeeping, whose own memory is not recorded. `None` inside of itself.
fn outside<T>(work: impl FnOnce() -> T) -> Option<T> {
    if OUTSIDE.replace(true) {
        return None;
    }
    let result = work();
    OUTSIDE.set(false);
    Some(result)
}

struct Quarantine;

#[global_allocator]
static QUARANTINE: Quarantine = Quarantine;

// SAFETY: blocks come from `System` with the layout asked for. They go back to it once, either at once or when their
// `Freed` is dropped. `realloc` is the trait's default: a new block, a copy, and the release of the old block, so that
// the search also sees blocks that growing leaves behind.
unsafe impl GlobalAlloc for Quarantine {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if !RECORDING.load(Ordering::Relaxed) {
            // SAFETY: the caller fulfils the contract of `GlobalAlloc`, which is that of `System`.
            return unsafe { System.alloc(layout) };
        }
        // The block is zeroed, so that everything found in it was written by its owner.
        // SAFETY: as above.
        let block = unsafe { System.alloc_zeroed(layout) };
        if !block.is_null() {
            outside(|| {
                let trace = Trace::here();
                ledger().live.get_or_insert_default().insert(block as usize, trace);
            });
        }
        block
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        if RECORDING.load(Ordering::Relaxed) {
            let kept = outside(|| {
                let died = Trace::here();
                let address = block as usize;
                let mut ledger = ledger();
                let born = ledger.live.as_mut().and_then(|live| live.remove(&address));
                ledger.freed.push(Freed { address, layout, born, died });
            });
            if kept.is_some() {
                return;
            }
        }
        // SAFETY: the caller fulfils the contract of `GlobalAlloc`, which includes that of this function.
        unsafe { wipe_and_free(block, layout) }
    }
}

/// Wipes and frees a block, so that the next test does not find this test's needles, keys and findings.
///
/// # Safety
/// The block is one of `System` with this layout, and no code uses it any more.
unsafe fn wipe_and_free(block: *mut u8, layout: Layout) {
    // SAFETY: the block is that long, and the caller's to give.
    unsafe { block.write_bytes(0, layout.size()) };
    // SAFETY: the caller fulfils this function's contract, which includes that of `System`.
    unsafe { System.dealloc(block, layout) }
}
