//! A rate bucket for samples and their bytes.

use std::time::Duration;

use axon_transport::access::RateLimit;

/// Tolerance for the rounding error of a whole sample.
const ROUNDING: f64 = 1e-6;

/// Minimum time between two samples for which flows wait.
const SHORTEST: Duration = Duration::from_micros(100);

/// The level of a bucket, which refills over time.
#[derive(Clone, Copy, Debug)]
pub(super) struct BucketLevel {
    a_second: f64,
    most: f64,
    /// The amount at `at`. It is negative if more has passed than there was.
    left: f64,
    at: Duration,
}

impl BucketLevel {
    pub(super) fn full(a_second: f64, most: f64) -> Self {
        Self { a_second, most, left: most, at: Duration::ZERO }
    }

    pub(super) fn at(&self, now: Duration) -> f64 {
        let since = now.saturating_sub(self.at).as_secs_f64();
        (self.left + since * self.a_second).min(self.most)
    }

    pub(super) fn take(&mut self, amount: f64, now: Duration) {
        (self.left, self.at) = (self.at(now) - amount, now);
    }

    /// Returns the time at which the level reaches `amount`. That time may have passed.
    pub(super) fn when(&self, amount: f64) -> Duration {
        let missing = amount - self.left;
        if missing <= ROUNDING {
            return self.at;
        }
        self.at + Duration::from_secs_f64(missing / self.a_second)
    }
}

/// A rate bucket. A sample of any length passes if the bucket is open; a long one delays the next sample.
#[derive(Debug)]
pub(super) struct RateBucket {
    samples: Option<BucketLevel>,
    bytes: Option<BucketLevel>,
    /// The length of the last sample that passed.
    last: f64,
}

impl RateBucket {
    /// Creates a full bucket.
    pub(super) fn new(limit: &RateLimit) -> Self {
        let burst = f64::from(limit.burst.get());
        Self {
            samples: limit.rate.map(|rate| BucketLevel::full(rate, burst)),
            // The bucket of bytes holds a hundredth of a second, so that a late timer loses nothing.
            bytes: limit.bytes.map(|bytes| BucketLevel::full(bytes, (bytes / 100.0).max(1.0))),
            last: 1.0,
        }
    }

    /// Returns when the next sample may pass; this time may have passed long ago.
    pub(super) fn open_at(&self) -> Duration {
        let (samples, bytes) = (self.samples.map(|s| s.when(1.0)), self.bytes.map(|b| b.when(1.0)));
        samples.max(bytes).unwrap_or_default()
    }

    /// Returns the time between two samples that are as long as the last one.
    pub(super) fn interval(&self) -> Duration {
        let samples = self.samples.map(|level| 1.0 / level.a_second);
        let bytes = self.bytes.map(|level| self.last / level.a_second);
        let seconds = samples.unwrap_or(0.0).max(bytes.unwrap_or(0.0));
        Duration::from_secs_f64(seconds).max(SHORTEST)
    }

    /// Returns how many samples may pass now, if they are as long as the last one.
    pub(super) fn passes(&self, now: Duration) -> usize {
        if self.open_at() > now {
            return 0;
        }
        let samples = self.samples.map_or(f64::MAX, |level| level.at(now) + ROUNDING);
        let bytes = self.bytes.map_or(f64::MAX, |level| (level.at(now) / self.last).ceil());
        (samples.min(bytes) as usize).max(1)
    }

    /// Records that a sample of this length passes.
    pub(super) fn pass(&mut self, length: usize, now: Duration) {
        let length = length as f64;
        if let Some(level) = &mut self.samples {
            level.take(1.0, now);
        }
        if let Some(level) = &mut self.bytes {
            level.take(length, now);
        }
        self.last = length.max(1.0);
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU32;

    use axon_transport::access::AccessRules;
    use proptest::prelude::*;

    use super::*;

    fn limit(rate: Option<f64>, bytes: Option<f64>, burst: u32) -> RateLimit {
        let rules = AccessRules::parse("[[limit]]\npeer = \"*\"\nrate = 1\n", "f").unwrap();
        let permissions = rules.permissions(axon_transport::access::Principal::Name("x"));
        let placed = permissions.limits(axon_transport::access::Verb::Publish, "/t").next();
        let mut limit = placed.unwrap().limit.clone();
        (limit.rate, limit.bytes, limit.burst) = (rate, bytes, NonZeroU32::new(burst).unwrap());
        limit
    }

    impl RateBucket {
        fn wait(&self, now: Duration) -> Duration {
            self.open_at().saturating_sub(now)
        }
    }

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn a_burst_passes_at_once_and_then_one_for_each_interval() {
        let mut bucket = RateBucket::new(&limit(Some(10.0), None, 3));
        assert_eq!(bucket.passes(ms(5)), 3);
        (0..3).for_each(|_| bucket.pass(1000, ms(5)));
        assert_eq!(bucket.passes(ms(5)), 0);
        assert!((ms(100)..ms(101)).contains(&bucket.wait(ms(5))));
        assert_eq!(bucket.passes(ms(105)), 1);
        bucket.pass(1000, ms(105));
        assert!((ms(50)..ms(51)).contains(&bucket.wait(ms(155))));
        // A long pause fills the bucket with one burst, and no more.
        assert_eq!(bucket.passes(ms(100_000)), 3);
    }

    #[test]
    fn a_sample_longer_than_a_second_of_bytes_passes_and_is_made_up_for() {
        let mut bucket = RateBucket::new(&limit(None, Some(1e6), 1));
        bucket.pass(3_000_000, ms(0));
        assert_eq!(bucket.passes(ms(2900)), 0);
        assert_eq!(bucket.passes(ms(3000)), 1);
    }

    proptest! {
        /// A sender that waits until the bucket opens sends as much as the limit allows, and no more.
        #[test]
        fn a_rate_bucket_passes_as_much_as_its_limit_allows(
            rate in 0.5_f64..2000.0,
            bytes in proptest::option::of(1e3_f64..1e7),
            burst in 1_u32..20,
            lengths in proptest::collection::vec(0_usize..100_000, 1..50),
        ) {
            let mut bucket = RateBucket::new(&limit(Some(rate), bytes, burst));
            let (mut now, mut samples, mut sum) = (Duration::ZERO, 0_u32, 0.0);
            for length in lengths.iter().cycle().take(400) {
                let wait = bucket.wait(now);
                prop_assert_eq!(wait.is_zero(), bucket.passes(now) > 0);
                now += wait;
                prop_assert!(bucket.wait(now).is_zero(), "{:?} after {:?}", bucket.wait(now), wait);
                bucket.pass(*length, now);
                samples += 1;
                sum += *length as f64;
                let most = f64::from(burst) + now.as_secs_f64() * rate + 0.01;
                prop_assert!(f64::from(samples) <= most, "{} of {}", samples, most);
                if let Some(bytes) = bytes {
                    let most = bytes * (now.as_secs_f64() + 0.01) + 100_001.0;
                    prop_assert!(sum <= most, "{} of {}", sum, most);
                }
            }
            let longest = f64::from(samples) / rate + bytes.map_or(0.0, |bytes| sum / bytes);
            prop_assert!(now.as_secs_f64() <= longest + 0.1, "{:?} of {}", now, longest);
        }
    }
}
