//! The only source of atomics and memory orderings for the lock-free protocols.
//!
//! The protocols are written over [`Word`], so that the code that runs over mapped memory is also the code that the
//! model checker explores. They name each ordering by its [`Site`], so that a test can weaken one ordering at a time
//! and check that a model fails (`tests/mutation.rs`).
//!
//! The language's memory model covers threads, not processes. On the supported machines, words of 64 bits are
//! lock-free and address-free. So the guarantees between threads also hold between processes that map the same page.

pub(crate) use std::sync::atomic::Ordering;
use std::sync::atomic::{AtomicU32, AtomicU64, fence};

/// A 64-bit atomic word, in mapped memory or in a model.
///
/// Loads use at most [`Ordering::Acquire`]: a stronger load is undefined on a read-only mapping.
pub(crate) trait Word {
    fn load(&self, order: Ordering) -> u64;
    fn store(&self, value: u64, order: Ordering);
    /// Stores the larger of both values and returns the previous value. For words private to a process.
    fn fetch_max(&self, value: u64, order: Ordering) -> u64;
    /// Adds `value` and returns the previous value. For words that only one process writes.
    fn fetch_add(&self, value: u64, order: Ordering) -> u64;
    fn fence(order: Ordering);
}

/// A 32-bit atomic word that names the holder of a lock within this process.
pub(crate) trait LockWord {
    /// Stores `to` if the word is `from`. Returns whether it did.
    fn swap_if(&self, from: u32, to: u32, order: Ordering) -> bool;
}

/// A memory access whose ordering matters. All other accesses are relaxed.
///
/// | site | pairs with | so that |
/// | --- | --- | --- |
/// | `StampStore` | `StampLoad` | a reader that sees the stamp sees the sample |
/// | `HeadStore` | `HeadLoad` | a reader that sees the head sees the stamp of the sample below it |
/// | `TailStore` | `TailLoad` | a reader never sees a tail above the head that it loads next |
/// | `ReuseFence` | `StandsFence` | a reader that saw a reuse sees the tail or array that announced it |
/// | `ArrayStore` | `ArrayLoad` | a reader that sees the new array sees the descriptors in it |
/// | `MappedStore` | `MappedLoad` | a reader whose publisher saw a segment mapped finds objects that moved there |
/// | `ReclaimFence` | `PinFence` | the publisher sees the pin, or the reader sees the tail |
/// | `PinStore`, `UnpinStore` | `ScanLoad` | a pinned sample is read before it is written over |
/// | `UnpinStore` | `FreeLoad` | a publisher that sees the next pin in a record knows that the last was read |
/// | `OpenStore` | `GenerationLoad` | a publisher that sees a lane open sees its cursor |
/// | `CloseStore`, `AskStore` | `GenerationLoad` | a publisher that sees a reader gone writes after it read |
/// | `CursorStore` | `CursorLoad` | a sample is copied out before KEEP_ALL writes over it |
/// | `NotedAdd` | `NotedLoad` | a follower that sees an entry counted sees the sample of that entry |
/// | `ArmFence` | `SettleFence` | the sleeper sees the news, or the waker sees the ticket |
/// | `LetGoSwap` | `TakeSwap` | a thread that takes a lock sees what its last holder did |
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Site {
    StampStore,
    StampLoad,
    HeadStore,
    HeadLoad,
    TailStore,
    TailLoad,
    ReuseFence,
    StandsFence,
    ArrayStore,
    ArrayLoad,
    MappedStore,
    MappedLoad,
    ReclaimFence,
    PinFence,
    PinStore,
    UnpinStore,
    FreeLoad,
    ScanLoad,
    AskStore,
    OpenStore,
    CloseStore,
    GenerationLoad,
    CursorStore,
    CursorLoad,
    NotedAdd,
    NotedLoad,
    ArmFence,
    SettleFence,
    LetGoSwap,
    TakeSwap,
}

impl Site {
    /// Returns the ordering of this site.
    #[inline(always)]
    pub(crate) fn order(self) -> Ordering {
        #[cfg(test)]
        if weakened() == Some(self) {
            return self.weaker();
        }
        self.needed()
    }

