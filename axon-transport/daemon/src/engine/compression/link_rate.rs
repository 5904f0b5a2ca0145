//! The rate at which a link carries data, where more waits than it carries.

use std::time::Duration;

/// A measure takes so long at least, and so many round trips: what the window lets leave at once is a small part then.
const SPAN: (Duration, u32) = (Duration::from_millis(50), 4);
/// A rate is believed for so long. What is compressed may leave the link idle, so nothing would measure it again.
const BELIEVED: Duration = Duration::from_secs(30);

/// Measures the rate of one link.
#[derive(Debug, Default)]
pub(crate) struct LinkRate {
    /// When the measure began, and how many bytes had left by then.
    begun: Option<(Duration, u64)>,
    /// Bytes a second, and when they were measured.
    measured: Option<(f64, Duration)>,
}

impl LinkRate {
    /// A pass ended in which QUIC did not take all that there was, if the link `is_full`.
    pub(crate) fn handle_pass(
        &mut self,
        is_full: bool,
        left: impl Fn() -> u64,
        rtt: Duration,
        now: Duration,
    ) {
        if !is_full {
            self.begun = None;
            return;
        }
        let Some((since, before)) = self.begun else {
            self.begun = Some((now, left()));
            return;
        };
        let span = now.saturating_sub(since);
        if span >= SPAN.0.max(rtt * SPAN.1) {
            let left = left();
            self.measured = Some((left.saturating_sub(before) as f64 / span.as_secs_f64(), now));
            self.begun = Some((now, left));
        }
    }

    /// Bytes a second that the link carries, if it was full lately.
    pub(crate) fn get(&self, now: Duration) -> Option<f64> {
        let (rate, at) = self.measured?;
        (now.saturating_sub(at) < BELIEVED).then_some(rate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RTT: Duration = Duration::from_millis(3);

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn the_rate_is_what_leaves_while_more_waits() {
        let mut rate = LinkRate::default();
        for at in 0..50 {
            rate.handle_pass(true, || at * 1_000, RTT, ms(at));
            assert_eq!(rate.get(ms(at)), None, "at {at} ms");
        }
        rate.handle_pass(true, || 50_000, RTT, ms(50));
        assert_eq!(rate.get(ms(50)), Some(1e6));
        // Slower from then on.
        rate.handle_pass(true, || 55_000, RTT, ms(100));
        assert_eq!(rate.get(ms(100)), Some(1e5));
    }

    #[test]
    fn a_link_that_takes_all_is_not_measured() {
        let mut rate = LinkRate::default();
        for at in 0..1_000 {
            rate.handle_pass(at % 40 != 0, || at * 1_000, RTT, ms(at));
        }
        assert_eq!(rate.get(ms(1_000)), None);
    }

    #[test]
    fn a_long_path_takes_a_longer_measure() {
        let mut rate = LinkRate::default();
        let rtt = ms(100);
        rate.handle_pass(true, || 0, rtt, ms(0));
        rate.handle_pass(true, || 1_000_000, rtt, ms(399));
        assert_eq!(rate.get(ms(399)), None);
        rate.handle_pass(true, || 1_000_000, rtt, ms(400));
        assert_eq!(rate.get(ms(400)), Some(2.5e6));
    }

    #[test]
    fn a_rate_is_forgotten_once_the_link_was_not_full_for_long() {
        let mut rate = LinkRate::default();
        rate.handle_pass(true, || 0, RTT, ms(0));
        rate.handle_pass(true, || 50_000, RTT, ms(50));
        rate.handle_pass(false, || 50_000, RTT, ms(60));
        assert_eq!(rate.get(ms(30_049)), Some(1e6));
        assert_eq!(rate.get(ms(30_050)), None);
    }
}
