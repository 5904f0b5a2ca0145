//! Keys that were drawn from the KME and are not announced yet. The rules of [`etsi_qkd014::pool`] decide when to
//! draw, and how many keys. This module turns their calls into [`KmeRequest`]s, and reports the results to them.

use std::time::Duration;

use axon_envelope::{KeyId, KmeKey};
use etsi_qkd014::pool::{Ask, Core, FailureClass, Ledger, PoolStatus, Settings};

use crate::{
    keys::request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest},
    wire::keys::announceable,
};

/// Most keys a call asks for: what a call that is cut off can lose.
const PER_CALL: u32 = 8;
/// Calls for keys in flight.
const IN_FLIGHT: usize = 4;
/// Pause after keys that the peer could not use, first and longest: each is gone for good. It
/// doubles with each round that no READY makes up for. A round is all keys that were announced
/// before the first of them was refused, since they fail for the same cause.
const REFUSED: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));
/// READYs that make up for one round.
const MAKE_UP: u32 = 4;
/// Rounds that are remembered, so that a peer that is well again is served again soon.
const ROUNDS_MAX: u32 = 10;
/// Rounds in a row after which no more than [`FEW_KEYS`] keys are had ahead, until one is READY.
const ROUNDS_OF_MANY: u32 = 2;
/// See [`ROUNDS_OF_MANY`].
const FEW_KEYS: usize = 4;

/// A key that no connection knows of.
pub(super) struct UnusedKey {
    pub(super) key_id: KeyId,
    pub(super) key: KmeKey,
    /// When it was asked for, where its lead time is to be measured.
    pub(super) asked: Option<Duration>,
    /// When it was first announced, where no connection has answered for it yet.
    pub(super) announced: Option<Duration>,
}

/// The keys of one sending direction before they are announced.
pub(super) struct KeyStock {
    core: Core<UnusedKey>,
    /// Key_IDs of this direction, so that a KME that repeats itself has no key used twice.
    seen: Ledger,
    /// Rounds of refused keys that no READY made up for.
    rounds: u32,
    /// When the last round was refused.
    refused: Option<Duration>,
    /// READYs since a round was made up for.
    readied: u32,
    /// Whether the last call for keys brought none, and the peer has refused none since.
    fails: bool,
}

impl KeyStock {
    /// `jitter` gives a random byte for each pause after a failure.
    pub(super) fn new(jitter: impl FnMut() -> u8 + Send + 'static) -> Self {
        let mut settings = Settings::default();
        settings.batch = PER_CALL;
        settings.calls = IN_FLIGHT;
        // A key ages from its first use on, and that is the sender's to watch.
        settings.max_age = Duration::MAX;
        let (core, seen) = (Core::new(settings, jitter), Ledger::default());
        Self { core, seen, rounds: 0, refused: None, readied: 0, fails: false }
    }

    /// `ahead` keys are to be on their way or ready, where `elsewhere` of them are the sender's.
    pub(super) fn plan(&mut self, ahead: usize, elsewhere: usize) {
        let few = self.rounds >= ROUNDS_OF_MANY;
        self.core.set_target(if few { ahead.min(FEW_KEYS) } else { ahead });
        self.core.set_elsewhere(elsewhere);
    }

    /// What was planned, within the KME's stock. At least 1.
    pub(super) fn target(&self) -> usize {
        self.core.target()
    }

    /// The next call, if any.
    pub(super) fn poll(&mut self, now: Duration, peer: &str) -> Option<KmeRequest> {
        let ask = self.core.poll(now)?;
        let slave = peer.to_owned();
        Some(match ask {
            Ask::Status => KmeRequest::Status { slave },
            Ask::Keys(number) => KmeRequest::Enc { slave, number, purpose: KeyPurpose::Messages },
        })
    }

    /// When [`poll`](Self::poll) may give something without an answer before.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.core.poll_timeout()
    }

    /// Takes the answer to one of the pool's calls. Says what was wrong with it, if anything was.
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

    /// Those of `keys` that may be announced, and why another may not.
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

    /// Whether a key may be used: its key_ID can be announced, and was never there before.
    ///
    /// # Errors
    /// Why not.
    pub(super) fn admit(&self, key_id: &KeyId) -> Result<(), String> {
        let text = announceable(key_id)
            .ok_or_else(|| format!("key_ID {key_id} is no text of at most 128 bytes"))?;
        match self.seen.record([text]).as_deref() {
            Ok([true]) => Ok(()),
            Ok(_) => Err(format!("the KME gave key_ID {key_id} twice")),
            Err(e) => Err(e.to_string()),
        }
    }

    /// Whether the KME gives no keys, and the peer refused none since that it gave.
    pub(super) fn fails(&self) -> bool {
        self.fails
    }

    /// Takes out the key to announce next.
    pub(super) fn take(&mut self, now: Duration) -> Option<UnusedKey> {
        self.core.take(now)
    }

    /// Takes in a key that was drawn elsewhere, as the newest.
    pub(super) fn put(&mut self, now: Duration, key_id: KeyId, key: KmeKey) {
        self.core.put(now, UnusedKey { key_id, key, asked: None, announced: None });
    }

    /// Takes back a key that nothing was sealed under, to be announced before all others: the peer
    /// may hold it already. `announced`: since when the peer owes an answer for it.
    pub(super) fn put_back(&mut self, key_id: KeyId, key: KmeKey, announced: Option<Duration>) {
        self.core.put(Duration::ZERO, UnusedKey { key_id, key, asked: None, announced });
    }

    /// The peer could not use a key that was `announced` then, or did not answer for it.
    pub(super) fn key_refused(&mut self, now: Duration, announced: Duration) {
        // That there is no key is the peer's doing.
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

    /// The peer readied a key.
    pub(super) fn key_ready(&mut self) {
        self.readied += 1;
        if self.readied >= MAKE_UP {
            self.readied = 0;
            self.rounds = self.rounds.saturating_sub(1);
        }
    }

    /// How it stands.
    pub(super) fn status(&self, now: Duration) -> PoolStatus {
        self.core.status(now)
    }
}

/// What a failed call cost.
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
