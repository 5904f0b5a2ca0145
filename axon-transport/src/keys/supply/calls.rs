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

/// The calls of one sending direction.
pub(super) struct Calls {
    /// Keys asked for, a number for each call in flight.
    in_flight: Vec<u32>,
    /// Keys a call asks for: halved when an empty store refuses, since a smaller number may be had.
    size: u32,
    failures: u32,
    not_before: Duration,
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
            waiting_since: None,
            status_at: Duration::ZERO,
            status_asked: false,
        }
    }

    pub(super) fn keys_asked(&self) -> usize {
        self.in_flight.iter().map(|&n| n as usize).sum()
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
        if self.in_flight.len() >= IN_FLIGHT || now < self.not_before {
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

    /// When [`poll`](Self::poll) may give something without an answer before.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let status = (!self.status_asked).then_some(self.status_at);
        let keys =
            self.waiting_since.filter(|_| self.in_flight.is_empty()).map(|_| self.not_before);
        [status, keys].into_iter().flatten().min()
    }
}
