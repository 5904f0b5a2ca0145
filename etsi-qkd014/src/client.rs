//! The client: one call makes one or more attempts within a deadline.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use reqwest::Url;
use tokio::time::Instant;

use crate::builder::Limits;
use crate::exchange::{Body, Call, ExchangeFailure, Prepared};
use crate::{ClientBuilder, DecKeys, EncKeys, Error, RetryPolicy, Status, parse};

/// A client of one KME, acting as one SAE.
///
/// It is cheap to clone, and all clones share their connections. Calls may run concurrently in any
/// task. They need a tokio runtime with time and I/O enabled; programs without one use the feature
/// `blocking`.
///
/// A call that is dropped before it ends leaves nothing behind here, but the KME may have served
/// it: treat the keys of a dropped call as [consumed](Error::KeyPossiblyConsumed).
#[derive(Clone)]
pub struct Client {
    inner: Arc<ClientInner>,
}

struct ClientInner {
    http: reqwest::Client,
    base: Url,
    kme: String,
    connect_timeout: Duration,
    limits: Limits,
    /// The default key size in bits by slave SAE, from the last status.
    key_sizes: Arc<Mutex<HashMap<String, u32>>>,
}

/// Most peers whose key size is remembered.
const MAX_PEERS: usize = 1024;

impl Client {
    /// Returns a builder for a client.
    pub fn builder() -> ClientBuilder {
        ClientBuilder::default()
    }

    /// Returns the KME's status for keys between this SAE and `slave_sae` (clause 5.2).
    ///
    /// The client and its clones remember the `key_size`. Later answers of
    /// [`enc_keys`](Self::enc_keys) without a size must have it.
    ///
    /// # Errors
    /// Any [`Error`] except [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed).
    pub async fn status(&self, slave_sae: &str) -> Result<Status, Error> {
        let prepared = Prepared::get(self.url(slave_sae, "status")?);
        let body = self.call(Call::Status, &prepared).await?;
        let status = parse::status(&body, slave_sae, self.limits().quirks)?;
        self.remember_key_size(&status);
        Ok(status)
    }

    /// Starts a request for fresh keys to share with `slave_sae`, as their master (clause 5.3).
    pub fn enc_keys(&self, slave_sae: impl Into<String>) -> EncKeys<'_> {
        EncKeys::new(self, slave_sae.into())
    }

    /// Starts a request for keys that `master_sae` drew, by their key_IDs, as their slave (clause
    /// 5.4).
    pub fn dec_keys(&self, master_sae: impl Into<String>) -> DecKeys<'_> {
        DecKeys::new(self, master_sae.into())
    }

    /// Returns this client with another retry policy. It shares connections, like a clone.
    ///
    /// For a caller that repeats calls by its own rules and needs each to be made once
    /// ([`RetryPolicy::none`]): repeats within repeats would multiply.
    #[must_use]
    pub fn with_retry(&self, policy: RetryPolicy) -> Self {
        let ClientInner { http, base, kme, connect_timeout, limits, key_sizes } = &*self.inner;
        let inner = ClientInner {
            http: http.clone(),
            base: base.clone(),
            kme: kme.clone(),
            connect_timeout: *connect_timeout,
            limits: Limits { retry: policy, ..limits.clone() },
            key_sizes: Arc::clone(key_sizes),
        };
        Self { inner: Arc::new(inner) }
    }

    pub(crate) fn new(
        http: reqwest::Client,
        base: Url,
        kme: String,
        connect_timeout: Duration,
        limits: Limits,
    ) -> Self {
        let key_sizes = Arc::default();
        Self {
            inner: Arc::new(ClientInner { http, base, kme, connect_timeout, limits, key_sizes }),
        }
    }

    fn remember_key_size(&self, status: &Status) {
        let mut sizes = self.inner.key_sizes.lock().unwrap_or_else(PoisonError::into_inner);
        if sizes.len() < MAX_PEERS || sizes.contains_key(&status.slave_sae_id) {
            sizes.insert(status.slave_sae_id.clone(), status.key_size);
        }
    }

    /// Returns the default key size in bits for a peer, if a status has told one in whole bytes.
    pub(crate) fn key_size(&self, slave_sae: &str) -> Option<u32> {
        let sizes = self.inner.key_sizes.lock().unwrap_or_else(PoisonError::into_inner);
        sizes.get(slave_sae).copied().filter(|bits| *bits > 0 && bits.is_multiple_of(8))
    }

    pub(crate) fn limits(&self) -> &Limits {
        &self.inner.limits
    }

    /// Returns the URL of a method. The SAE ID becomes one path segment whatever it contains.
    pub(crate) fn url(&self, sae: &str, method: &str) -> Result<Url, Error> {
        check_sae_id(sae)?;
        let mut url = self.inner.base.clone();
        url.path_segments_mut().expect("https URLs have a path").extend([sae, method]);
        Ok(url)
    }

    /// Makes a call with its repeats.
    pub(crate) async fn call(&self, call: Call, prepared: &Prepared) -> Result<Body, Error> {
        let ClientInner { http, kme, connect_timeout, limits, .. } = &*self.inner;
        // Durations, because no `Instant` can represent some deadlines.
        let began = Instant::now();
        let left = || limits.deadline.saturating_sub(began.elapsed());
        let mut repeat = 0;
        let mut consumed = false;
        loop {
            let time = limits.timeout.min(left());
            let tried = prepared.attempt(http, kme, *connect_timeout, time, limits).await;
            let ExchangeFailure { error, ambiguous } = match tried {
                Ok(body) => return Ok(body),
                Err(failure) => failure,
            };
            consumed |= ambiguous;
            let pause = pause(limits, repeat, &error);
            if !(left() > pause && may_repeat(call, limits, repeat, &error, ambiguous)) {
                return Err(if consumed { call.consumed(error) } else { error });
            }
            tokio::time::sleep(pause).await;
            repeat += 1;
        }
    }
}

pub(crate) fn check_sae_id(sae: &str) -> Result<(), Error> {
    // "." and ".." would be removed from a path, and so name another resource.
    let sane = !sae.is_empty() && sae.len() <= 255 && !matches!(sae, "." | "..");
    if sane && !sae.chars().any(char::is_control) {
        return Ok(());
    }
    let shown: String = sae.chars().take(64).collect();
    Err(Error::Request {
        reason: format!(
            "SAE ID {shown:?}: 1 to 255 bytes without control characters, no dots alone"
        ),
    })
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client")
            .field("base", &self.inner.base.as_str())
            .field("limits", &self.inner.limits)
            .finish_non_exhaustive()
    }
}

fn may_repeat(call: Call, limits: &Limits, repeat: u32, error: &Error, ambiguous: bool) -> bool {
    let policy = &limits.retry;
    let (repeats, allowed) = match call {
        Call::Status => (policy.status, true),
        Call::DecKeys => (policy.dec_keys, true),
        Call::EncKeys => (policy.enc_keys, !ambiguous || policy.enc_keys_ambiguous),
    };
    repeat < repeats && allowed && error.is_transient()
}

fn pause(limits: &Limits, repeat: u32, error: &Error) -> Duration {
    let mut jitter = [0];
    // Without randomness, the pauses are only less spread.
    let _ = rustls::crypto::aws_lc_rs::default_provider().secure_random.fill(&mut jitter);
    let pause = limits.retry.pause_before(repeat, jitter[0]);
    match error {
        Error::Unavailable { retry_after: Some(asked), .. } => pause.max(*asked),
        _ => pause,
    }
}
