//! Client side: requests one key for each peer and keeps it until it is spent.

use std::{collections::HashMap, fmt, sync::Arc, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_tls::{
    Cipher,
    qkd::{self, Psk},
};
use axon_transport::config::QkdPeers;
use secrecy::ExposeSecret;

use super::Completion;
use crate::keys::request::{Answer, Fetched, KeyPurpose, KmeRequest};

/// The time for which an unspent key is kept.
const KEY_MAX_AGE: Duration = Duration::from_secs(600);
/// Waits before the same key is tried again after a refusal; the last one repeats.
const REDIAL: [Duration; 6] = [
    Duration::from_millis(50),
    Duration::from_millis(100),
    Duration::from_millis(200),
    Duration::from_millis(400),
    Duration::from_millis(800),
    Duration::from_millis(1600),
];
/// The time for which a refused key is tried again, in addition to the time that the peer's KME may take.
const REFUSED_FOR: Duration = Duration::from_secs(7);
/// The number of `decrypt_error` alerts after which a key is given up. It is more than one, because any host on the
/// path can forge the alert.
const MISMATCHES: u32 = 4;
/// Longest wait before the KME is asked for another key, after a call or a key that failed.
const BACK_OFF_MAX: Duration = Duration::from_secs(60);
/// Most remembered peers. SAE IDs come from beacons, which any host can send.
const MAX_PEERS: usize = 256;
/// Most calls in flight.
const IN_FLIGHT: usize = 8;

/// The decision about a peer that is to be dialled.
#[derive(Debug)]
pub enum DialDecision {
    /// Dial it with this key.
    Attempt(DialKey),
    /// Ask again later.
    Wait {
        /// The time to ask again; `None`: when the KME has answered.
        until: Option<Duration>,
        /// The reason, for log and status.
        why: String,
    },
    /// The peer must not be dialled at all.
    Refused(DialRefusal),
}

/// The key of a dial. Attempts may overlap: the first that succeeds spends the key for all.
pub struct DialKey {
    /// The id of the key. The caller passes it in its reports about this attempt.
    pub key_id: KeyId,
    /// The PSK, for [`axon_tls::quic::qkd_client`].
    pub psk: Arc<Psk>,
}

impl fmt::Debug for DialKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DialKey").field("key_id", &self.key_id).finish_non_exhaustive()
    }
}

/// The reason for which a peer is never dialled.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DialRefusal {
    /// The peer claims this host's own name.
    #[error("peer claims this host's own SAE ID {0:?}: give each host an AXON_SAE_ID of its own")]
    OwnSaeId(String),
    /// The peer is not listed.
    #[error("SAE {0:?} is not in AXON_QKD_PEERS")]
    NotAPeer(String),
    /// Too many peers have keys or calls in flight.
    #[error("more than {MAX_PEERS} SAEs are being dialled")]
    TooMany,
}

/// The keys with which this host dials. The daemon has one dialler.
pub struct BootstrapDialler {
    sae_id: String,
    allowed: QkdPeers,
    cipher: Cipher,
    /// The longest time that a KME may take to answer.
    answer: Duration,
    peers: HashMap<String, DialPeer>,
}

struct DialPeer {
    state: DialState,
    /// Keys and calls that failed since the last success.
    failures: u32,
}

enum DialState {
    /// The next dial requests a key, from this time on.
    Empty {
        not_before: Duration,
        why: String,
    },
    /// A key has to be requested.
    Wanted,
    /// The KME was asked.
    Asked,
    UnspentKey(UnspentKey),
}

struct UnspentKey {
    key_id: KeyId,
    psk: Arc<Psk>,
    since: Duration,
    not_before: Duration,
    refusals: usize,
    mismatches: u32,
    last_refusal: Option<Duration>,
    refused_for: Duration,
}

impl Drop for UnspentKey {
    /// Erases the PSK explicitly: attempts and connections share it with their configuration.
    fn drop(&mut self) {
        self.psk.erase();
    }
}

impl BootstrapDialler {
    /// Creates the dialler of the host `sae_id`, which may dial `allowed`. A KME may take up to `answer`.
    pub fn new(sae_id: &str, allowed: QkdPeers, cipher: Cipher, answer: Duration) -> Self {
        Self { sae_id: sae_id.to_owned(), allowed, cipher, answer, peers: HashMap::new() }
    }

