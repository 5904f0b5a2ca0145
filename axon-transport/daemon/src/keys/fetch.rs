//! Fetches announced key_IDs with `dec_keys`: retries with the same IDs, then one by one, then gives up.

use std::{collections::VecDeque, time::Duration};

use axon_envelope::{KeyId, KmeKey};

use super::request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure};

/// Number of times that a batch is requested.
const TRIES: u8 = 3;
/// Time between two tries, at least.
const TRY: Duration = Duration::from_secs(2);
/// Maximum pause between two attempts that a KME can ask for: the peer that announced the keys waits, too.
const RETRY_AFTER_MAX: Duration = Duration::from_secs(10);
/// Calls in flight at once.
const IN_FLIGHT: usize = 4;

/// Number of refused calls that a master may cause at once with names that the KME does not know. It exceeds the calls
/// of a restarted receiver with the maximum number of keys. The second constant is the number of further refused calls
/// a second.
const REFUSALS: f64 = 300.0;
const REFUSALS_PER_SECOND: f64 = 5.0;

/// The keys of one master that are being fetched. The caller limits their number.
pub(super) struct Fetches {
    master: String,
    purpose: KeyPurpose,
    waiting: VecDeque<KeyBatch>,
    in_flight: Vec<KeyBatch>,
    /// Refused calls that may still come at once, as of a time.
    refusals: (f64, Duration),
}

struct KeyBatch {
    key_ids: Vec<KeyId>,
    tries_left: u8,
    /// The time at which the batch may be requested; once requested, the time at which it may be requested again.
    not_before: Duration,
}

/// The outcome for one key_ID.
pub(super) type FetchOutcome = (KeyId, Result<KmeKey, RequestFailure>);

impl Fetches {
    pub(super) fn new(master: &str, purpose: KeyPurpose) -> Self {
        let (waiting, in_flight) = Default::default();
        let refusals = (REFUSALS, Duration::ZERO);
        Self { master: master.to_owned(), purpose, waiting, in_flight, refusals }
    }

    /// Starts fetching `key_ids`, which must not be empty or under way already.
    pub(super) fn start(&mut self, now: Duration, key_ids: Vec<KeyId>) {
        self.waiting.push_back(KeyBatch { key_ids, tries_left: TRIES, not_before: now });
    }

    pub(super) fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        if self.in_flight.len() >= IN_FLIGHT || now < self.refusals_allow() {
            return None;
        }
        let due = self.waiting.iter().position(|b| b.not_before <= now)?;
        let mut batch = self.waiting.remove(due)?;
        batch.tries_left -= 1;
        batch.not_before = now + TRY;
        let key_ids = batch.key_ids.clone();
        self.in_flight.push(batch);
        let (master, purpose) = (self.master.clone(), self.purpose);
        Some(KmeRequest::Dec { master, key_ids, purpose })
    }

    /// Returns the outcomes of the keys that `answer` settles. Returns none if the keys are requested again.
    pub(super) fn handle_answer(&mut self, now: Duration, answer: Answer) -> Vec<FetchOutcome> {
        let KmeRequest::Dec { key_ids, .. } = answer.request else { return Vec::new() };
        let Some(i) = self.in_flight.iter().position(|b| b.key_ids == key_ids) else {
            return Vec::new();
        };
        let mut batch = self.in_flight.swap_remove(i);
        let failure = match answer.outcome {
            Ok(Fetched::Keys(keys)) => return given(batch.key_ids, keys),
            Ok(Fetched::Stock(_)) => {
                return failed(batch.key_ids, invalid("the KME answered another call"));
            }
            Err(failure) => failure,
        };
        if failure.kind == FailureKind::Refused {
            let (left, at) = self.refusals;
            let gained = now.saturating_sub(at).as_secs_f64() * REFUSALS_PER_SECOND;
            self.refusals = ((left + gained).min(REFUSALS) - 1.0, now);
        }
        match failure.kind {
            FailureKind::Refused if batch.key_ids.len() > 1 => {
                // One unknown key_ID spoils a batch: the other keys may still be available.
                let single = |key_id| KeyBatch {
                    key_ids: vec![key_id],
                    tries_left: TRIES,
                    not_before: Duration::ZERO,
                };
                self.waiting.extend(batch.key_ids.into_iter().map(single));
                Vec::new()
            }
            kind if kind.is_transient() && batch.tries_left > 0 => {
                batch.not_before += failure.retry_after.unwrap_or_default().min(RETRY_AFTER_MAX);
                self.waiting.push_back(batch);
                Vec::new()
            }
            _ => failed(batch.key_ids, failure),
        }
    }

    /// Returns when [`poll_request`](Self::poll_request) gives a request even if no answer comes before.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let free = self.in_flight.len() < IN_FLIGHT;
        let due = free.then(|| self.waiting.iter().map(|b| b.not_before).min()).flatten();
        due.map(|due| due.max(self.refusals_allow()))
    }

    /// Returns when another call may be refused.
    fn refusals_allow(&self) -> Duration {
        let (left, at) = self.refusals;
        at + Duration::from_secs_f64((1.0 - left).max(0.0) / REFUSALS_PER_SECOND)
    }
}

/// Returns each key_ID with its own key. Other keys in the answer are ignored.
fn given(asked: Vec<KeyId>, mut keys: Vec<(KeyId, KmeKey)>) -> Vec<FetchOutcome> {
    let outcome = |key_id: KeyId| match keys.iter().position(|(id, _)| *id == key_id) {
        Some(i) => (key_id, Ok(keys.swap_remove(i).1)),
        None => (key_id, Err(invalid("the KME's answer does not hold it"))),
    };
    asked.into_iter().map(outcome).collect()
}

fn failed(key_ids: Vec<KeyId>, failure: RequestFailure) -> Vec<FetchOutcome> {
    key_ids.into_iter().map(|key_id| (key_id, Err(failure.clone()))).collect()
}

fn invalid(text: &str) -> RequestFailure {
    RequestFailure::new(FailureKind::Invalid, text)
}
