//! Measures the keys per second that the messages need, and decides how many keys are fetched ahead.

use std::{fmt, time::Duration};

use axon_envelope::MESSAGES_PER_KEY;

use super::MAX_UNRETIRED;

/// Bounds of the number of keys held ahead.
const AHEAD: std::ops::RangeInclusive<usize> = 4..=256;
const _: () = assert!(*AHEAD.end() < MAX_UNRETIRED, "what is drawn can be announced");
/// Lead time assumed before one was measured.
const FIRST_LEAD: Duration = Duration::from_millis(100);
/// Time constant with which the number of keys ahead follows the demand.
const QUICK: Duration = Duration::from_secs(1);
/// Time constant of the demand that is compared with the supply.
const STEADY: Duration = Duration::from_secs(10);
/// Keys per second below which no copies are sent any more. One copy counts for two seconds.
const SOME: f64 = 0.01;
/// Share of the supply above which the demand is too close to it.
const CLOSE: f64 = 0.8;
/// Minimum time between two warnings.
const WARN_EVERY: Duration = Duration::from_secs(10);

/// A warning that the messages need nearly as many keys as the KME gives, or more.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SupplyWarning {
    /// Keys per second that the messages need.
    pub demand: f64,
    /// Keys per second that the KME gives.
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

/// A rate that decays with time constant `window`.
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

/// Demand and lead time of one direction.
pub(super) struct Demand {
    quick: Rate,
    steady: Rate,
    /// The time from the request for a key to READY, in seconds.
    lead: Option<f64>,
    warned: Option<Duration>,
}

impl Demand {
    pub(super) fn new() -> Self {
        Self { quick: Rate::new(QUICK), steady: Rate::new(STEADY), lead: None, warned: None }
    }

    /// Counts `messages` that are to be sent.
    pub(super) fn messages(&mut self, now: Duration, messages: u32) {
        let keys = f64::from(messages) / f64::from(MESSAGES_PER_KEY);
        self.quick.add(now, keys);
        self.steady.add(now, keys);
    }

    /// Records that a key became READY `lead` after its request.
    pub(super) fn ready(&mut self, lead: Duration) {
        let new = lead.as_secs_f64();
        self.lead = Some(self.lead.map_or(new, |old| old + (new - old) / 4.0));
    }

    /// Returns the number of keys that should be in flight or ready, beyond the key in use.
    pub(super) fn ahead(&self, now: Duration) -> usize {
        let keys = 2.0 * self.quick.get(now) * self.lead_time().as_secs_f64();
        (keys.ceil() as usize).clamp(*AHEAD.start(), *AHEAD.end())
    }

    /// Returns the number of keys that should be in flight or ready for copies: none while no copies are sent.
    pub(super) fn ahead_of_copies(&self, now: Duration) -> usize {
        if self.quick.get(now) < SOME { 0 } else { self.ahead(now) }
    }

    pub(super) fn lead_time(&self) -> Duration {
        self.lead.map_or(FIRST_LEAD, Duration::from_secs_f64)
    }

    /// Returns the keys per second that the messages need.
    pub(super) fn demand(&self, now: Duration) -> f64 {
        self.steady.get(now)
    }

    /// Returns a warning if it is due and the `demand` comes close to `supply`, the keys per second that the KME gives.
    pub(super) fn warning(
        &mut self,
        now: Duration,
        demand: f64,
        supply: f64,
    ) -> Option<SupplyWarning> {
        let due = self.warned.is_none_or(|at| now.saturating_sub(at) >= WARN_EVERY);
        if !due || demand <= CLOSE * supply {
            return None;
        }
        self.warned = Some(now);
        Some(SupplyWarning { demand, supply })
    }
}

/// Returns the number of keys that are reserved for RELIABLE and services, of `target` keys ahead: max(2, 25 %), as
/// long as that leaves any.
pub(super) fn reserve(target: usize) -> usize {
    (target / 4).max(2).min(target.saturating_sub(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(millis: u64) -> Duration {
        Duration::from_millis(millis)
    }

    /// Counts `per_second` messages for ten seconds, from time `from`. Returns the end of that time.
    fn run(demand: &mut Demand, from: u64, per_second: u64) -> Duration {
        for i in 0..per_second * 10 {
            demand.messages(ms(from + i * 1000 / per_second), 1);
        }
        ms(from + 10_000)
    }

    #[test]
    fn keys_ahead_follow_rate_and_lead_time_within_bounds() {
        let mut demand = Demand::new();
        assert_eq!(demand.ahead(ms(0)), 4);
        for _ in 0..50 {
            demand.ready(ms(200));
        }
        let now = run(&mut demand, 0, 1000);
        let ahead = demand.ahead(now);
        assert!((36..=44).contains(&ahead), "2 x 100 keys/s x 0.2 s: {ahead}");
        for _ in 0..50 {
            demand.ready(ms(10_000));
        }
        assert_eq!(demand.ahead(now), 256);
        assert_eq!(demand.ahead(now + ms(60_000)), 4, "demand has gone");
    }

    #[test]
    fn a_quarter_is_kept_at_least_two_and_never_all() {
        let kept = [0, 1, 2, 3, 4, 8, 100, 256].map(reserve);
        assert_eq!(kept, [0, 0, 1, 2, 2, 2, 25, 64]);
    }

    #[test]
    fn it_warns_when_the_kme_gives_too_little() {
        let mut demand = Demand::new();
        let now = run(&mut demand, 0, 100);
        assert!(demand.warning(now, demand.demand(now), 20.0).is_none(), "10 keys/s of 20");
        let warning = demand.warning(now, demand.demand(now), 5.0).expect("10 keys/s of 5");
        assert!(warning.supply == 5.0 && (5.0..10.5).contains(&warning.demand), "{warning}");
        assert!(demand.warning(now, demand.demand(now), 5.0).is_none(), "said a moment ago");
        assert!(
            demand.warning(now + ms(300_000), demand.demand(now + ms(300_000)), 5.0).is_none(),
            "demand has gone"
        );
    }
}