    /// Returns whether to dial `sae` now, and with which key. Requests a key from the KME if there is none.
    pub fn dial(&mut self, now: Duration, sae: &str) -> DialDecision {
        if sae == self.sae_id {
            return DialDecision::Refused(DialRefusal::OwnSaeId(sae.to_owned()));
        }
        if !self.allowed.allows(sae) {
            return DialDecision::Refused(DialRefusal::NotAPeer(sae.to_owned()));
        }
        self.expire(now);
        if !self.peers.contains_key(sae) && !self.make_room(now) {
            return DialDecision::Refused(DialRefusal::TooMany);
        }
        let peer = self.peers.entry(sae.to_owned()).or_insert_with(DialPeer::new);
        match &peer.state {
            DialState::Empty { not_before, why } if *not_before > now => {
                return DialDecision::Wait { until: Some(*not_before), why: why.clone() };
            }
            DialState::Empty { .. } => peer.state = DialState::Wanted,
            DialState::UnspentKey(held) if held.not_before > now => {
                return DialDecision::Wait {
                    until: Some(held.not_before),
                    why: format!("peer does not know key_ID {} yet", held.key_id),
                };
            }
            DialState::UnspentKey(held) => {
                let psk = Arc::clone(&held.psk);
                return DialDecision::Attempt(DialKey { key_id: held.key_id.clone(), psk });
            }
            DialState::Wanted | DialState::Asked => {}
        }
        DialDecision::Wait { until: None, why: "waiting for the KME's enc_keys answer".to_owned() }
    }

    /// Handles a complete handshake under `key_id`: the key is spent, and erased.
    pub fn handle_success(&mut self, _now: Duration, sae: &str, key_id: &KeyId) -> Completion {
        let Some(peer) = self.peers.get_mut(sae) else { return Completion::Reused };
        match &peer.state {
            DialState::UnspentKey(held) if held.key_id == *key_id => {
                *peer = DialPeer::new();
                Completion::First
            }
            _ => Completion::Reused,
        }
    }

    /// Handles a report that the peer holds another key under `key_id` (0x133). Returns whether the key is given up.
    pub fn handle_mismatch(&mut self, now: Duration, sae: &str, key_id: &KeyId) -> bool {
        let held = self.peers.get_mut(sae).and_then(|peer| match &mut peer.state {
            DialState::UnspentKey(held) if held.key_id == *key_id => Some(held),
            _ => None,
        });
        let Some(held) = held else { return false };
        held.mismatches += 1;
        let given_up = held.mismatches >= MISMATCHES;
        self.handle_refusal(now, sae, key_id);
        if given_up
            && let Some(peer) = self.peers.get_mut(sae)
            && matches!(peer.state, DialState::UnspentKey(_))
        {
            peer.failed(now, format!("peer holds another key under key_ID {key_id}"));
        }
        given_up
    }

    /// Handles the peer's refusal of the key `key_id`, which is unknown to the peer (0x173).
    pub fn handle_refusal(&mut self, now: Duration, sae: &str, key_id: &KeyId) {
        let Some(peer) = self.peers.get_mut(sae) else { return };
        let DialState::UnspentKey(held) = &mut peer.state else { return };
        if held.key_id != *key_id {
            return;
        }
        let wait = REDIAL[held.refusals.min(REDIAL.len() - 1)];
        held.refusals += 1;
        held.not_before = now + wait;
        // Only the time between two consecutive refusals counts, without the caller's own pauses.
        let since =
            held.last_refusal.replace(now).map_or(Duration::ZERO, |last| now.saturating_sub(last));
        held.refused_for += since.min(2 * REDIAL[REDIAL.len() - 1]);
        let patience = REFUSED_FOR + self.answer;
        if held.refused_for >= patience {
            let why = format!(
                "peer does not have key_ID {key_id} after {patience:?}: its KME does not give it, or \
                 cannot be asked; its own log says which"
            );
            peer.failed(now, why);
        }
    }