    const fn needed(self) -> Ordering {
        match self {
            Self::StampStore
            | Self::HeadStore
            | Self::TailStore
            | Self::ReuseFence
            | Self::ArrayStore
            | Self::MappedStore
            | Self::PinStore
            | Self::UnpinStore
            | Self::AskStore
            | Self::OpenStore
            | Self::CloseStore
            | Self::CursorStore
            | Self::NotedAdd
            | Self::LetGoSwap => Ordering::Release,
            Self::StampLoad
            | Self::HeadLoad
            | Self::TailLoad
            | Self::StandsFence
            | Self::ArrayLoad
            | Self::MappedLoad
            | Self::FreeLoad
            | Self::ScanLoad
            | Self::GenerationLoad
            | Self::CursorLoad
            | Self::NotedLoad
            | Self::TakeSwap => Ordering::Acquire,
            // Each side stores one word and loads another.
            Self::ReclaimFence | Self::PinFence | Self::ArmFence | Self::SettleFence => {
                Ordering::SeqCst
            }
        }
    }
}

/// Executes the fence of a site.
#[inline(always)]
pub(crate) fn fence_at<W: Word>(site: Site) {
    let order = site.order();
    // A weakened fence is no fence at all.
    if order != Ordering::Relaxed {
        W::fence(order);
    }
}

#[cfg(test)]
impl Site {
    pub(crate) const ALL: [Self; 30] = [
        Self::StampStore,
        Self::StampLoad,
        Self::HeadStore,
        Self::HeadLoad,
        Self::TailStore,
        Self::TailLoad,
        Self::ReuseFence,
        Self::StandsFence,
        Self::ArrayStore,
        Self::ArrayLoad,
        Self::MappedStore,
        Self::MappedLoad,
        Self::ReclaimFence,
        Self::PinFence,
        Self::PinStore,
        Self::UnpinStore,
        Self::FreeLoad,
        Self::ScanLoad,
        Self::AskStore,
        Self::OpenStore,
        Self::CloseStore,
        Self::GenerationLoad,
        Self::CursorStore,
        Self::CursorLoad,
        Self::NotedAdd,
        Self::NotedLoad,
        Self::ArmFence,
        Self::SettleFence,
        Self::LetGoSwap,
        Self::TakeSwap,
    ];
    /// Environment variable that names the site to weaken in a run of the models.
    pub(crate) const WEAKEN: &str = "SHM_TEST_WEAKEN";

    /// Returns the next weaker ordering.
    pub(crate) fn weaker(self) -> Ordering {
        match self.needed() {
            Ordering::SeqCst => Ordering::AcqRel,
            _ => Ordering::Relaxed,
        }
    }
}

#[cfg(test)]
fn weakened() -> Option<Site> {
    static WEAKENED: std::sync::LazyLock<Option<Site>> = std::sync::LazyLock::new(|| {
        let name = std::env::var(Site::WEAKEN).ok()?;
        let site = Site::ALL.into_iter().find(|site| format!("{site:?}") == name);
        Some(site.expect("the name of a site"))
    });
    *WEAKENED
}

impl Word for AtomicU64 {
    #[inline]
    fn load(&self, order: Ordering) -> u64 {
        self.load(order)
    }

    #[inline]
    fn store(&self, value: u64, order: Ordering) {
        self.store(value, order);
    }

    #[inline]
    fn fetch_max(&self, value: u64, order: Ordering) -> u64 {
        self.fetch_max(value, order)
    }

    #[inline]
    fn fetch_add(&self, value: u64, order: Ordering) -> u64 {
        self.fetch_add(value, order)
    }

    #[inline]
    fn fence(order: Ordering) {
        fence(order);
    }
}

#[cfg(test)]
impl Word for loom::sync::atomic::AtomicU64 {
    fn load(&self, order: Ordering) -> u64 {
        self.load(order)
    }

    fn store(&self, value: u64, order: Ordering) {
        self.store(value, order);
    }

    fn fetch_max(&self, value: u64, order: Ordering) -> u64 {
        self.fetch_max(value, order)
    }

    fn fetch_add(&self, value: u64, order: Ordering) -> u64 {
        self.fetch_add(value, order)
    }

    fn fence(order: Ordering) {
        loom::sync::atomic::fence(order);
    }
}

impl LockWord for AtomicU32 {
    #[inline]
    fn swap_if(&self, from: u32, to: u32, order: Ordering) -> bool {
        self.compare_exchange(from, to, order, Ordering::Relaxed).is_ok()
    }
}

#[cfg(test)]
impl LockWord for loom::sync::atomic::AtomicU32 {
    fn swap_if(&self, from: u32, to: u32, order: Ordering) -> bool {
        self.compare_exchange(from, to, order, Ordering::Relaxed).is_ok()
    }
}
