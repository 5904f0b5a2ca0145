//! The rate at which a link carries data, measured while more data waits than the link carries.

use std::time::Duration;

/// Minimum duration of a measurement, also in round trips. The bytes that the window lets leave at once are then a
/// small part of it.
const SPAN: (Duration, u32) = (Duration::from_millis(50), 4);
/// Minimum share of the window sent per round trip; below it, the peer or the path limited the output.
const OF_WINDOW: f64 = 0.5;
/// Maximum ratio of a rate to the rate of the measurement before: a link begins slowly. A rate above the last known one
/// counts at any ratio.
const STEADY: f64 = 1.25;
/// Maximum age of a rate. Compressed samples may leave the link idle, so that no new measurement replaces the rate.
const BELIEVED: Duration = Duration::from_secs(30);

/// Measures the rate of one link.
#[derive(Debug, Default)]
pub(crate) struct LinkRate {
    /// The start of the measurement, and the bytes that had left by then.
    begun: Option<(Duration, u64)>,
    /// The rate of the previous measurement.
    before: f64,
    /// The rate in bytes per second, and the time of its measurement.
    measured: Option<(f64, Duration)>,
}

impl LinkRate {
    /// Handles the end of a pass. The link `is_full` if QUIC did not take all waiting samples.
    pub(crate) fn handle_pass(
        &mut self,
        now: Duration,
        is_full: bool,
        left: impl Fn() -> u64,
        window: u64,
        rtt: Duration,
    ) {
        if !is_full {
            (self.begun, self.before) = (None, 0.0);
            return;
        }
        let Some((since, before)) = self.begun else {
            self.begun = Some((now, left()));
            return;
        };
        let span = now.saturating_sub(since);
        if span >= SPAN.0.max(rtt * SPAN.1) {
            let left = left();
            let rate = left.saturating_sub(before) as f64 / span.as_secs_f64();
            let is_used = rate * rtt.as_secs_f64() >= OF_WINDOW * window as f64;
            let is_higher = self.measured.is_some_and(|(measured, _)| rate > measured);
            if is_used && (is_higher || rate <= STEADY * self.before) {
                self.measured = Some((rate, now));
            }
            self.before = if is_used { rate } else { 0.0 };
            self.begun = Some((now, left));
        }
    }

    /// Returns the rate that the link carries in bytes per second, if it was full lately.
    pub(crate) fn get(&self, now: Duration) -> Option<f64> {
        let (rate, at) = self.measured?;
        (now.saturating_sub(at) < BELIEVED).then_some(rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RTT: Duration = Duration::from_millis(4);
    /// The window of a link that carries a megabyte per second.
    const WINDOW: u64 = 4_000;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    /// Simulates a full link from this time on, which carries `each` bytes in each of `time` milliseconds.
    fn run(rate: &mut LinkRate, from: u64, time: u64, left: &mut u64, each: u64) {
        for at in from..=from + time {
            rate.handle_pass(ms(at), true, || *left, WINDOW, RTT);
            *left += each;
        }
    }

    #[test]
    fn the_link_rate_is_measured_from_steady_output_under_backlog() {
        let (mut rate, mut left) = (LinkRate::default(), 0);
        run(&mut rate, 0, 99, &mut left, 1_000);
        assert_eq!(rate.get(ms(99)), None, "one measure");
        run(&mut rate, 100, 0, &mut left, 1_000);
        assert_eq!(rate.get(ms(100)), Some(1e6));
        // A slower rate counts too: more than half of the window left in each round trip.
        run(&mut rate, 101, 100, &mut left, 600);
        let slower = rate.get(ms(201)).unwrap();
        assert!((slower - 6e5).abs() < 1e4, "{slower}");
        // A faster rate counts at once.
        run(&mut rate, 202, 50, &mut left, 2_000);
        assert!(rate.get(ms(252)).unwrap() > 1.9e6);
    }

    #[test]
    fn a_link_that_takes_all_is_not_measured() {
        let mut rate = LinkRate::default();
        for at in 0..1_000 {
            rate.handle_pass(ms(at), at % 40 != 0, || at * 1_000, WINDOW, RTT);
        }
        assert_eq!(rate.get(ms(1_000)), None);
    }

    #[test]
    fn output_limited_by_the_peer_or_an_outage_gives_no_link_rate() {
        for each in [0, 100, 499] {
            let (mut rate, mut left) = (LinkRate::default(), 0);
            run(&mut rate, 0, 1_000, &mut left, each);
            assert_eq!(rate.get(ms(1_000)), None, "{each} of a window of 4,000 in 4 ms");
        }
    }

    #[test]
    fn a_link_that_begins_slowly_has_no_rate_until_it_does_not_grow() {
        let (mut rate, mut left, mut each) = (LinkRate::default(), 0, 600);
        let mut at = 0;
        for _ in 0..4 {
            run(&mut rate, at, 49, &mut left, each);
            (at, each) = (at + 50, each * 2);
            assert_eq!(rate.get(ms(at)), None, "at {at} ms");
        }
        run(&mut rate, at, 100, &mut left, each);
        assert!(rate.get(ms(at + 100)).unwrap() > 9e6);
    }

    #[test]
    fn a_long_path_takes_a_longer_measure() {
        let (mut rate, rtt, window) = (LinkRate::default(), ms(100), 250_000);
        let mut pass = |at| rate.handle_pass(ms(at), true, || at * 2_500, window, rtt);
        [0, 399, 400, 799].into_iter().for_each(&mut pass);
        assert_eq!(rate.get(ms(799)), None);
        rate.handle_pass(ms(800), true, || 800 * 2_500, window, rtt);
        assert_eq!(rate.get(ms(800)), Some(2.5e6));
    }

    #[test]
    fn a_rate_is_forgotten_once_the_link_was_not_full_for_long() {
        let (mut rate, mut left) = (LinkRate::default(), 0);
        run(&mut rate, 0, 100, &mut left, 1_000);
        rate.handle_pass(ms(101), false, || left, WINDOW, RTT);
        assert_eq!(rate.get(ms(30_099)), Some(1e6));
        assert_eq!(rate.get(ms(30_100)), None);
    }
}
