//! One request as one call of the client.

use std::time::{Duration, Instant};

use axon_envelope::{KeyId, KmeKey};
use etsi_qkd014::{Client, Error, KeyContainer};

use super::{Recorder, STATUS_TIMEOUT};
use crate::{
    keys::request::{Failure, FailureKind, Fetched, Request, Stock},
    secrets::LockedKey,
};

/// Bits of a key.
const KEY_SIZE: u32 = 256;

/// Runs `request` and records how it went.
pub(super) async fn run(
    client: &Client,
    recorder: &Recorder,
    request: &Request,
) -> Result<Fetched, Failure> {
    let start = Instant::now();
    let limit = match request {
        Request::Enc { timeout, .. } | Request::Dec { timeout, .. } => *timeout,
        Request::Status { .. } => STATUS_TIMEOUT,
    };
    let outcome = match tokio::time::timeout(limit, call(client, request)).await {
        Ok(outcome) => outcome,
        Err(_) => Err(timed_out(request, limit)),
    };
    recorder.record(request, start.elapsed(), &outcome);
    outcome
}

async fn call(client: &Client, request: &Request) -> Result<Fetched, Failure> {
    match request {
        Request::Enc { slave, number, .. } => {
            let enc = client.enc_keys(slave).number(*number).size(KEY_SIZE);
            keys(enc.send().await.map_err(|e| failure(&e))?)
        }
        Request::Dec { master, key_ids, .. } => {
            let mut names = Vec::with_capacity(key_ids.len());
            for key_id in key_ids {
                names.push(std::str::from_utf8(key_id.as_bytes()).map_err(|_| {
                    Failure::new(FailureKind::Invalid, format!("key_ID {key_id} is no text"))
                })?);
            }
            let dec = client.dec_keys(master).key_ids(names).size(KEY_SIZE);
            keys(dec.send().await.map_err(|e| failure(&e))?)
        }
        Request::Status { slave } => {
            let status = client.status(slave).await.map_err(|e| failure(&e))?;
            Ok(Fetched::Stock(Stock::from(&status)))
        }
    }
}

/// Moves the keys to locked memory; the client erases its own copies.
fn keys(container: KeyContainer) -> Result<Fetched, Failure> {
    let ambiguous = |text: String| Failure::new(FailureKind::Ambiguous, text);
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

fn failure(e: &Error) -> Failure {
    let kind = match e {
        Error::KeyPossiblyConsumed { .. } | Error::Interrupted { .. } => FailureKind::Ambiguous,
        Error::Unreachable { .. } => FailureKind::Unreachable,
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
    Failure { kind, text: e.to_string(), retry_after }
}

/// The call was dropped in the middle: whether it reached the KME is not known.
fn timed_out(request: &Request, limit: Duration) -> Failure {
    let (kind, call) = match request {
        Request::Enc { .. } => (FailureKind::Ambiguous, "enc_keys"),
        Request::Dec { .. } => (FailureKind::Ambiguous, "dec_keys"),
        Request::Status { .. } => (FailureKind::Unavailable, "status"),
    };
    Failure::new(kind, format!("{call}: no answer from the KME within {limit:?}"))
}
