//! How many keys to hold, from what is asked for and what comes.

use std::{fmt, time::Duration};

use axon_envelope::MESSAGES_PER_KEY;

use crate::keys::request::Stock;

/// Bounds of the keys held ahead.
const AHEAD: std::ops::RangeInclusive<usize> = 4..=256;
/// Lead time assumed before one was measured.
const FIRST_LEAD: Duration = Duration::from_millis(100);
/// How fast the number of keys ahead follows the demand.
const QUICK: Duration = Duration::from_secs(1);
/// Over what time demand is compared with supply.
const STEADY: Duration = Duration::from_secs(10);
/// Time spent waiting for keys before their rate means anything.
const WAITED: Duration = Duration::from_secs(1);
/// At what share of the supply the demand is too close to it.
const CLOSE: f64 = 0.8;
/// Time between two warnings.
const WARN_EVERY: Duration = Duration::from_secs(10);

/// The keys that are asked for come close to what the KME gives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SupplyWarning {
    /// Keys a second that the messages need.
    pub demand: f64,
    /// Keys a second that the KME gives.
    pub supply: f64,
}

impl fmt::Display for SupplyWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { demand, supply } = self;
        write!(
            f,
            "messages10 needs {demand:.1} keys/s and the KME gives {supply:.1} ({:.0} messages/s): \
             send fewer messages, or see the KME's key rate",
            supply * f64::from(MESSAGES_PER_KEY)
        )
    }
}

/// A rate that forgets with time constant `window`.
struct Rate {
    window: Duration,
    value: f64,
    at: Duration,
}

impl Rate {
    fn new(window: Duration) -> Self {
        Self { window, value: 0.0, at: Duration::ZERO }
    }

    fn add(&mut self, now: Duration, count: f64) {
        self.value = self.get(now) + count / self.window.as_secs_f64();
        self.at = now;
    }

    fn get(&self, now: Duration) -> f64 {
        let gone = now.saturating_sub(self.at).as_secs_f64() / self.window.as_secs_f64();
        self.value * (-gone).exp()
    }
}

/// Demand, supply, lead time and stock of one direction.
pub(super) struct Demand {
    quick: Rate,
    steady: Rate,
    /// From asking for a key to READY.
    lead: Option<f64>,
    obtained: f64,
    waited: f64,
    stock: Option<(Duration, Stock, f64)>,
    obtained_since_stock: f64,
    /// Keys a second that enter the KME's store, where the stock shows it.
    fill: Option<f64>,
    warned: Option<Duration>,
}

impl Demand {
    pub(super) fn new() -> Self {
        Self {
            quick: Rate::new(QUICK),
            steady: Rate::new(STEADY),
            lead: None,
            obtained: 0.0,
            waited: 0.0,
            stock: None,
            obtained_since_stock: 0.0,
            fill: None,
            warned: None,
        }
    }

    /// `messages` are to be sent.
    pub(super) fn messages(&mut self, now: Duration, messages: u32) {
        let keys = f64::from(messages) / f64::from(MESSAGES_PER_KEY);
        self.quick.add(now, keys);
        self.steady.add(now, keys);
    }

    /// A call for keys gave `keys`, `waited` after the one before or after keys were first wanted.
    pub(super) fn answered(&mut self, waited: Duration, keys: usize) {
        // Half a window back counts half.
        if self.waited > STEADY.as_secs_f64() {
            self.waited /= 2.0;
            self.obtained /= 2.0;
        }
        self.waited += waited.as_secs_f64();
        self.obtained += keys as f64;
        self.obtained_since_stock += keys as f64;
    }

    /// A key became READY `lead` after it was asked for.
    pub(super) fn ready(&mut self, lead: Duration) {
        let new = lead.as_secs_f64();
        self.lead = Some(self.lead.map_or(new, |old| old + (new - old) / 4.0));
    }

    /// The KME told its stock.
    pub(super) fn stocked(&mut self, now: Duration, stock: Stock) {
        let count = stock.stored_key_count as f64;
        if let Some((then, _, before)) = self.stock {
            let passed = now.saturating_sub(then).as_secs_f64();
            // A stock that does not shrink, as a full one, does not show its limit.
            self.fill = (passed > 0.0 && count > 0.0 && count < before)
                .then(|| ((count - before + self.obtained_since_stock) / passed).max(0.0));
        }
        self.obtained_since_stock = 0.0;
        self.stock = Some((now, stock, count));
    }

