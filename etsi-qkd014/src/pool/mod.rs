//! A pool of keys for one peer, drawn before they are needed.
//!
//! - [`KeyPool`] draws keys in advance and hands each out once; it needs a tokio runtime.
//! - [`Ledger`] remembers key_IDs, in memory or in a file, so that no key is handed out twice even
//!   if a KME repeats keys.
//! - [`Core`] contains only the rules, without I/O or clock, for programs that make the calls
//!   themselves.

mod core;
mod ledger;
mod supply;
mod task;

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::Handle;
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{Instant, timeout_at};

pub use self::core::{Ask, Core, FailureClass, PoolStatus, Settings, Stock};
pub use ledger::{Ledger, LedgerError};

use crate::{Client, Error, Key, RetryPolicy};

/// Keys drawn in advance for one peer SAE. Each is handed out once.
///
/// A task draws keys with `enc_keys`, so this SAE is the master. The peer draws the same keys by
/// their key_IDs with [`dec_keys`](Client::dec_keys). [`Core`] describes how the task asks. A key
/// whose key_ID the [`Ledger`] knows is dropped. With a ledger in a file, a key can be taken only
/// after its key_ID is on stable storage.
///
/// It is cheap to clone: all clones are one pool, usable from any task or thread. When the last
/// clone is dropped, the task ends, and the remaining keys are dropped and zeroized.
///
/// The task makes each call once and waits after failures by its own rules; the client's
/// [`RetryPolicy`] does not apply.
///
/// ```no_run
/// # async fn example(client: etsi_qkd014::Client) -> Result<(), Box<dyn std::error::Error>> {
/// use std::time::Duration;
/// use etsi_qkd014::KeyPool;
///
/// let pool = KeyPool::builder(client, "sae-b").size(256).target(64).build()?;
/// let key = pool.take(tokio::time::Instant::now() + Duration::from_secs(5)).await?;
/// println!("tell sae-b: {}", key.key_id());
/// # Ok(())
/// # }
/// ```
#[derive(Clone)]
pub struct KeyPool {
    running: Arc<Running>,
}

/// Ends the pool when the last handle is dropped.
struct Running {
    shared: Arc<PoolShared>,
    task: AbortHandle,
}

/// The state that the handles and the task share.
struct PoolShared {
    peer: String,
    size: Option<u32>,
    ledger: Ledger,
    started: Instant,
    state: Mutex<PoolState>,
    /// Wakes the task.
    changed: Notify,
    /// Wakes the tasks that wait for a key, one for each key.
    arrived: Notify,
}

struct PoolState {
    core: Core<Key>,
    last_failure: Option<String>,
}

/// Builds a [`KeyPool`]. Returned by [`KeyPool::builder`].
#[derive(Debug)]
#[must_use]
pub struct KeyPoolBuilder {
    client: Client,
    peer: String,
    size: Option<u32>,
    settings: Settings,
    ledger: Ledger,
}

/// No key came in time.
#[derive(Clone, Debug, thiserror::Error)]
#[error("no key for {peer} within {waited:?}; {}", last_failure.as_deref().unwrap_or("the KME has not failed"))]
#[non_exhaustive]
pub struct TakeError {
    /// The peer SAE.
    pub peer: String,
    /// The time that was waited.
    pub waited: Duration,
    /// Why the last call to the KME, or the ledger, failed, if one did since the last key came.
    pub last_failure: Option<String>,
}

impl KeyPoolBuilder {
    /// Sets the size of each key in bits. Default the KME's [`key_size`](crate::Status::key_size).
    pub fn size(mut self, bits: u32) -> Self {
        self.size = Some(bits);
        self
    }

    /// Sets the number of keys to hold in advance. Default 16.
    pub fn target(mut self, keys: usize) -> Self {
        self.settings.target = keys;
        self
    }

    /// Sets the most keys that one call asks for, and so the most that a call can lose if it is cut
    /// off. Default 8. The KME's `max_key_per_request` applies if it is smaller.
    pub fn batch(mut self, keys: u32) -> Self {
        self.settings.batch = keys;
        self
    }

    /// Sets the most calls for keys at a time. Default 4.
    pub fn calls(mut self, calls: usize) -> Self {
        self.settings.calls = calls;
        self
    }

    /// Sets the age at which a key that nobody took is dropped and replaced. Default ten minutes:
    /// many KMEs delete keys that the peer does not draw in time.
    pub fn max_age(mut self, age: Duration) -> Self {
        self.settings.max_age = age;
        self
    }

