//! What AXON may take at most, as ratios to the raw limit in the same run.

use crate::bench::harness::{Load, Motion, Wake};

/// Bytes that a descriptor holds.
const INLINE: usize = 88;
/// From here on a copy is judged by its bytes alone.
const BYTES_ALONE: usize = 16 << 10;

/// A publish to sixteen reader processes, wake-ups aside, by one to a single one.
pub(super) const SIXTEEN_READERS: f64 = 1.3;

/// Of the messages a second of bare quinn, at least.
pub(super) const OF_QUINN: f64 = 0.85;
/// The processor time of a message, by that of bare quinn.
pub(super) const CPU_BY_QUINN: f64 = 1.25;

/// How many times the latency of the raw limit is allowed.
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

/// A ratio as it is written, in thousandths.
pub(super) fn rounded(ratio: f64) -> f64 {
    (ratio * 1e3).round() / 1e3
}

/// Whether a ratio is within a budget, as far as its digits say: 1.05 that is written is within 1.05.
pub(super) fn is_met(ratio: f64, budget: f64) -> bool {
    rounded(ratio) <= rounded(budget)
}

/// The word for a ratio beside its budget.
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
        // What is written as 1.050 is within 1.05, and 1.051 is not.
        assert!(is_met(1.0504, 1.05) && !is_met(1.0506, 1.05));
        assert!(is_met(0.85, 0.8496) && !is_met(0.85, 0.8494));
    }
}
