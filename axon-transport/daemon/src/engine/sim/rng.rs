//! Independent generators from one seed.

use rand::{Rng, SeedableRng, rngs::Xoshiro256PlusPlus};

/// The simulator's generator. `rand` guarantees its values over releases and platforms. A minor release may change how
/// `random_range` and similar functions use them; then old seeds give other runs.
pub(crate) type SimRng = Xoshiro256PlusPlus;

/// Purpose of a generator. Generators for different purposes are independent, so an additional draw for one
/// of them leaves the others as they were: a shortened script meets the same packet losses elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stream {
    /// Generates a script of faults.
    Script,
    /// Packets from one interface to another.
    Link { from: u32, to: u32 },
    /// One start of a host's daemon, its QUIC endpoint included.
    Host { host: u32, start: u32 },
    /// The application on a host: sizes and times of its samples.
    Workload { host: u32 },
}

/// Returns the generator for `stream` of the run `seed`.
pub(crate) fn stream(seed: u64, stream: Stream) -> SimRng {
    let pair = |high: u32, low: u32| (u64::from(high) << 32) | u64::from(low);
    let (purpose, index) = match stream {
        Stream::Script => (1, 0),
        Stream::Link { from, to } => (2, pair(from, to)),
        Stream::Host { host, start } => (3, pair(host, start)),
        Stream::Workload { host } => (4, u64::from(host)),
    };
    // Each level draws before it mixes in the next number: equal sums of seed and index stay apart.
    let key = SimRng::seed_from_u64(seed).next_u64() ^ purpose;
    let key = SimRng::seed_from_u64(key).next_u64() ^ index;
    SimRng::seed_from_u64(key)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn streams_are_reproducible_and_distinct() {
        let mut streams = vec![Stream::Script];
        for n in 0..50 {
            streams.push(Stream::Workload { host: n });
            streams.push(Stream::Host { host: n, start: 0 });
            streams.push(Stream::Host { host: 0, start: n + 1 });
            streams.push(Stream::Link { from: n, to: n + 1 });
            streams.push(Stream::Link { from: n + 1, to: n });
        }
        let mut seen = BTreeSet::new();
        for seed in [0, 1, 2, u64::MAX] {
            for of in &streams {
                let value = stream(seed, *of).next_u64();
                assert_eq!(stream(seed, *of).next_u64(), value);
                assert!(seen.insert(value), "{of:?} of seed {seed} repeats another stream");
            }
        }
    }

    #[test]
    fn values_stay_the_same_over_releases() {
        let mut rng = stream(7, Stream::Link { from: 1, to: 2 });
        assert_eq!(rng.next_u64(), 6_110_953_760_791_698_427);
    }
}