    /// Sets the ledger that remembers key_IDs. Default a ledger in memory, of this pool only.
    pub fn ledger(mut self, ledger: Ledger) -> Self {
        self.ledger = ledger;
        self
    }

    /// Starts the pool on the current tokio runtime.
    ///
    /// # Errors
    /// [`Error::Request`] if the peer's ID or the size is not possible, [`Error::Config`] outside a
    /// runtime.
    pub fn build(self) -> Result<KeyPool, Error> {
        let Self { client, peer, size, settings, ledger } = self;
        // The pool repeats by its own rules; repeats of the client within them would multiply.
        let client = client.with_retry(RetryPolicy::none());
        client.url(&peer, "enc_keys")?;
        if size.is_some_and(|bits| bits == 0 || !bits.is_multiple_of(8)) {
            let reason = "size: a positive multiple of 8 bits".to_owned();
            return Err(Error::Request { reason });
        }
        let runtime = Handle::try_current()
            .map_err(|e| Error::Config { setting: "KeyPool", reason: e.to_string() })?;
        let shared = Arc::new(PoolShared {
            peer,
            size,
            ledger,
            started: Instant::now(),
            state: Mutex::new(PoolState {
                core: Core::new(settings, task::jitter),
                last_failure: None,
            }),
            changed: Notify::new(),
            arrived: Notify::new(),
        });
        let task = runtime.spawn(task::run(client, Arc::clone(&shared))).abort_handle();
        Ok(KeyPool { running: Arc::new(Running { shared, task }) })
    }
}

impl KeyPool {
    /// Returns a builder for a pool of keys to share with `peer_sae`, drawn by `client`.
    pub fn builder(client: Client, peer_sae: impl Into<String>) -> KeyPoolBuilder {
        KeyPoolBuilder {
            client,
            peer: peer_sae.into(),
            size: None,
            settings: Settings::default(),
            ledger: Ledger::default(),
        }
    }

    /// Takes the oldest key, if there is one. Never waits for the KME or a disk.
    #[must_use]
    pub fn try_take(&self) -> Option<Key> {
        let shared = &self.running.shared;
        let now = shared.now();
        let mut state = shared.state();
        let key = state.core.take(now);
        let due = state.core.wants_keys(now);
        drop(state);
        if due {
            shared.changed.notify_one();
        }
        key
    }

    /// Takes the oldest key. If there is none, waits for one until `deadline`. Waiting callers are
    /// served in no particular order. A call that is dropped has taken nothing.
    ///
    /// # Errors
    /// [`TakeError`] contains the reason why no key came.
    pub async fn take(&self, deadline: Instant) -> Result<Key, TakeError> {
        let shared = &self.running.shared;
        let began = Instant::now();
        loop {
            // The wait begins before the check, so that no arrival in between is missed.
            let mut arrived = std::pin::pin!(shared.arrived.notified());
            arrived.as_mut().enable();
            if let Some(key) = self.try_take() {
                return Ok(key);
            }
            if timeout_at(deadline, arrived).await.is_err() {
                return self.try_take().ok_or_else(|| TakeError {
                    peer: shared.peer.clone(),
                    waited: began.elapsed(),
                    last_failure: self.last_failure(),
                });
            }
        }
    }

    /// Returns the state of the pool.
    #[must_use]
    pub fn status(&self) -> PoolStatus {
        let shared = &self.running.shared;
        shared.state().core.status(shared.now())
    }

    /// Returns why the last call to the KME, or the ledger, failed, if one did since the last key
    /// came. Contains nothing of a key.
    #[must_use]
    pub fn last_failure(&self) -> Option<String> {
        self.running.shared.state().last_failure.clone()
    }

    /// Sets how many keys to hold in advance from now on. Keys beyond it stay until they are taken
    /// or too old.
    pub fn set_target(&self, keys: usize) {
        let shared = &self.running.shared;
        shared.state().core.set_target(keys);
        shared.changed.notify_one();
    }

    /// Returns the peer SAE.
    #[must_use]
    pub fn peer(&self) -> &str {
        &self.running.shared.peer
    }
}

impl PoolShared {
    fn now(&self) -> Duration {
        self.started.elapsed()
    }

    /// Locks the state. A panic leaves no part of it half changed, so poisoning is ignored.
    fn state(&self) -> MutexGuard<'_, PoolState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.task.abort();
        // The task may keep the rest for a moment, but not the keys.
        self.shared.state().core.clear();
    }
}

impl fmt::Debug for KeyPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("KeyPool")
            .field("peer", &self.peer())
            .field("status", &self.status())
            .finish_non_exhaustive()
    }
}
