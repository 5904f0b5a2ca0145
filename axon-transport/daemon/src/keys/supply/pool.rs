//! Keys that were drawn from the KME and are not announced yet. The rules of [`etsi_qkd014::pool`] decide when to
//! draw, and how many keys. This module turns their calls into [`KmeRequest`]s, and reports the results to them.

use std::time::Duration;

use axon_envelope::{KeyId, KmeKey};
use etsi_qkd014::pool::{Ask, Core, FailureClass, Ledger, PoolStatus, Settings};

use crate::{
    keys::request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest},
    wire::keys::announceable,
};

/// Most keys of one call, and so the most keys that an interrupted call can lose.
const PER_CALL: u32 = 8;
/// Most calls for keys in flight.
const IN_FLIGHT: usize = 4;
/// First and longest pause after keys that the peer could not use: each such key is lost for good. The pause doubles
/// with each round that no READY compensates. A round is all keys that were announced before the first of them was
/// refused, because they fail for the same cause.
const REFUSED: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));
/// READYs that compensate one round.
const MAKE_UP: u32 = 4;
/// Most rounds that are counted, so that a recovered peer is served again soon.
const ROUNDS_MAX: u32 = 10;
/// Least number of uncompensated rounds at which at most [`FEW_KEYS`] keys are held ahead.
const ROUNDS_OF_MANY: u32 = 2;
/// Most keys held ahead after [`ROUNDS_OF_MANY`].
const FEW_KEYS: usize = 4;

/// A key that is not announced on any connection.
pub(super) struct UnusedKey {
    pub(super) key_id: KeyId,
    pub(super) key: KmeKey,
    /// The time of its request, if its lead time is to be measured.
    pub(super) asked: Option<Duration>,
    /// The time of its first announcement, if no connection has answered for it yet.
    pub(super) announced: Option<Duration>,
}

/// The keys of one sending direction before they are announced.
pub(super) struct KeyStock {
    core: Core<UnusedKey>,
    /// The key_IDs of this direction. They prevent a second use of a key that the KME repeats.
    seen: Ledger,
    /// Rounds of refused keys that no READY compensated.
    rounds: u32,
    /// The time of the last refused round.
    refused: Option<Duration>,
    /// READYs since the last round that was compensated or refused.
    readied: u32,
    /// True if the last call for keys brought none, and the peer has refused none since.
    fails: bool,
}

impl KeyStock {
    /// Creates an empty stock. `jitter` returns a random byte for each pause after a failure.
    pub(super) fn new(jitter: impl FnMut() -> u8 + Send + 'static) -> Self {
        let mut settings = Settings::default();
        settings.batch = PER_CALL;
        settings.calls = IN_FLIGHT;
        // A key ages only from its first use on, and the sender checks its age.
        settings.max_age = Duration::MAX;
        let (core, seen) = (Core::new(settings, jitter), Ledger::default());
        Self { core, seen, rounds: 0, refused: None, readied: 0, fails: false }
    }

    /// Sets the number of keys in flight or ready to `ahead`. Returns how many of them the KME's stock allows, at least 1.
    pub(super) fn set_ahead(&mut self, ahead: usize) -> usize {
        let few = self.rounds >= ROUNDS_OF_MANY;
        self.core.set_target(if few { ahead.min(FEW_KEYS) } else { ahead });
        self.core.target()
    }

    /// Sets how many of the keys ahead the sender has.
    pub(super) fn set_elsewhere(&mut self, elsewhere: usize) {
        self.core.set_elsewhere(elsewhere);
    }

    /// Returns the next call, if any.
    pub(super) fn poll(&mut self, now: Duration, peer: &str) -> Option<KmeRequest> {
        let ask = self.core.poll(now)?;
        let slave = peer.to_owned();
        Some(match ask {
            Ask::Status => KmeRequest::Status { slave },
            Ask::Keys(number) => KmeRequest::Enc { slave, number, purpose: KeyPurpose::Messages },
        })
    }

