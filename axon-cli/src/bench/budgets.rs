//! The most that AXON may take, as ratios to the raw limit in the same run.

use crate::bench::harness::{Load, Motion, Wake};

/// The most bytes that a descriptor holds.
const INLINE: usize = 88;
/// The smallest message for which the bytes alone decide the cost of a copy.
const BYTES_ALONE: usize = 16 << 10;

/// The most that a publish to sixteen reader processes may take, divided by a publish to one. Wake-ups do not count.
pub(super) const SIXTEEN_READERS: f64 = 1.3;

/// The smallest rate of messages, divided by that of bare quinn.
pub(super) const OF_QUINN: f64 = 0.85;
/// The most processor time of a message, divided by that of bare quinn.
pub(super) const CPU_BY_QUINN: f64 = 1.25;

/// Returns the largest permitted ratio of the latency to the raw limit's. Returns `None` for a load without a budget.
pub(super) fn latency(load: &Load) -> Option<f64> {
    match (load.wake, load.motion) {
        (Wake::Poll, Motion::Copy) if load.size <= INLINE => Some(1.3),
        (Wake::Poll, Motion::Copy) if load.size >= BYTES_ALONE => Some(1.05),
        (Wake::Poll, Motion::Touch) => Some(2.5),
        (Wake::Event | Wake::EventOneCpu, Motion::Touch) => Some(1.1),
        _ if load.pace.is_some() => Some(1.1),
        _ => None,
    }
}

/// Rounds a ratio to thousandths, as reports show it.
pub(super) fn rounded(ratio: f64) -> f64 {
    (ratio * 1e3).round() / 1e3
}

/// Returns whether a ratio is within a budget after both are rounded. A ratio that is shown as 1.05 is within 1.05.
pub(super) fn is_met(ratio: f64, budget: f64) -> bool {
    rounded(ratio) <= rounded(budget)
}

/// Returns the text that reports show beside a budget.
pub(super) fn verdict(ratio: f64, budget: f64) -> &'static str {
    if is_met(ratio, budget) { "met" } else { "not met" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_budget_has_its_loads() {
        let of = |size, wake, motion| latency(&Load::ping_pong(size, wake, motion));
        for size in [8, 88] {
            assert_eq!(of(size, Wake::Poll, Motion::Copy), Some(1.3));
        }
        assert_eq!(of(89, Wake::Poll, Motion::Copy), None);
        assert_eq!(of(16 << 10, Wake::Poll, Motion::Copy), Some(1.05));
        for size in [8, 25_000_000] {
            assert_eq!(of(size, Wake::Poll, Motion::Touch), Some(2.5));
            assert_eq!(of(size, Wake::Event, Motion::Touch), Some(1.1));
            assert_eq!(of(size, Wake::EventOneCpu, Motion::Touch), Some(1.1));
            assert_eq!(of(size, Wake::Poll, Motion::Fill), None);
        }
        let paced = Load::paced(64, Motion::Copy, std::time::Duration::from_millis(1));
        assert_eq!(latency(&paced), Some(1.1));
        assert_eq!(of(64, Wake::Event, Motion::Copy), None);
        assert_eq!((verdict(1.3, 1.3), verdict(1.31, 1.3)), ("met", "not met"));
        // A ratio that is shown as 1.050 is within 1.05. A ratio that is shown as 1.051 is not.
        assert!(is_met(1.0504, 1.05) && !is_met(1.0506, 1.05));
        assert!(is_met(0.85, 0.8496) && !is_met(0.85, 0.8494));
    }
}
