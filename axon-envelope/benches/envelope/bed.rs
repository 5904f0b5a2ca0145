//! A channel, a key and a clock that all measurements share.

use std::time::{Duration, Instant};

use axon_envelope::aead::Aead;
use axon_envelope::{
    Channel, Delivery, KeyId, Kind, KmeKey, Limits, MESSAGES_PER_KEY, NONCE_LEN, Opener, Route,
    Sealer, TopicHash,
};

use crate::Effort;

pub(crate) const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };
pub(crate) const NOW: Duration = Duration::ZERO;
pub(crate) const PER_KEY: usize = MESSAGES_PER_KEY as usize;
/// Length of the header under [`channel`] and [`key_id`].
pub(crate) const HEADER_LEN: usize = 8 + 3 + 16 + 1 + 11 + 1 + 36 + NONCE_LEN;
/// The AEAD key that follows from [`channel`], [`key_id`] and [`kme_key`]: the first test vector's.
pub(crate) const AEAD_KEY: [u8; 32] = [
    0xf9, 0xdd, 0x3f, 0x79, 0xb4, 0x26, 0xaf, 0x98, 0xc4, 0xb2, 0x34, 0x5d, 0x71, 0x72, 0xb9, 0x28,
    0x1b, 0xe9, 0x13, 0x0b, 0xe6, 0x9e, 0x9a, 0x8b, 0x6f, 0xbd, 0xcc, 0xef, 0x2f, 0x18, 0xa8, 0x43,
];

pub(crate) fn channel() -> Channel {
    let context: [u8; 32] = std::array::from_fn(|at| 0x80 + at as u8);
    Channel::new("sae-robot-a", "sae-robot-b", context).unwrap()
}

pub(crate) fn key_id() -> KeyId {
    KeyId::new("bc490419-7d60-487f-adc1-4ddcc177c139").unwrap()
}

pub(crate) fn kme_key() -> KmeKey {
    KmeKey::take(&mut std::array::from_fn(|at| at as u8))
}

pub(crate) fn sealer<A: Aead>() -> Sealer<A> {
    Sealer::with_nonce_prefix(&channel(), key_id(), kme_key(), [0xa0; 8])
}

pub(crate) fn opener<A: Aead>() -> Opener<A> {
    let mut opener = Opener::with_limits(channel(), Limits::default()).unwrap();
    opener.add_key(key_id(), kme_key()).unwrap();
    opener
}

/// The first `count` envelopes of a sealer, each of `size` bytes of plaintext.
pub(crate) fn envelopes<A: Aead>(count: usize, size: usize) -> Vec<Vec<u8>> {
    let mut sealer = sealer::<A>();
    let plaintext = vec![0x5a; size];
    let seal = |_| {
        let mut envelope = vec![0; HEADER_LEN + size + 16];
        let slot = sealer.slot(NOW, Delivery::Reliable).unwrap();
        slot.seal_into(ROUTE, &[&plaintext], &mut envelope).unwrap();
        envelope
    };
    (0..count).map(seal).collect()
}

/// The nonce in a header of [`HEADER_LEN`] bytes.
pub(crate) fn nonce(header: &[u8]) -> &[u8; NONCE_LEN] {
    header.last_chunk().unwrap()
}

pub(crate) fn time(work: impl FnOnce()) -> Duration {
    let start = Instant::now();
    work();
    start.elapsed()
}

/// Repeats `round` for as long as `effort` says, and returns what it returned each time.
pub(crate) fn repeat<T>(effort: Effort, mut round: impl FnMut(usize) -> T) -> Vec<T> {
    let start = Instant::now();
    let mut results = Vec::new();
    while results.len() < effort.rounds || start.elapsed() < effort.time {
        results.push(round(results.len()));
    }
    results
}

pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

pub(crate) fn least(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}
