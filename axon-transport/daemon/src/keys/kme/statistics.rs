//! Counts requests to the KME and keys from it, for the status.

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use serde::Serialize;

use crate::keys::request::{FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure};

/// Maximum number of peers whose stock is shown.
const MAX_PEERS: usize = 256;

/// Counters of the KME's calls and answers since the start.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Statistics {
    /// Calls of `enc_keys`.
    pub enc_keys: CallStatistics,
    /// Calls of `dec_keys`.
    pub dec_keys: CallStatistics,
    /// Calls of `status`.
    pub status: CallStatistics,
    /// Keys fetched for dials.
    pub keys_bootstrap: u64,
    /// Keys fetched for incoming handshakes.
    pub keys_accept: u64,
    /// Keys fetched for the proof of a client's name.
    pub keys_proof: u64,
    /// Keys fetched for envelopes.
    pub keys_messages: u64,
    /// Keys of `enc_keys` calls that were cut off: the KME may have handed them out.
    pub keys_possibly_lost: u64,
    /// Number of stored keys by peer, from the KME's last answer.
    pub stored_key_count: BTreeMap<String, u64>,
    /// The last failure, of any call.
    pub last_failure: Option<String>,
}

/// Statistics of one kind of call.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct CallStatistics {
    /// Number of calls.
    pub calls: u64,
    /// Number of these calls that failed.
    pub failures: u64,
    /// Recent mean time to the answer, over successful calls.
    pub latency_ms: Option<f64>,
}

impl Statistics {
    /// Returns the number of keys fetched for any purpose.
    pub fn keys(&self) -> u64 {
        self.keys_bootstrap + self.keys_accept + self.keys_proof + self.keys_messages
    }
}

/// Collects [`Statistics`] from calls that run side by side.
#[derive(Default)]
pub(super) struct Recorder(Mutex<Statistics>);

impl Recorder {
    pub(super) fn record(
        &self,
        request: &KmeRequest,
        took: Duration,
        outcome: &Result<Fetched, RequestFailure>,
    ) {
        let mut guard = self.lock();
        let s = &mut *guard;
        let call = match request {
            KmeRequest::Enc { .. } => &mut s.enc_keys,
            KmeRequest::Dec { .. } => &mut s.dec_keys,
            KmeRequest::Status { .. } => &mut s.status,
        };
        call.calls += 1;
        match outcome {
            Ok(_) => {
                let new = took.as_secs_f64() * 1e3;
                call.latency_ms = Some(call.latency_ms.map_or(new, |old| old + (new - old) / 8.0));
            }
            Err(failure) => {
                call.failures += 1;
                s.last_failure = Some(failure.text.clone());
            }
        }
        match (request, outcome) {
            (
                KmeRequest::Enc { purpose, .. } | KmeRequest::Dec { purpose, .. },
                Ok(Fetched::Keys(k)),
            ) => {
                *match purpose {
                    KeyPurpose::Bootstrap => &mut s.keys_bootstrap,
                    KeyPurpose::Accept => &mut s.keys_accept,
                    KeyPurpose::Proof => &mut s.keys_proof,
                    KeyPurpose::Messages => &mut s.keys_messages,
                } += k.len() as u64;
            }
            (KmeRequest::Enc { number, .. }, Err(f)) if f.kind == FailureKind::Ambiguous => {
                s.keys_possibly_lost += u64::from(*number);
            }
            (KmeRequest::Status { slave }, Ok(Fetched::Stock(stock)))
                if s.stored_key_count.contains_key(slave)
                    || s.stored_key_count.len() < MAX_PEERS =>
            {
                s.stored_key_count.insert(slave.clone(), stock.stored_key_count);
            }
            _ => {}
        }
    }

    pub(super) fn statistics(&self) -> Statistics {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, Statistics> {
        // The counters stay consistent even if a thread panicked while it held the lock.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
