//! The time for which a waiter polls before it sleeps, learned from the duration of its last waits.

use std::{
    hint::spin_loop,
    sync::atomic::{AtomicU32, Ordering},
    thread::available_parallelism,
    time::{Duration, Instant},
};

/// About the cost of a sleep and of the ring that ends it, for both sides together, on a virtual machine, where it is
/// highest. With less, two processes that wait for each other never find out that polling is worth it.
const MAX_SPIN: Duration = Duration::from_micros(50);

/// Number of polls between two readings of the clock. A reading takes longer than a poll.
const MAX_SPINS: u32 = 8;

/// Most short sleeps that must follow an unsuccessful poll before the next poll.
const MAX_SLEEPS_BEFORE_SPIN: u32 = 1023;

/// Polls for as long as that has been worthwhile lately. A sleep that turns out shorter than [`MAX_SPIN`] makes the
/// next poll longer, a longer sleep halves it. An unsuccessful poll stops polling. The more of them follow each other,
/// the more short sleeps must come before the next poll: the awaited thread may be on this very processor, where it
/// cannot run while this one polls.
pub(super) struct Spin {
    /// Nanoseconds to poll. All accesses here are relaxed: the values are guesses, and a race that loses one does no
    /// harm.
    now: AtomicU32,
    /// Number of short sleeps before the next poll.
    pause: AtomicU32,
    /// Number of short sleeps that the next unsuccessful poll requires.
    patience: AtomicU32,
    most: u32,
}

impl Spin {
    pub(super) fn new() -> Self {
        // On a single processor the awaited thread cannot run during a poll.
        let alone = available_parallelism().is_ok_and(|n| n.get() == 1);
        Self::up_to(if alone { Duration::ZERO } else { MAX_SPIN })
    }

    fn up_to(most: Duration) -> Self {
        let most = u32::try_from(most.as_nanos()).unwrap_or(u32::MAX);
        let [now, pause, patience] = [0, 0, 1].map(AtomicU32::new);
        Self { now, pause, patience, most }
    }

    /// Polls `ready` from `now` on, at most until `deadline`. Returns whether it came true.
    pub(super) fn look(
        &self,
        mut ready: impl FnMut() -> bool,
        mut now: Instant,
        deadline: Option<Instant>,
    ) -> bool {
        let budget = self.now.load(Ordering::Relaxed);
        if budget == 0 {
            return false;
        }
        let mut end = now + Duration::from_nanos(u64::from(budget));
        end = deadline.map_or(end, |deadline| end.min(deadline));
        while now < end {
            for _ in 0..MAX_SPINS {
                spin_loop();
                if ready() {
                    self.patience.store(1, Ordering::Relaxed);
                    return true;
                }
            }
            now = Instant::now();
        }
        let patience = self.patience.load(Ordering::Relaxed);
        self.now.store(0, Ordering::Relaxed);
        self.pause.store(patience, Ordering::Relaxed);
        self.patience.store((patience * 2 + 1).min(MAX_SLEEPS_BEFORE_SPIN), Ordering::Relaxed);
        false
    }

    /// Records the length of a sleep that ended because the awaited event came.
    pub(super) fn slept(&self, time: Duration) {
        let time = u32::try_from(time.as_nanos()).unwrap_or(u32::MAX);
        let pause = self.pause.load(Ordering::Relaxed);
        if time <= self.most && pause > 0 {
            self.pause.store(pause - 1, Ordering::Relaxed);
            return;
        }
        let now = self.now.load(Ordering::Relaxed);
        let next = if time <= self.most { now.max(time).saturating_mul(2) } else { now / 2 };
        self.now.store(next.min(self.most), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both ends share a processor: no event comes during a poll, and one comes soon after a sleep begins.
    #[test]
    fn spinning_stops_where_the_peer_cannot_run_meanwhile() {
        let spin = Spin::up_to(Duration::from_micros(1));
        let mut vain = 0;
        for _ in 0..10_000 {
            let mut looked = false;
            spin.look(
                || {
                    looked = true;
                    false
                },
                Instant::now(),
                None,
            );
            vain += u32::from(looked);
            spin.slept(Duration::from_nanos(500));
        }
        assert!(vain <= 20, "{vain} looks");
        // The other end moves to its own processor: the next poll succeeds, and so do all later ones.
        let mut found = 0;
        for _ in 0..10_000 {
            let one = spin.look(|| true, Instant::now(), None);
            found += u32::from(one);
            if !one {
                spin.slept(Duration::from_nanos(500));
            }
        }
        assert!(found > 8_000, "{found} looks");
    }

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
                Instant::now(),
                None,
            );
            looks
        };
        let spin = Spin::up_to(Duration::from_secs(1));
        assert_eq!(look(&spin), 0, "not before it is known to help");
        spin.slept(Duration::from_millis(10));
        assert!(look(&spin) > 0);
        assert_eq!(look(&spin), 0, "that was in vain");
        spin.slept(Duration::from_millis(10));
        assert_eq!(look(&spin), 0, "and is not forgotten at once");
        spin.slept(Duration::from_millis(10));
        for _ in 0..40 {
            spin.slept(Duration::from_secs(2));
        }
        assert_eq!(look(&spin), 0, "long sleeps end it");
        let alone = Spin::up_to(Duration::ZERO);
        alone.slept(Duration::from_nanos(1));
        assert_eq!(look(&alone), 0);
        spin.slept(Duration::from_secs(1));
        assert!(spin.look(|| true, Instant::now(), None));
        let now = Instant::now();
        assert!(!spin.look(|| true, now, Some(now)), "its time is over");
    }
}
