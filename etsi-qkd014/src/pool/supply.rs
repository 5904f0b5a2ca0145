//! Measures how many keys per second the KME gives.

use std::time::Duration;

use super::core::Stock;

/// Seconds of waiting for keys before the rate is meaningful.
const ENOUGH: f64 = 1.0;
/// Seconds of waiting that count fully. Earlier waiting counts half, and again half.
const WINDOW: f64 = 10.0;

/// Measures the supply from the waits for keys and from a shrinking stock.
#[derive(Default)]
pub(super) struct Supply {
    obtained: f64,
    waited: f64,
    stock: Option<(Duration, f64)>,
    obtained_since_stock: f64,
    fill: Option<f64>,
}

impl Supply {
    /// Records a call that ended with `keys`, `waited` after the previous one, or after keys were
    /// first wanted.
    pub(super) fn answered(&mut self, waited: Duration, keys: usize) {
        if self.waited > WINDOW {
            self.waited /= 2.0;
            self.obtained /= 2.0;
        }
        self.waited += waited.as_secs_f64();
        self.obtained += keys as f64;
        self.obtained_since_stock += keys as f64;
    }

    pub(super) fn stocked(&mut self, now: Duration, stock: Stock) {
        let count = stock.stored_key_count as f64;
        if let Some((then, before)) = self.stock {
            let passed = now.saturating_sub(then).as_secs_f64();
            // A stock that does not shrink, for example a full one, does not show its limit.
            self.fill = (passed > 0.0 && count > 0.0 && count < before)
                .then(|| ((count - before + self.obtained_since_stock) / passed).max(0.0));
        }
        self.obtained_since_stock = 0.0;
        self.stock = Some((now, count));
    }

    /// Returns the keys per second, if the KME was seen at its limit.
    pub(super) fn rate(&self) -> Option<f64> {
        let waited = (self.waited >= ENOUGH).then(|| self.obtained / self.waited);
        [waited, self.fill].into_iter().flatten().reduce(f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn stock(stored_key_count: u64) -> Stock {
        Stock { stored_key_count, max_key_per_request: 0 }
    }

    #[test]
    fn waits_show_the_rate_and_a_moment_shows_nothing() {
        let mut supply = Supply::default();
        supply.answered(Duration::from_millis(10), 8);
        assert_eq!(supply.rate(), None);
        for _ in 0..100 {
            supply.answered(s(1), 5);
        }
        let rate = supply.rate().unwrap();
        assert!((4.9..5.5).contains(&rate), "{rate}");
        for _ in 0..100 {
            supply.answered(s(1), 0);
        }
        assert!(supply.rate().unwrap() < 0.1, "what was long ago is forgotten");
    }

    #[test]
    fn a_shrinking_stock_reveals_the_refill_rate() {
        let mut supply = Supply::default();
        supply.stocked(s(0), stock(1000));
        supply.answered(s(0), 100);
        supply.stocked(s(10), stock(930));
        assert_eq!(supply.rate(), Some(3.0));
        supply.stocked(s(20), stock(930));
        assert_eq!(supply.rate(), None, "a steady stock shows no limit");
        supply.stocked(s(30), stock(0));
        assert_eq!(supply.rate(), None, "0 may mean that the KME does not say");
    }
}
