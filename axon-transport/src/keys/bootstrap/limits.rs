//! What made-up identities may cost: bounds on the `dec_keys` calls that handshakes cause.

use std::{
    collections::HashMap,
    net::{IpAddr, Ipv6Addr},
    time::Duration,
};

/// Calls in flight for handshakes.
pub(super) const IN_FLIGHT: usize = 16;
/// Those of them that only addresses which authenticated before may use.
pub(super) const KEPT: usize = 8;
/// Calls in flight for one source and SAE.
pub(super) const PER_SOURCE: usize = 2;
/// Calls a second for one SAE.
const RATE: f64 = 5.0;
/// Calls at once for one SAE.
const BURST: f64 = 10.0;

/// Where a handshake comes from. An IPv6 host has a whole /64 to choose from, so that counts as
/// one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Source(IpAddr);

impl From<IpAddr> for Source {
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

/// Token buckets by name. A bucket that is full again is no different from none.
#[derive(Default)]
pub(super) struct Buckets(HashMap<String, Bucket>);

struct Bucket {
    tokens: f64,
    at: Duration,
}

impl Buckets {
    /// Whether `name` may make another call now. The caller bounds the set of names.
    pub(super) fn take(&mut self, now: Duration, name: &str) -> bool {
        if !self.0.contains_key(name) {
            self.0.insert(name.to_owned(), Bucket { tokens: BURST, at: now });
        }
        let Some(bucket) = self.0.get_mut(name) else { return false };
        bucket.refill(now);
        let allowed = bucket.tokens >= 1.0;
        if allowed {
            bucket.tokens -= 1.0;
        }
        allowed
    }

    /// Drops the full ones.
    pub(super) fn expire(&mut self, now: Duration) {
        self.0.retain(|_, bucket| {
            bucket.refill(now);
            bucket.tokens < BURST
        });
    }
}

impl Bucket {
    fn refill(&mut self, now: Duration) {
        let gained = now.saturating_sub(self.at).as_secs_f64() * RATE;
        self.tokens = (self.tokens + gained).min(BURST);
        self.at = now;
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
    fn an_ipv6_network_is_one_source() {
        let source = |a: &str| Source::from(a.parse::<IpAddr>().unwrap());
        assert_eq!(source("2001:db8::1"), source("2001:db8::ffff:1:2:3"));
        assert_ne!(source("2001:db8::1"), source("2001:db8:0:1::1"));
        assert_ne!(source("10.0.0.1"), source("10.0.0.2"));
        assert_eq!(source("::ffff:10.0.0.1"), source("10.0.0.1"));
    }
}
