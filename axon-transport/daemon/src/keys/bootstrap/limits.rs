//! Limits the `dec_keys` calls that handshakes can cause, because any client can invent an identity.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv6Addr},
    time::Duration,
};

use crate::token_bucket::TokenBucket;

/// Most calls in flight for handshakes.
pub(super) const IN_FLIGHT: usize = 16;
/// Calls in flight that are reserved for addresses that authenticated before.
pub(super) const RESERVED_IN_FLIGHT: usize = 8;
/// Most calls in flight for one source and SAE.
pub(super) const PER_SOURCE: usize = 2;
/// Most calls per second for one SAE.
const RATE: u32 = 5;
/// Most calls at once for one SAE.
const BURST: u32 = 10;

/// The source of a handshake. An IPv6 host can choose from a whole /64, so a /64 counts as one source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct HandshakeSource(IpAddr);

impl From<IpAddr> for HandshakeSource {
    fn from(address: IpAddr) -> Self {
        Self(match address.to_canonical() {
            IpAddr::V6(a) => {
                let [a, b, c, d, ..] = a.segments();
                IpAddr::V6(Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0))
            }
            v4 => v4,
        })
    }
}

/// Proofs that a peer may fail from one source before it has to wait.
const FAILED_PROOFS: u32 = 4;
/// The first wait, which doubles, and the longest wait.
const PROOF_PAUSE: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));
/// Most remembered pairs of source and SAE with failed proofs.
const UNPROVEN: usize = 1024;

/// Failed proofs by source and SAE: each one costs a key.
#[derive(Default)]
pub(super) struct ProofBackoff(HashMap<(HandshakeSource, String), FailedProofs>);

struct FailedProofs {
    failed: u32,
    until: Duration,
}

impl ProofBackoff {
    /// Counts a failed proof.
    pub(super) fn failed(&mut self, now: Duration, source: HandshakeSource, sae: &str) {
        let key = (source, sae.to_owned());
        if self.0.len() >= UNPROVEN && !self.0.contains_key(&key) {
            let first = self.0.iter().min_by_key(|(_, tries)| tries.until).map(|(k, _)| k.clone());
            first.and_then(|first| self.0.remove(&first));
        }
        let tries = self.0.entry(key).or_insert(FailedProofs { failed: 0, until: now });
        tries.failed = tries.failed.saturating_add(1);
        let over = tries.failed.saturating_sub(FAILED_PROOFS);
        if over > 0 {
            let pause = PROOF_PAUSE.0 * (1 << (over - 1).min(10));
            tries.until = now.saturating_add(pause.min(PROOF_PAUSE.1));
        }
    }

    /// Handles a successful proof, which compensates a failed one.
    pub(super) fn proven(&mut self, source: HandshakeSource, sae: &str) {
        let key = (source, sae.to_owned());
        if let Some(tries) = self.0.get_mut(&key) {
            tries.failed -= 1;
            if tries.failed == 0 {
                self.0.remove(&key);
            }
        }
    }

    /// Returns whether this source and SAE have to wait.
    pub(super) fn waits(&self, now: Duration, source: HandshakeSource, sae: &str) -> bool {
        let tries = self.0.get(&(source, sae.to_owned()));
        tries.is_some_and(|tries| now < tries.until)
    }

    /// Forgets entries whose wait ended long ago.
    pub(super) fn expire(&mut self, now: Duration) {
        self.0.retain(|_, tries| now < tries.until.saturating_add(2 * PROOF_PAUSE.1));
    }
}

/// Token buckets by name. A full bucket is equivalent to none.
#[derive(Default)]
pub(super) struct Buckets(HashMap<String, TokenBucket>);

impl Buckets {
    /// Returns whether `name` may make another call now. The caller bounds the set of names.
    pub(super) fn take(&mut self, now: Duration, name: &str) -> bool {
        if let Some(bucket) = self.0.get_mut(name) {
            return bucket.take(now);
        }
        self.0.entry(name.to_owned()).or_insert(TokenBucket::new(BURST, RATE)).take(now)
    }

    /// Removes the full buckets.
    pub(super) fn expire(&mut self, now: Duration) {
        self.0.retain(|_, bucket| !bucket.is_full(now));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bucket_gives_its_burst_then_its_rate() {
        let mut buckets = Buckets::default();
        let mut given = |millis: u64| {
            let now = Duration::from_millis(millis);
            (0..100).filter(|_| buckets.take(now, "sae-a")).count()
        };
        assert_eq!(given(0), 10);
        assert_eq!(given(100), 0);
        assert_eq!(given(1000), 5);
        assert_eq!(given(100_000), 10, "never more than the burst");
        assert!(buckets.take(Duration::ZERO, "sae-b"), "another name has its own");
        buckets.expire(Duration::from_secs(200));
        assert!(buckets.0.is_empty());
    }

    #[test]
    fn failed_proofs_are_throttled_per_source_and_a_success_restores_one() {
        let source = |a: &str| HandshakeSource::from(a.parse::<IpAddr>().unwrap());
        let (here, there) = (source("10.0.0.1"), source("10.0.0.2"));
        let mut unproven = ProofBackoff::default();
        let mut now = Duration::ZERO;
        let mut pauses = Vec::new();
        for _ in 0..12 {
            unproven.failed(now, here, "sae-a");
            let start = now;
            while unproven.waits(now, here, "sae-a") {
                now += Duration::from_secs(1);
            }
            pauses.push((now - start).as_secs());
        }
        assert_eq!(pauses, [0, 0, 0, 0, 1, 2, 4, 8, 16, 32, 60, 60]);
        unproven.failed(now, here, "sae-a");
        assert!(!unproven.waits(now, there, "sae-a") && !unproven.waits(now, here, "sae-b"));
        for _ in 0..13 {
            unproven.proven(here, "sae-a");
        }
        assert!(!unproven.waits(now, here, "sae-a"));
        for i in 0..3000 {
            unproven.failed(now, here, &format!("sae-{i}"));
            assert!(unproven.0.len() <= UNPROVEN);
        }
        unproven.expire(now + Duration::from_secs(300));
        assert!(unproven.0.is_empty());
    }

    #[test]
    fn an_ipv6_network_is_one_source() {
        let source = |a: &str| HandshakeSource::from(a.parse::<IpAddr>().unwrap());
        assert_eq!(source("2001:db8::1"), source("2001:db8::ffff:1:2:3"));
        assert_ne!(source("2001:db8::1"), source("2001:db8:0:1::1"));
        assert_ne!(source("10.0.0.1"), source("10.0.0.2"));
        assert_eq!(source("::ffff:10.0.0.1"), source("10.0.0.1"));
    }
}
