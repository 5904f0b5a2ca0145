//! The number of samples that a ring keeps for a QoS profile.

use crate::qos::{Durability, History, Qos, Reliability};

/// The smallest window in samples. It allows for readers that lag by a burst.
pub(crate) const BURST: u64 = 16;

/// Returns how many samples a ring keeps at least for a profile.
#[inline]
pub(crate) fn wanted(qos: &Qos) -> u64 {
    match qos.history {
        History::KeepLast => depth(qos).max(BURST),
        History::KeepAll => BURST,
    }
}

/// Returns the history depth of a profile in samples.
#[inline]
pub(crate) fn depth(qos: &Qos) -> u64 {
    match qos.history {
        History::KeepLast => u64::from(qos.depth.max(1)),
        History::KeepAll => u64::MAX,
    }
}

/// Returns whether a publisher keeps for late joiners everything that fits in its memory.
#[inline]
pub(crate) fn keeps_all(qos: &Qos) -> bool {
    qos.history == History::KeepAll && qos.durability == Durability::TransientLocal
}

/// Returns whether a profile waits rather than lose a sample (RELIABLE and KEEP_ALL).
#[inline]
pub fn holds(qos: &Qos) -> bool {
    qos.reliability == Reliability::Reliable && qos.history == History::KeepAll
}