    /// Returns when [`poll`](Self::poll) may return a call without an answer before.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.core.poll_timeout()
    }

    /// Handles the answer to one of the pool's calls. Returns the fault of the answer, if it has one.
    pub(super) fn handle_answer(&mut self, now: Duration, answer: Answer) -> Option<String> {
        let asked = now.saturating_sub(answer.took);
        let ask = match answer.request {
            KmeRequest::Status { .. } => Ask::Status,
            KmeRequest::Enc { number, .. } => Ask::Keys(number),
            KmeRequest::Dec { .. } => return None,
        };
        match (ask, answer.outcome) {
            (Ask::Status, Ok(Fetched::Stock(stock))) => {
                self.core.on_stock(now, stock);
                None
            }
            (Ask::Keys(number), Ok(Fetched::Keys(keys))) => {
                let (usable, refused) = self.usable(asked, keys);
                self.fails = usable.is_empty();
                self.core.on_keys(now, number, usable);
                refused
            }
            (ask, Ok(_)) => {
                self.core.on_failure(now, ask, FailureClass::KeysLost);
                self.fails |= matches!(ask, Ask::Keys(_));
                Some("the KME answered another call".to_owned())
            }
            (ask, Err(failure)) => {
                self.core.on_failure(now, ask, class(failure.kind));
                self.fails |= matches!(ask, Ask::Keys(_));
                if let Some(asked) = failure.retry_after {
                    self.core.retry_after(now, asked);
                }
                Some(failure.text)
            }
        }
    }

    /// Returns the keys that may be announced, and the reason for which another key may not.
    fn usable(
        &self,
        asked: Duration,
        keys: Vec<(KeyId, KmeKey)>,
    ) -> (Vec<UnusedKey>, Option<String>) {
        let mut refused = None;
        let mut usable = Vec::with_capacity(keys.len());
        for (key_id, key) in keys {
            match self.admit(&key_id) {
                Ok(()) => {
                    usable.push(UnusedKey { key_id, key, asked: Some(asked), announced: None });
                }
                Err(why) => refused = Some(why),
            }
        }
        (usable, refused)
    }

    /// Records the key_ID of a key that is to be used: it must be announceable, and new to this direction.
    ///
    /// # Errors
    /// The reason for which the key may not be used.
    pub(super) fn admit(&self, key_id: &KeyId) -> Result<(), String> {
        let text = announceable(key_id)
            .ok_or_else(|| format!("key_ID {key_id} is no text of at most 128 bytes"))?;
        match self.seen.record([text]).as_deref() {
            Ok([true]) => Ok(()),
            Ok(_) => Err(format!("the KME gave key_ID {key_id} twice")),
            Err(e) => Err(e.to_string()),
        }
    }

    /// Returns whether the last call for keys brought none, and the peer has refused none since.
    pub(super) fn fails(&self) -> bool {
        self.fails
    }

    /// Takes the next key to announce.
    pub(super) fn take(&mut self, now: Duration) -> Option<UnusedKey> {
        self.core.take(now)
    }

    /// Adds a key that was drawn by another part, as the newest key.
    pub(super) fn put(&mut self, now: Duration, key_id: KeyId, key: KmeKey) {
        self.core.put(now, UnusedKey { key_id, key, asked: None, announced: None });
    }

    /// Puts back a key that sealed nothing. It is announced before all others, because the peer may hold it already.
    /// `announced`: the time since which the peer owes an answer for it.
    pub(super) fn put_back(&mut self, key_id: KeyId, key: KmeKey, announced: Option<Duration>) {
        self.core.put(Duration::ZERO, UnusedKey { key_id, key, asked: None, announced });
    }

    /// Handles a key that was `announced` at that time and that the peer could not use, or did not answer for.
    pub(super) fn key_refused(&mut self, now: Duration, announced: Duration) {
        // The peer caused the lack of keys, not the KME.
        self.fails = false;
        if self.refused.is_some_and(|at| announced <= at) {
            return;
        }
        self.refused = Some(now);
        self.readied = 0;
        self.rounds = (self.rounds + 1).min(ROUNDS_MAX);
        let pause = (REFUSED.0 * (1 << (self.rounds - 1))).min(REFUSED.1);
        self.core.hold_until(now.saturating_add(pause));
    }

    /// Handles a key that the peer readied.
    pub(super) fn key_ready(&mut self) {
        self.readied += 1;
        if self.readied >= MAKE_UP {
            self.readied = 0;
            self.rounds = self.rounds.saturating_sub(1);
        }
    }

    /// Returns the status of the pool.
    pub(super) fn status(&self, now: Duration) -> PoolStatus {
        self.core.status(now)
    }
}

/// Returns the class of a failed call, which states the loss that it caused.
fn class(kind: FailureKind) -> FailureClass {
    match kind {
        FailureKind::Ambiguous | FailureKind::Repeated => FailureClass::KeysLost,
        FailureKind::Unavailable | FailureKind::Refused => FailureClass::Refused,
        FailureKind::Unreachable
        | FailureKind::Unauthorized
        | FailureKind::Busy
        | FailureKind::Invalid => FailureClass::Unserved,
    }
}
