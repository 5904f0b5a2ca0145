//! How long it pays to look before one sleeps.

use std::{
    hint::spin_loop,
    sync::atomic::{AtomicU32, Ordering},
    thread::available_parallelism,
    time::{Duration, Instant},
};

/// A sleep and the ring that ends it cost both sides about as much together.
const MOST: Duration = Duration::from_micros(20);

/// Looks for as long as that has lately been worth its while: a sleep that turns out shorter than
/// [`MOST`] makes it look longer, one that does not, and looking in vain, half as long.
pub(super) struct Spin {
    /// Nanoseconds to look for. Relaxed everywhere: a guess, whose loss under a race costs nothing.
    now: AtomicU32,
    most: u32,
}

impl Spin {
    pub(super) fn new() -> Self {
        // On one processor who is looked out for cannot run meanwhile.
        let alone = available_parallelism().is_ok_and(|n| n.get() == 1);
        Self::up_to(if alone { Duration::ZERO } else { MOST })
    }

    fn up_to(most: Duration) -> Self {
        let most = u32::try_from(most.as_nanos()).unwrap_or(u32::MAX);
        Self { now: AtomicU32::new(0), most }
    }

    /// Whether `ready` came true, looked at again and again until `deadline` at the latest.
    pub(super) fn look(&self, mut ready: impl FnMut() -> bool, deadline: Option<Instant>) -> bool {
        let budget = self.now.load(Ordering::Relaxed);
        if budget == 0 {
            return false;
        }
        let mut end = Instant::now() + Duration::from_nanos(u64::from(budget));
        end = deadline.map_or(end, |deadline| end.min(deadline));
        while Instant::now() < end {
            for _ in 0..8 {
                spin_loop();
            }
            if ready() {
                return true;
            }
        }
        self.now.store(budget / 2, Ordering::Relaxed);
        false
    }

    /// A sleep that was ended by what it waited for took this long.
    pub(super) fn slept(&self, time: Duration) {
        let time = u32::try_from(time.as_nanos()).unwrap_or(u32::MAX);
        let now = self.now.load(Ordering::Relaxed);
        let next = if time <= self.most { now.max(time).saturating_mul(2) } else { now / 2 };
        self.now.store(next.min(self.most), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn looks_only_where_sleeps_are_short_and_never_on_one_processor() {
        let mut looks = 0;
        let mut look = |spin: &Spin| {
            looks = 0;
            spin.look(
                || {
                    looks += 1;
                    false
                },
                None,
            );
            looks
        };
        let spin = Spin::up_to(Duration::from_secs(1));
        assert_eq!(look(&spin), 0, "not before it is known to help");
        spin.slept(Duration::from_millis(10));
        assert!(look(&spin) > 0);
        for _ in 0..40 {
            spin.slept(Duration::from_secs(2));
        }
        assert_eq!(look(&spin), 0, "long sleeps end it");
        let alone = Spin::up_to(Duration::ZERO);
        alone.slept(Duration::from_nanos(1));
        assert_eq!(look(&alone), 0);
        spin.slept(Duration::from_secs(1));
        assert!(spin.look(|| true, None));
        assert!(!spin.look(|| true, Some(Instant::now())), "its time is over");
    }
}
