//! The number of samples that a ring keeps for a QoS profile.

use crate::qos::{Durability, History, Qos, Reliability};

/// The history that is kept at least, for readers that are late by a burst.
pub(crate) const BURST: u64 = 16;

/// How many samples are kept for a profile at least.
#[inline]
pub(crate) fn wanted(qos: &Qos) -> u64 {
    match qos.history {
        History::KeepLast => depth(qos).max(BURST),
        History::KeepAll => BURST,
    }
}

/// How many samples a profile keeps.
#[inline]
pub(crate) fn depth(qos: &Qos) -> u64 {
    match qos.history {
        History::KeepLast => u64::from(qos.depth.max(1)),
        History::KeepAll => u64::MAX,
    }
}

/// Whether a publisher keeps all that its memory holds for readers that come later.
#[inline]
pub(crate) fn keeps_all(qos: &Qos) -> bool {
    qos.history == History::KeepAll && qos.durability == Durability::TransientLocal
}

/// Whether a profile loses nothing rather than go on.
#[inline]
pub fn holds(qos: &Qos) -> bool {
    qos.reliability == Reliability::Reliable && qos.history == History::KeepAll
}
