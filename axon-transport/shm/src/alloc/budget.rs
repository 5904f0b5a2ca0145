//! A bound on the memory that several rings take together: the rings that stand for the publishers of one peer. It only
//! consists of counters, which guard no other memory.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use crate::error::ShmError;

/// Memory that several rings may take together, in bytes. Each ring takes at most half of what the others leave, so no
/// ring takes all of it.
#[derive(Debug)]
pub struct MemoryBudget {
    most: u64,
    held: AtomicU64,
    /// The number of refused requests.
    refused: AtomicU64,
    /// The pool that this budget is part of.
    pool: Option<Arc<Self>>,
}

impl MemoryBudget {
    /// Creates a budget of `most` bytes.
    pub fn new(most: u64) -> Arc<Self> {
        Self::with(most, None)
    }

    /// Creates a budget of `most` bytes, and of at most half of what others leave of `pool`.
    pub fn within(pool: &Arc<Self>, most: u64) -> Arc<Self> {
        Self::with(most, Some(Arc::clone(pool)))
    }

    fn with(most: u64, pool: Option<Arc<Self>>) -> Arc<Self> {
        Arc::new(Self { most, held: AtomicU64::new(0), refused: AtomicU64::new(0), pool })
    }

    /// Returns the bound in bytes.
    pub fn most(&self) -> u64 {
        self.most
    }

    /// Returns the bytes that are taken now.
    pub fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// Returns how many requests for memory were refused since the start.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Takes `bytes` for a part that already has `own` bytes. If they do not fit, the error is the number of bytes that
    /// would.
    fn take(&self, own: u64, bytes: u64) -> Result<(), u64> {
        let fits = |held: u64| {
            let share = self.most.saturating_sub(held.saturating_sub(own)) / 2;
            (own.saturating_add(bytes) <= share).then(|| held + bytes)
        };
        let taken = self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits);
        taken.map(drop).map_err(|held| {
            let share = self.most.saturating_sub(held.saturating_sub(own)) / 2;
            share.saturating_sub(own)
        })
    }

    fn give_back(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// The part of a budget that one ring has taken. Given back when it is dropped.
#[derive(Debug, Default)]
pub(crate) struct Holding {
    of: Option<Arc<MemoryBudget>>,
    bytes: u64,
    /// The number of refusals at the last call of [`is_short`](Self::is_short).
    refused: u64,
}

impl Holding {
    /// Creates an empty holding of `budget`.
    pub(crate) fn of(budget: Arc<MemoryBudget>) -> Self {
        let refused = budget.refused();
        Self { of: Some(budget), bytes: 0, refused }
    }

    /// Takes `bytes` more.
    ///
    /// # Errors
    /// The budget has less left.
    pub(crate) fn take(&mut self, bytes: u64) -> Result<(), ShmError> {
        let Some(of) = &self.of else { return Ok(()) };
        let pool_held = of.held();
        let taken = of.take(self.bytes, bytes).and_then(|()| {
            let Some(pool) = &of.pool else { return Ok(()) };
            pool.take(pool_held, bytes).inspect_err(|_| of.give_back(bytes))
        });
        match taken {
            Ok(()) => {
                self.bytes += bytes;
                Ok(())
            }
            Err(available) => {
                of.refused.fetch_add(1, Ordering::Relaxed);
                Err(ShmError::MemoryBudget { needed: bytes, available, most: of.most })
            }
        }
    }

    /// Gives `bytes` back.
    pub(crate) fn give_back(&mut self, bytes: u64) {
        let Some(of) = &self.of else { return };
        let bytes = bytes.min(self.bytes);
        self.bytes -= bytes;
        of.give_back(bytes);
        if let Some(pool) = &of.pool {
            pool.give_back(bytes);
        }
    }

    /// Returns whether any ring was refused memory since the last call. Rings then give back memory that they do not
    /// need.
    pub(crate) fn is_short(&mut self) -> bool {
        let Some(of) = &self.of else { return false };
        let refused = of.refused();
        std::mem::replace(&mut self.refused, refused) != refused
    }
}

impl Drop for Holding {
    fn drop(&mut self) {
        self.give_back(self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_takes_at_most_half_the_free_budget_and_returns_it() {
        let budget = MemoryBudget::new(100);
        let [mut one, mut two] = [(); 2].map(|()| Holding::of(Arc::clone(&budget)));
        assert!(one.take(51).is_err() && one.take(30).is_ok() && one.take(20).is_ok());
        assert!(one.take(1).is_err(), "it has half of all");
        assert!(two.take(26).is_err() && two.take(25).is_ok());
        assert_eq!((budget.held(), budget.refused()), (75, 3));
        one.give_back(40);
        assert!(two.take(21).is_err() && two.take(20).is_ok());
        drop((one, two));
        assert_eq!(budget.held(), 0);
    }

    #[test]
    fn a_nested_budget_cannot_exceed_its_pool() {
        let pool = MemoryBudget::new(100);
        let [one, two] = [80, 80].map(|most| MemoryBudget::within(&pool, most));
        let mut of_one = [(); 2].map(|()| Holding::of(Arc::clone(&one)));
        assert!(of_one[0].take(40).is_ok() && of_one[1].take(10).is_ok());
        assert!(of_one[1].take(1).is_err(), "the identity has half of the pool");
        assert_eq!((one.held(), pool.held()), (50, 50), "what was refused took nothing");
        let mut of_two = Holding::of(Arc::clone(&two));
        assert!(of_two.take(26).is_err() && of_two.take(25).is_ok());
        drop((of_one, of_two));
        assert_eq!((one.held(), two.held(), pool.held()), (0, 0, 0));
    }

    #[test]
    fn a_ring_hears_once_that_another_one_was_refused() {
        let budget = MemoryBudget::new(100);
        let [mut one, mut two] = [(); 2].map(|()| Holding::of(Arc::clone(&budget)));
        assert!(!one.is_short());
        two.take(60).unwrap_err();
        assert!(one.is_short() && !one.is_short());
        assert!(!Holding::default().is_short() && Holding::default().take(u64::MAX).is_ok());
    }
}
