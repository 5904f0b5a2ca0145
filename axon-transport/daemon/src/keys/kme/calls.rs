//! Executes one request as one call of the KME client.

use std::{
    sync::{Mutex, PoisonError},
    time::Instant,
};

use axon_envelope::{KeyId, KmeKey};
use axon_transport::{config::QkdConfig, internal::secrets::LockedKey};
use etsi_qkd014::{Client, Error, KeyContainer};

use super::{
    outage::{Notice, Outages},
    statistics::{Recorder, Statistics},
};
use crate::keys::{
    request::{FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure, Stock},
    used::UsedKeys,
};

/// Bits of a key.
const KEY_SIZE: u32 = 256;

/// Makes calls, and keeps account of them.
pub(super) struct KmeCaller {
    client: Client,
    recorder: Recorder,
    used: UsedKeys,
    outages: Mutex<Outages>,
}

impl KmeCaller {
    pub(super) fn new(client: Client, config: &QkdConfig, used: UsedKeys) -> Self {
        let outages = Mutex::new(Outages::new(&config.kme_url, &config.sae_id));
        Self { client, recorder: Recorder::default(), used, outages }
    }

    /// Runs `request` and records how it went.
    pub(super) async fn run(&self, request: &KmeRequest) -> Result<Fetched, RequestFailure> {
        let start = Instant::now();
        // The client itself enforces AXON_KME_ANSWER_TIMEOUT.
        let outcome = call(&self.client, request).await;
        let (outcome, repeated) = match (request, outcome) {
            (KmeRequest::Enc { purpose, .. }, Ok(Fetched::Keys(keys))) => {
                self.unused(*purpose, keys).await
            }
            (_, outcome) => (outcome, None),
        };
        self.recorder.record(request, start.elapsed(), &outcome);
        let notice = {
            // If a thread panicked while it held the lock, the log contains at worst too many or too few lines.
            let mut outages = self.outages.lock().unwrap_or_else(PoisonError::into_inner);
            let failure = repeated.as_ref().or(outcome.as_ref().err());
            outages.record(Instant::now(), request, failure)
        };
        match notice {
            Some(Notice::Fails(text)) => tracing::warn!("{text}"),
            Some(Notice::Works(text)) => tracing::info!("{text}"),
            None => {}
        }
        outcome
    }

    /// Returns the fresh `keys` that this host never had, and a failure if it had others before. Only messages accept
    /// fewer keys than were requested.
    async fn unused(
        &self,
        purpose: KeyPurpose,
        keys: Vec<(KeyId, KmeKey)>,
    ) -> (Result<Fetched, RequestFailure>, Option<RequestFailure>) {
        let names: Vec<_> =
            keys.iter().map(|(id, _)| String::from_utf8_lossy(id.as_bytes()).into()).collect();
        let used = self.used.clone();
        let recorded = tokio::task::spawn_blocking(move || used.record(&names)).await;
        // The runtime ends: no task is left that could use a key.
        let new = recorded.unwrap_or_else(|_| vec![false; keys.len()]);
        let mut again = None;
        let mut unused = Vec::with_capacity(keys.len());
        for (key, new) in keys.into_iter().zip(new) {
            if new {
                unused.push(key);
            } else {
                again = Some(key.0);
            }
        }
        let failure = again.map(|key_id| {
            let text = format!("the KME gave key_ID {key_id} again, which this host had before");
            RequestFailure::new(FailureKind::Repeated, text)
        });
        match failure {
            Some(failure) if unused.is_empty() || purpose != KeyPurpose::Messages => {
                (Err(failure.clone()), Some(failure))
            }
            failure => (Ok(Fetched::Keys(unused)), failure),
        }
    }

    pub(super) fn statistics(&self) -> Statistics {
        self.recorder.statistics()
    }
}

async fn call(client: &Client, request: &KmeRequest) -> Result<Fetched, RequestFailure> {
    match request {
        KmeRequest::Enc { slave, number, .. } => {
            let enc = client.enc_keys(slave).number(*number).size(KEY_SIZE);
            keys(enc.send().await.map_err(|e| failure(&e))?)
        }
        KmeRequest::Dec { master, key_ids, .. } => {
            let mut names = Vec::with_capacity(key_ids.len());
            for key_id in key_ids {
                names.push(std::str::from_utf8(key_id.as_bytes()).map_err(|_| {
                    RequestFailure::new(FailureKind::Invalid, format!("key_ID {key_id} is no text"))
                })?);
            }
            let dec = client.dec_keys(master).key_ids(names).size(KEY_SIZE);
            keys(dec.send().await.map_err(|e| failure(&e))?)
        }
        KmeRequest::Status { slave } => {
            let status = client.status(slave).await.map_err(|e| failure(&e))?;
            Ok(Fetched::Stock(Stock::from(&status)))
        }
    }
}

/// Moves the keys to locked memory; the client erases its own copies.
fn keys(container: KeyContainer) -> Result<Fetched, RequestFailure> {
    let ambiguous = |text: String| RequestFailure::new(FailureKind::Ambiguous, text);
    let keys = container.keys.iter().map(|key| {
        let key_id = KeyId::new(key.key_id()).map_err(|e| ambiguous(format!("key_ID: {e}")))?;
        let bytes = key
            .expose_array()
            .ok_or_else(|| ambiguous(format!("key {key_id} has {} bytes, not 32", key.len())))?;
        let locked = LockedKey::copy_of(bytes)
            .map_err(|e| ambiguous(format!("no memory for key {key_id}: {e}")))?;
        Ok((key_id, KmeKey::from_holder(locked)))
    });
    keys.collect::<Result<_, _>>().map(Fetched::Keys)
}

fn failure(e: &Error) -> RequestFailure {
    let kind = match e {
        Error::KeyPossiblyConsumed { .. } | Error::Interrupted { .. } => FailureKind::Ambiguous,
        Error::Unreachable { .. } | Error::Timeout { phase: "connect", .. } => {
            FailureKind::Unreachable
        }
        Error::Timeout { .. } | Error::Unavailable { .. } => FailureKind::Unavailable,
        Error::Unauthorized { .. } | Error::Tls { .. } => FailureKind::Unauthorized,
        Error::BadRequest { .. } => FailureKind::Refused,
        Error::Status { code: 404 | 410, .. } => FailureKind::Refused,
        _ => FailureKind::Invalid,
    };
    let retry_after = match e.cause() {
        Error::Unavailable { retry_after, .. } => *retry_after,
        _ => None,
    };
    RequestFailure { kind, text: e.to_string(), retry_after }
}
