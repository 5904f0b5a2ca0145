//! The times in a ring's header: the publisher's lifespan and lease, and when it last published or asserted
//! its liveliness. Nanoseconds of CLOCK_MONOTONIC, which all processes of a host share.

use std::time::Duration;

use crate::{
    qos::{Qos, nanoseconds::nanoseconds},
    ring::layout::ring,
    sync::{Ordering, Word},
};

/// What a reader sees of its publisher's times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Times {
    /// The lease that it offers; `None` never ends.
    pub lease: Option<u64>,
    /// The age at which its samples are not delivered any more.
    pub lifespan: Option<u64>,
    /// When it last said that it is alive, if it ever did.
    pub asserted: Option<u64>,
    /// When it last published, if its deadline is finite and it ever did.
    pub sampled: Option<u64>,
}

/// Writes what is offered into the header of a new ring.
pub(crate) fn offer(words: &[impl Word], qos: &Qos) {
    // 0 is not a time, but the shortest that there is comes to the same.
    let period = |period: Option<Duration>| period.map_or(0, |period| nanoseconds(period).max(1));
    words[ring::LEASE].store(period(qos.lease), Ordering::Relaxed);
    words[ring::LIFESPAN].store(period(qos.lifespan), Ordering::Relaxed);
}

/// The words stand for nothing but themselves, so that nothing need be ordered with them.
pub(crate) fn read(words: &[impl Word]) -> Times {
    let time = |word: usize| Some(words[word].load(Ordering::Relaxed)).filter(|time| *time != 0);
    Times {
        lease: time(ring::LEASE),
        lifespan: time(ring::LIFESPAN),
        asserted: time(ring::ASSERTED),
        sampled: time(ring::SAMPLED),
    }
}
