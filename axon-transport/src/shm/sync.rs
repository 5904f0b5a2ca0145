//! The one place where the lock-free protocols get their atomics from.
//!
//! They are written over [`Word`], so that the code that runs over mapped memory is the code that
//! the model checker explores.

pub(crate) use std::sync::atomic::Ordering;
use std::sync::atomic::{AtomicU64, fence};

/// A 64-bit atomic word, in mapped memory or in a model.
///
/// Loads use at most [`Ordering::Acquire`]: a stronger load is undefined on a read-only mapping.
pub(crate) trait Word {
    fn load(&self, order: Ordering) -> u64;
    fn store(&self, value: u64, order: Ordering);
    /// Stores the larger of the two and returns what was there. For words private to a process.
    fn fetch_max(&self, value: u64, order: Ordering) -> u64;
    fn fence(order: Ordering);
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

    fn fence(order: Ordering) {
        loom::sync::atomic::fence(order);
    }
}