    /// Handles an attempt under `key_id` without an answer. The key stays, because silence proves nothing about it.
    pub fn handle_silence(&mut self, _now: Duration, sae: &str, key_id: &KeyId) {
        if let Some(DialPeer { state: DialState::UnspentKey(held), .. }) = self.peers.get_mut(sae)
            && held.key_id == *key_id
        {
            held.last_refusal = None;
        }
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        self.expire(now);
        let asked = self.peers.values().filter(|p| matches!(p.state, DialState::Asked)).count();
        if asked >= IN_FLIGHT {
            return None;
        }
        let (sae, peer) =
            self.peers.iter_mut().find(|(_, p)| matches!(p.state, DialState::Wanted))?;
        peer.state = DialState::Asked;
        Some(KmeRequest::Enc { slave: sae.clone(), number: 1, purpose: KeyPurpose::Bootstrap })
    }

    /// Handles the KME's answer to one of this host's requests.
    pub fn handle_answer(&mut self, now: Duration, answer: Answer) {
        let KmeRequest::Enc { slave, .. } = answer.request else { return };
        let Some(peer) = self.peers.get_mut(&slave) else { return };
        if !matches!(peer.state, DialState::Asked) {
            return;
        }
        let key = match answer.outcome {
            Ok(Fetched::Keys(mut keys)) if keys.len() == 1 => keys.remove(0),
            Ok(_) => return peer.failed(now, "the KME did not give one key".to_owned()),
            Err(failure) => return peer.failed(now, format!("enc_keys: {failure}")),
        };
        match derive(&key, &self.sae_id, &slave, self.cipher) {
            Ok(psk) => {
                peer.state = DialState::UnspentKey(UnspentKey {
                    key_id: key.0,
                    psk: Arc::new(psk),
                    since: now,
                    not_before: now,
                    refusals: 0,
                    mismatches: 0,
                    last_refusal: None,
                    refused_for: Duration::ZERO,
                });
            }
            Err(why) => peer.failed(now, why),
        }
    }

    /// Returns when to poll again without other cause: when a key expires.
    pub fn poll_timeout(&self) -> Option<Duration> {
        let end = |p: &DialPeer| match &p.state {
            DialState::UnspentKey(held) => Some(held.since + KEY_MAX_AGE),
            _ => None,
        };
        self.peers.values().filter_map(end).min()
    }

    fn expire(&mut self, now: Duration) {
        for peer in self.peers.values_mut() {
            if matches!(&peer.state, DialState::UnspentKey(held) if held.since + KEY_MAX_AGE <= now)
            {
                peer.state = DialState::Empty { not_before: now, why: String::new() };
            }
        }
    }

    /// Removes an idle peer if there are too many. Returns whether there is room for another peer.
    fn make_room(&mut self, now: Duration) -> bool {
        if self.peers.len() < MAX_PEERS {
            return true;
        }
        let idle = |p: &DialPeer| matches!(p.state, DialState::Empty { not_before, .. } if not_before <= now);
        let Some(sae) = self.peers.iter().find(|(_, p)| idle(p)).map(|(sae, _)| sae.clone()) else {
            return false;
        };
        self.peers.remove(&sae);
        true
    }
}

impl DialPeer {
    fn new() -> Self {
        Self {
            state: DialState::Empty { not_before: Duration::ZERO, why: String::new() },
            failures: 0,
        }
    }

    /// Handles a failed call or key: erases a held PSK, also for attempts in flight, and leaves the KME alone for a
    /// while.
    fn failed(&mut self, now: Duration, why: String) {
        let wait = Duration::from_secs(1 << self.failures.min(6)).min(BACK_OFF_MAX);
        self.failures += 1;
        self.state = DialState::Empty { not_before: now + wait, why };
    }
}

fn derive(
    (key_id, key): &(KeyId, KmeKey),
    client: &str,
    server: &str,
    cipher: Cipher,
) -> Result<Psk, String> {
    let text = std::str::from_utf8(key_id.as_bytes())
        .map_err(|_| format!("the KME named a key {key_id}, which is no text"))?;
    qkd::derive_psk(key.expose_secret(), text, client, server, cipher).map_err(|e| e.to_string())
}
