//! The task of a pool, which makes the calls that the rules return.

use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::sleep_until;

use super::core::{Ask, FailureClass, Stock};
use super::{LedgerError, PoolShared};
use crate::{Client, Error, Key, Status, tls};

/// Time to sleep if no timer is due.
const IDLE_SLEEP: Duration = Duration::from_secs(3600);

/// The result of a call.
enum Ended {
    Status(Result<Status, Error>),
    Keys(u32, Result<Usable, NoKeys>),
}

/// Keys whose key_IDs were recorded as new.
struct Usable {
    keys: Vec<Key>,
    repeated: Option<String>,
}

enum NoKeys {
    Kme(Error),
    Ledger(LedgerError),
}

pub(super) fn jitter() -> u8 {
    let mut byte = [0];
    // Without randomness, the pauses are only less spread.
    let _ = tls::provider().secure_random.fill(&mut byte);
    byte[0]
}

/// Runs the task until it is aborted; calls in flight end with it.
pub(super) async fn run(client: Client, shared: Arc<PoolShared>) {
    let mut calls = JoinSet::new();
    loop {
        let wake_at = {
            let now = shared.now();
            let mut state = shared.state();
            while let Some(ask) = state.core.poll(now) {
                calls.spawn(call(client.clone(), Arc::clone(&shared), ask));
            }
            state.core.poll_timeout().map_or(now + IDLE_SLEEP, |at| at.min(now + IDLE_SLEEP))
        };
        tokio::select! {
            Some(ended) = calls.join_next() => {
                // A call that panicked stays in flight for the rules, so the pool asks for less.
                if let Ok(ended) = ended {
                    shared.ended(ended);
                }
            }
            () = shared.changed.notified() => {}
            () = sleep_until(shared.started + wake_at) => {}
        }
    }
}

async fn call(client: Client, shared: Arc<PoolShared>, ask: Ask) -> Ended {
    match ask {
        Ask::Status => Ended::Status(client.status(&shared.peer).await),
        Ask::Keys(number) => Ended::Keys(number, draw(&client, &shared, number).await),
    }
}

async fn draw(client: &Client, shared: &PoolShared, number: u32) -> Result<Usable, NoKeys> {
    let mut request = client.enc_keys(&shared.peer).number(number);
    if let Some(bits) = shared.size {
        request = request.size(bits);
    }
    let mut keys = request.send().await.map_err(NoKeys::Kme)?.keys;
    // The blocking part gets only the key_IDs, so that the keys are dropped with this task.
    let key_ids: Vec<String> = keys.iter().map(|key| key.key_id().to_owned()).collect();
    let ledger = shared.ledger.clone();
    let recorded = if ledger.blocks() {
        let recording = tokio::task::spawn_blocking(move || ledger.record(key_ids));
        recording.await.unwrap_or_else(|panic| std::panic::resume_unwind(panic.into_panic()))
    } else {
        ledger.record(key_ids)
    };
    let new = recorded.map_err(NoKeys::Ledger)?;
    let mut new = new.into_iter();
    let mut repeated = None;
    keys.retain(|key| {
        let is_new = new.next().unwrap_or(false);
        if !is_new {
            repeated = Some(format!("the KME gave key_ID {} again", key.key_id()));
        }
        is_new
    });
    Ok(Usable { keys, repeated })
}

impl PoolShared {
    fn ended(&self, ended: Ended) {
        let now = self.now();
        let mut state = self.state();
        match ended {
            Ended::Status(Ok(status)) => state.core.on_stock(now, Stock::from(&status)),
            Ended::Status(Err(error)) => {
                state.core.on_failure(now, Ask::Status, class(&error));
                state.last_failure = Some(format!("status: {error}"));
            }
            Ended::Keys(number, Ok(Usable { keys, repeated })) => {
                let came = keys.len();
                state.core.on_keys(now, number, keys);
                state.last_failure = repeated;
                drop(state);
                (0..came).for_each(|_| self.arrived.notify_one());
            }
            Ended::Keys(number, Err(NoKeys::Kme(error))) => {
                state.core.on_failure(now, Ask::Keys(number), class(&error));
                if let Error::Unavailable { retry_after: Some(asked), .. } = error.cause() {
                    state.core.retry_after(now, *asked);
                }
                state.last_failure = Some(error.to_string());
            }
            Ended::Keys(number, Err(NoKeys::Ledger(error))) => {
                state.core.on_failure(now, Ask::Keys(number), FailureClass::KeysLost);
                state.last_failure = Some(error.to_string());
            }
        }
    }
}

fn class(error: &Error) -> FailureClass {
    match error {
        _ if error.keys_may_be_consumed() => FailureClass::KeysLost,
        Error::BadRequest { .. } | Error::Unavailable { .. } | Error::Status { .. } => {
            FailureClass::Refused
        }
        _ => FailureClass::Unserved,
    }
}
