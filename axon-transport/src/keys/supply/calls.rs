//! When to ask the KME for more, and for how many.

use std::time::Duration;

use crate::keys::request::{Answer, FailureKind, Purpose, Request};

/// Most keys a call asks for: what a call that is cut off can lose.
const PER_CALL: u32 = 8;
/// Calls for keys in flight.
const IN_FLIGHT: usize = 4;
/// How long a call may take.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Time between two looks at the stock.
pub(super) const STATUS_EVERY: Duration = Duration::from_secs(5);
/// First wait after a failure that cost nothing, and after one that may have cost keys.
const PAUSE: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(1));
/// Longest waits after such failures.
const PAUSE_MAX: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(30));

/// Pause after a key that the peer could not use, first and longest. Doubles with every
/// [`REFUSALS`] of them that no READY makes up for: each costs a key that is gone for good.
const REFUSED: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));
/// See [`REFUSED`].
const REFUSALS: u32 = 4;
/// Refusals that are remembered, so that a peer that is well again is served again soon.
const REFUSALS_MAX: u32 = 40;

/// The calls of one sending direction.
pub(super) struct Calls {
    /// Keys asked for, a number for each call in flight.
    in_flight: Vec<u32>,
    /// Keys a call asks for: halved when an empty store refuses, since a smaller number may be had.
    size: u32,
    failures: u32,
    not_before: Duration,
    /// Keys that the peer refused, less those that it readied.
    refusals: u32,
    /// The pause that follows from them.
    refused_until: Duration,
    /// Since when keys were wanted without an answer.
    waiting_since: Option<Duration>,
    status_at: Duration,
    status_asked: bool,
}

impl Calls {
    pub(super) fn new() -> Self {
        Self {
            in_flight: Vec::new(),
            size: PER_CALL,
            failures: 0,
            not_before: Duration::ZERO,
            refusals: 0,
            refused_until: Duration::ZERO,
            waiting_since: None,
            status_at: Duration::ZERO,
            status_asked: false,
        }
    }

    pub(super) fn keys_asked(&self) -> usize {
        self.in_flight.iter().map(|&n| n as usize).sum()
    }

    /// The peer could not use a key, or did not answer for it.
    pub(super) fn key_refused(&mut self, now: Duration) {
        self.refusals = (self.refusals + 1).min(REFUSALS_MAX);
        let pause = (REFUSED.0 * (1 << (self.refusals / REFUSALS))).min(REFUSED.1);
        self.refused_until = self.refused_until.max(now + pause);
    }

    /// The peer readied a key.
    pub(super) fn key_ready(&mut self) {
        self.refusals = self.refusals.saturating_sub(1);
    }

    /// The next call, when `missing` keys are neither held nor (as counted here) asked for.
    pub(super) fn poll(
        &mut self,
        now: Duration,
        peer: &str,
        missing: usize,
        per_call: u32,
    ) -> Option<Request> {
        if !self.status_asked && now >= self.status_at {
            self.status_asked = true;
            return Some(Request::Status { slave: peer.to_owned() });
        }
        let missing = missing.saturating_sub(self.keys_asked());
        if missing == 0 {
            if self.in_flight.is_empty() {
                self.waiting_since = None;
            }
            return None;
        }
        self.waiting_since.get_or_insert(now);
        if self.in_flight.len() >= IN_FLIGHT || now < self.begins() {
            return None;
        }
        let number = self.size.min(per_call).min(missing.try_into().unwrap_or(PER_CALL)).max(1);
        self.in_flight.push(number);
        Some(Request::Enc {
            slave: peer.to_owned(),
            number,
            purpose: Purpose::Messages,
            timeout: TIMEOUT,
        })
    }

    /// Takes note of an answer: how long keys were waited for, or nothing for an answer to none of
    /// these calls.
    pub(super) fn answered(&mut self, now: Duration, answer: &Answer) -> Option<Duration> {
        let number = match &answer.request {
            Request::Status { .. } => {
                self.status_asked = false;
                self.status_at = now + STATUS_EVERY;
                return answer.outcome.is_ok().then_some(Duration::ZERO);
            }
            Request::Enc { number, .. } => number,
            Request::Dec { .. } => return None,
        };
        let i = self.in_flight.iter().position(|n| n == number)?;
        self.in_flight.swap_remove(i);
        match &answer.outcome {
            Ok(_) => {
                self.failures = 0;
                self.not_before = now;
                self.size = (self.size * 2).min(PER_CALL);
            }
            Err(failure) => {
                let lost = failure.kind == FailureKind::Ambiguous;
                let (first, longest) =
                    if lost { (PAUSE.1, PAUSE_MAX.1) } else { (PAUSE.0, PAUSE_MAX.0) };
                self.not_before = now + (first * (1 << self.failures.min(10))).min(longest);
                self.failures += 1;
                if matches!(failure.kind, FailureKind::Unavailable | FailureKind::Refused) {
                    self.size = (self.size / 2).max(1);
                }
            }
        }
        Some(now.saturating_sub(self.waiting_since.replace(now).unwrap_or(now)))
    }

    fn begins(&self) -> Duration {
        self.not_before.max(self.refused_until)
    }

    /// When [`poll`](Self::poll) may give something without an answer before.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let status = (!self.status_asked).then_some(self.status_at);
        let keys = self.waiting_since.filter(|_| self.in_flight.is_empty()).map(|_| self.begins());
        [status, keys].into_iter().flatten().min()
    }
}
