//! When a call is repeated, and after which pause.

use std::time::Duration;

/// How often the client itself repeats a call.
///
/// The client repeats a call only after a temporary failure: unreachable, timed out, cut off, 503.
/// The cost of a repeat depends on the call, so each has its own number:
///
/// - `status` only reads and may be repeated freely (default 2).
/// - `dec_keys` that was cut off may have destroyed its keys at the KME; many KMEs give them again
///   for a while (default 1).
/// - `enc_keys` that was cut off may have consumed keys that nobody will use. It is repeated
///   (default 0) only after failures in which the request certainly was not served, unless
///   [`enc_keys_after_ambiguous_failure`](Self::enc_keys_after_ambiguous_failure) is set.
///
/// [`deadline`](crate::ClientBuilder::deadline) limits the whole call with its repeats.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RetryPolicy {
    pub(crate) status: u32,
    pub(crate) dec_keys: u32,
    pub(crate) enc_keys: u32,
    pub(crate) enc_keys_ambiguous: bool,
    pub(crate) pause: Duration,
    pub(crate) pause_max: Duration,
}

impl Default for RetryPolicy {
    fn default() -> Self {
        Self { status: 2, dec_keys: 1, ..Self::none() }
    }
}

impl RetryPolicy {
    /// Returns a policy that makes every call once.
    #[must_use]
    pub const fn none() -> Self {
        Self {
            status: 0,
            dec_keys: 0,
            enc_keys: 0,
            enc_keys_ambiguous: false,
            pause: Duration::from_millis(100),
            pause_max: Duration::from_secs(2),
        }
    }

    /// Sets the repeats of `status`.
    #[must_use]
    pub const fn status(mut self, repeats: u32) -> Self {
        self.status = repeats;
        self
    }

    /// Sets the repeats of `dec_keys`.
    #[must_use]
    pub const fn dec_keys(mut self, repeats: u32) -> Self {
        self.dec_keys = repeats;
        self
    }

    /// Sets the repeats of `enc_keys` after failures in which the request certainly was not served.
    #[must_use]
    pub const fn enc_keys(mut self, repeats: u32) -> Self {
        self.enc_keys = repeats;
        self
    }

    /// Sets whether `enc_keys` is also repeated when the failed attempt may have consumed keys.
    #[must_use]
    pub const fn enc_keys_after_ambiguous_failure(mut self, repeat: bool) -> Self {
        self.enc_keys_ambiguous = repeat;
        self
    }

    /// Sets the pause before the first repeat, which doubles up to `max`. Each pause is drawn
    /// evenly from the upper half of its length. Default 100 ms and 2 s. A `Retry-After` of the KME
    /// applies if it is longer.
    #[must_use]
    pub const fn pause(mut self, first: Duration, max: Duration) -> Self {
        self.pause = first;
        self.pause_max = max;
        self
    }

    /// Returns the pause before repeat number `repeat` (from 0). `jitter` is a random byte.
    pub(crate) fn pause_before(&self, repeat: u32, jitter: u8) -> Duration {
        let full = self.pause.saturating_mul(1 << repeat.min(16)).min(self.pause_max);
        full / 2 + (full / 2).saturating_mul(jitter.into()) / 255
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_the_maximum_and_jitter_in_their_upper_half() {
        let policy =
            RetryPolicy::none().pause(Duration::from_millis(100), Duration::from_millis(300));
        assert_eq!(policy.pause_before(0, 0), Duration::from_millis(50));
        assert_eq!(policy.pause_before(0, 255), Duration::from_millis(100));
        assert_eq!(policy.pause_before(1, 255), Duration::from_millis(200));
        assert_eq!(policy.pause_before(2, 255), Duration::from_millis(300));
        assert_eq!(policy.pause_before(u32::MAX, 255), Duration::from_millis(300));
        let endless = RetryPolicy::none().pause(Duration::MAX, Duration::MAX);
        assert!(endless.pause_before(u32::MAX, 255) >= Duration::MAX / 2);
    }
}
