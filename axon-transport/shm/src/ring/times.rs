//! The times in a ring's header: the publisher's lifespan and lease, and when it last published or asserted
//! its liveliness. Nanoseconds of CLOCK_MONOTONIC, which all processes of a host share.

use std::time::Duration;

use crate::{
    qos::{Qos, nanoseconds::nanoseconds},
    ring::layout::ring,
    sync::{Ordering, Word},
};

/// The times of a publisher as its readers see them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Times {
    /// The offered lease; `None` if it is infinite.
    pub lease: Option<u64>,
    /// The age at which samples are no longer delivered; `None` if it is infinite.
    pub lifespan: Option<u64>,
    /// When the publisher last asserted its liveliness; `None` if it never did.
    pub asserted: Option<u64>,
    /// When the publisher last published; `None` if its deadline is infinite or it never published.
    pub sampled: Option<u64>,
}

/// Writes the offered lease and lifespan into the header of a new ring.
pub(crate) fn offer(words: &[impl Word], qos: &Qos) {
    // 0 means infinite. A period of 0 becomes 1 ns, which has the same effect.
    let period = |period: Option<Duration>| period.map_or(0, |period| nanoseconds(period).max(1));
    words[ring::LEASE].store(period(qos.lease), Ordering::Relaxed);
    words[ring::LIFESPAN].store(period(qos.lifespan), Ordering::Relaxed);
}

/// Reads the times. Each word is independent of other memory, so relaxed loads suffice.
pub(crate) fn read(words: &[impl Word]) -> Times {
    let time = |word: usize| Some(words[word].load(Ordering::Relaxed)).filter(|time| *time != 0);
    Times {
        lease: time(ring::LEASE),
        lifespan: time(ring::LIFESPAN),
        asserted: time(ring::ASSERTED),
        sampled: time(ring::SAMPLED),
    }
}