    /// Keys that should be on their way or ready, beyond the one in use.
    pub(super) fn target(&self, now: Duration) -> usize {
        let keys = 2.0 * self.quick.get(now) * self.lead_time().as_secs_f64();
        let keys = (keys.ceil() as usize).clamp(*AHEAD.start(), *AHEAD.end());
        match self.stock {
            Some((_, Stock { stored_key_count: count @ 1.., .. }, _)) => {
                keys.min(usize::try_from(count / 4).unwrap_or(usize::MAX)).max(1)
            }
            _ => keys,
        }
    }

    /// Keys kept for RELIABLE and services: the last max(2, 25 %), as long as that leaves any.
    pub(super) fn reserve(&self, now: Duration) -> usize {
        let target = self.target(now);
        (target / 4).max(2).min(target - 1)
    }

    /// Most keys a call may ask for, as far as the KME said.
    pub(super) fn per_call(&self) -> u32 {
        let max = self.stock.map_or(0, |(_, stock, _)| stock.max_key_per_request);
        if max == 0 { u32::MAX } else { max.try_into().unwrap_or(u32::MAX) }
    }

    pub(super) fn lead_time(&self) -> Duration {
        self.lead.map_or(FIRST_LEAD, Duration::from_secs_f64)
    }

    /// Keys a second that the messages need.
    pub(super) fn demand(&self, now: Duration) -> f64 {
        self.steady.get(now)
    }

    /// Keys a second that the KME gives, where it was seen at its limit.
    pub(super) fn supply(&self) -> Option<f64> {
        let waited = (self.waited >= WAITED.as_secs_f64()).then(|| self.obtained / self.waited);
        [waited, self.fill].into_iter().flatten().reduce(f64::min)
    }

    pub(super) fn warning(&mut self, now: Duration) -> Option<SupplyWarning> {
        let (demand, supply) = (self.demand(now), self.supply()?);
        let due = self.warned.is_none_or(|at| now.saturating_sub(at) >= WARN_EVERY);
        if !due || demand <= CLOSE * supply {
            return None;
        }
        self.warned = Some(now);
        Some(SupplyWarning { demand, supply })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    fn stock(stored_key_count: u64) -> Stock {
        Stock { stored_key_count, max_key_per_request: 128 }
    }

    /// `per_second` messages for ten seconds, from time `from`.
    fn run(demand: &mut Demand, from: u64, per_second: u64) -> Duration {
        for i in 0..per_second * 10 {
            demand.messages(ms(from + i * 1000 / per_second), 1);
        }
        ms(from + 10_000)
    }

    #[test]
    fn keys_ahead_follow_rate_and_lead_time_within_bounds() {
        let mut demand = Demand::new();
        assert_eq!(demand.target(ms(0)), 4);
        for _ in 0..50 {
            demand.ready(ms(200));
        }
        let now = run(&mut demand, 0, 1000);
        let target = demand.target(now);
        assert!((36..=44).contains(&target), "2 x 100 keys/s x 0.2 s: {target}");
        for _ in 0..50 {
            demand.ready(ms(10_000));
        }
        assert_eq!(demand.target(now), 256);
        demand.stocked(now, stock(100));
        assert_eq!(demand.target(now), 25, "at most a quarter of the stock");
        demand.stocked(now, stock(1));
        assert_eq!((demand.target(now), demand.reserve(now)), (1, 0));
        demand.stocked(now, stock(0));
        assert_eq!(demand.target(now), 256, "0 says nothing");
        assert_eq!(demand.reserve(now), 64);
        assert_eq!(demand.target(now + ms(60_000)), 4, "demand has gone");
    }

    #[test]
    fn it_warns_when_the_kme_gives_too_little() {
        let mut demand = Demand::new();
        let now = run(&mut demand, 0, 100);
        assert!(demand.warning(now).is_none(), "no supply was measured");
        for _ in 0..10 {
            demand.answered(ms(1000), 5);
        }
        let now = run(&mut demand, 10_000, 100);
        let warning = demand.warning(now).expect("10 keys/s of 5");
        assert!(warning.supply > 4.5 && warning.supply < 5.5, "{warning}");
        assert!(demand.warning(now).is_none(), "said a moment ago");
        assert!(demand.warning(now + ms(300_000)).is_none(), "demand has gone");
    }

    #[test]
    fn a_shrinking_stock_shows_the_supply_before_it_is_empty() {
        let mut demand = Demand::new();
        demand.stocked(ms(0), stock(1000));
        demand.answered(ms(10), 100);
        let now = run(&mut demand, 0, 100);
        demand.stocked(now, stock(930));
        let warning = demand.warning(now).expect("3 keys/s come in");
        assert!((warning.supply - 3.0).abs() < 0.01, "{warning}");
        demand.stocked(now + ms(10_000), stock(930));
        assert!(demand.supply().is_none(), "a steady stock shows no limit");
    }
}
