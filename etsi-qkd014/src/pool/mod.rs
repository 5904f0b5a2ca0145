//! A pool of keys for one peer, drawn ahead of their use.
//!
//! - [`KeyPool`] keeps keys ahead and hands each out once; it needs a tokio runtime.
//! - [`Ledger`] remembers key_IDs, in memory or in a file, so that no key is handed out twice even
//!   where a KME repeats itself.
//! - [`Core`] is the rules alone, without I/O or clock, for programs that make the calls
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

/// Keys drawn ahead for one peer SAE, each handed out once.
///
/// A task draws keys with `enc_keys`, so this SAE is the master; the peer draws the same keys by
/// their key_IDs with [`dec_keys`](Client::dec_keys). How it asks is told at [`Core`]. A key whose
/// key_ID the [`Ledger`] knows is dropped; with a ledger in a file, a key can be taken only after
/// its key_ID is on stable storage.
///
/// Cheap to clone: all clones are one pool, usable from any task or thread. When the last clone is
/// dropped, the task ends and keys that nobody took are dropped and zeroized.
///
/// The task makes each call once and waits after failures by rules of its own; the client's
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

/// Ends the pool with its last handle.
struct Running {
    shared: Arc<PoolShared>,
    task: AbortHandle,
}

/// What the handles and the task have in common.
struct PoolShared {
    peer: String,
    size: Option<u32>,
    ledger: Ledger,
    started: Instant,
    state: Mutex<PoolState>,
    /// Wakes the task.
    changed: Notify,
    /// Wakes those that wait for a key, one for each.
    arrived: Notify,
}

struct PoolState {
    core: Core<Key>,
    last_failure: Option<String>,
}

/// Sets up a [`KeyPool`]. Made by [`KeyPool::builder`].
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
    /// How long was waited.
    pub waited: Duration,
    /// Why the last call to the KME, or the ledger, failed, if one did since the last key came.
    pub last_failure: Option<String>,
}

impl KeyPoolBuilder {
    /// Size of each key in bits. Default the KME's [`key_size`](crate::Status::key_size).
    pub fn size(mut self, bits: u32) -> Self {
        self.size = Some(bits);
        self
    }

    /// Keys to hold ahead. Default 16.
    pub fn target(mut self, keys: usize) -> Self {
        self.settings.target = keys;
        self
    }

    /// Most keys that one call asks for, and so most that a call that is cut off can lose.
    /// Default 8. The KME's `max_key_per_request` counts where it is smaller.
    pub fn batch(mut self, keys: u32) -> Self {
        self.settings.batch = keys;
        self
    }

    /// Most calls for keys at a time. Default 4.
    pub fn calls(mut self, calls: usize) -> Self {
        self.settings.calls = calls;
        self
    }

    /// Age at which a key that nobody took is dropped and another drawn. Default ten minutes: many
    /// KMEs wipe keys that the peer does not draw in time.
    pub fn max_age(mut self, age: Duration) -> Self {
        self.settings.max_age = age;
        self
    }

    /// Where key_IDs are remembered. Default a ledger of this pool's own, in memory.
    pub fn ledger(mut self, ledger: Ledger) -> Self {
        self.ledger = ledger;
        self
    }

    /// Starts the pool on the tokio runtime it is called in.
    ///
    /// # Errors
    /// [`Error::Request`] where the peer's ID or the size cannot be asked for, [`Error::Config`]
    /// outside a runtime.
    pub fn build(self) -> Result<KeyPool, Error> {
        let Self { client, peer, size, settings, ledger } = self;
        // The pool repeats by its own rules; the client's within them would multiply.
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
    /// Starts the settings of a pool of keys to share with `peer_sae`, drawn by `client`.
    pub fn builder(client: Client, peer_sae: impl Into<String>) -> KeyPoolBuilder {
        KeyPoolBuilder {
            client,
            peer: peer_sae.into(),
            size: None,
            settings: Settings::default(),
            ledger: Ledger::default(),
        }
    }

    /// Hands out the oldest key, if one is there. Never waits for the KME or a disk.
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

    /// Hands out the oldest key, and waits for one until `deadline` where none is there. Those that
    /// wait are served in no set order. A call that is dropped has taken nothing.
    ///
    /// # Errors
    /// [`TakeError`] says why none came.
    pub async fn take(&self, deadline: Instant) -> Result<Key, TakeError> {
        let shared = &self.running.shared;
        let began = Instant::now();
        loop {
            // Begins to wait before it looks, so that no arrival is missed in between.
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

    /// How the pool stands.
    #[must_use]
    pub fn status(&self) -> PoolStatus {
        let shared = &self.running.shared;
        shared.state().core.status(shared.now())
    }

    /// Why the last call to the KME, or the ledger, failed, if one did since the last key came.
    /// Holds nothing of a key.
    #[must_use]
    pub fn last_failure(&self) -> Option<String> {
        self.running.shared.state().last_failure.clone()
    }

    /// How many keys to hold ahead from now on. Keys beyond it stay until they are taken or too
    /// old.
    pub fn set_target(&self, keys: usize) {
        let shared = &self.running.shared;
        shared.state().core.set_target(keys);
        shared.changed.notify_one();
    }

    /// The peer SAE.
    #[must_use]
    pub fn peer(&self) -> &str {
        &self.running.shared.peer
    }
}

impl PoolShared {
    fn now(&self) -> Duration {
        self.started.elapsed()
    }

    /// Nothing in the state is left half changed by a panic.
    fn state(&self) -> MutexGuard<'_, PoolState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.task.abort();
        // The task may hold on to the rest for a moment, but not to the keys.
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
