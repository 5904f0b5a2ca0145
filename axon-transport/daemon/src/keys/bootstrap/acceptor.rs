//! Server side: looks up the PSK identity of a handshake without blocking; fetches missing keys at a bounded rate.

use std::{
    collections::{HashMap, VecDeque},
    fmt,
    net::IpAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use axon_envelope::KeyId;
use axon_tls::{
    Cipher,
    qkd::{self, Psk, PskIdentity, PskResolver},
};
use axon_transport::config::QkdPeers;
use secrecy::ExposeSecret;

use super::{
    Completion,
    limits::{Buckets, HandshakeSource, IN_FLIGHT, PER_SOURCE, ProofBackoff, RESERVED_IN_FLIGHT},
    seen_set::{Fingerprint, SeenSet, fingerprint},
};
use crate::keys::{
    Clock,
    request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest},
};

/// Most unspent PSKs that are kept for one SAE.
const CACHED: usize = 8;
/// Most SAEs with unspent PSKs.
const CACHED_SAES: usize = 256;
/// The time for which an unspent PSK is kept.
const CACHED_FOR: Duration = Duration::from_secs(60);
/// Most remembered keys that the KME does not know.
const UNKNOWN: usize = 1024;
/// The time for which a key is not requested again after it was unknown twice, and for which an unknown key is
/// remembered at all.
const UNKNOWN_FOR: Duration = Duration::from_secs(30);
/// The time for which a key is not requested again after it was unknown once. KMEs that still relay a key answer as if
/// there were none, and the dialler gives a key up after ten seconds.
const MISSED_FOR: Duration = Duration::from_secs(1);
/// Most remembered spent keys.
const SPENT: usize = 4096;
/// Most sources, and most SAEs, that are remembered to have authenticated.
const KNOWN: usize = 1024;
/// The time after which a call counts as lost, answered or not.
const LOST: Duration = Duration::from_secs(60);

/// The action of a look-up for a key that is not at hand.
#[derive(Clone, Copy)]
enum CacheMiss {
    /// The KME is asked for the key, within the limits of its source.
    Fetch,
    /// No action.
    Leave,
}

/// The result of a look-up.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Lookup {
    /// The PSK is at hand.
    Found,
    /// The KME is being asked: the client's next attempt may find the key.
    Fetching,
    /// A handshake under this key was completed before.
    Spent,
    /// The KME does not know this key.
    UnknownKeyId,
    /// The identity's SAE is not in `AXON_QKD_PEERS`.
    NotAPeer,
    /// The identity names this host's own SAE.
    OwnSaeId,
    /// The identity does not have AXON's form.
    Malformed,
    /// A limit on calls to the KME is reached, or the client has to wait after failed proofs; the text says which.
    Limited(&'static str),
    /// The last call to the KME for this key failed for this reason. The KME is being asked again.
    KmeFailed(String),
}

impl fmt::Display for Lookup {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Found => f.write_str("key at hand"),
            Self::Fetching => f.write_str("the KME is being asked for this key"),
            Self::Spent => f.write_str("a handshake under this key was completed before"),
            Self::UnknownKeyId => f.write_str("the KME does not know this key_ID"),
            Self::NotAPeer => f.write_str("this SAE is not in AXON_QKD_PEERS"),
            Self::OwnSaeId => f.write_str("the client claims this host's own SAE ID"),
            Self::Malformed => f.write_str("not an identity of the form axon-qkd-v1:SAE:key_ID"),
            Self::Limited(which) => {
                write!(f, "it would cost too many keys or calls to the KME: {which}")
            }
            Self::KmeFailed(why) => write!(f, "dec_keys: {why}"),
        }
    }
}

/// The keys with which this host accepts handshakes. The daemon has one acceptor; clones share it.
///
/// Look-ups happen inside the TLS handshake, on the thread that drives it. So all methods take `&self`, and the time
/// comes from a [`Clock`].
#[derive(Clone)]
pub struct Acceptor(Arc<AcceptorInner>);

struct AcceptorInner {
    sae_id: String,
    allowed: QkdPeers,
    cipher: Cipher,
    clock: Clock,
    state: Mutex<AcceptorState>,
}

struct AcceptorState {
    cached: HashMap<String, VecDeque<Cached>>,
    /// Calls that are queued or in flight.
    pending: Vec<Pending>,
    /// Identities whose key was unknown to the KME once.
    missed: SeenSet<Fingerprint>,
    /// Identities whose key was unknown to the KME again.
    unknown: SeenSet<Fingerprint>,
    /// Keys whose last call failed, with the reason.
    failed: VecDeque<(Fingerprint, String)>,
    spent: SeenSet<Fingerprint>,
    buckets: Buckets,
    unproven: ProofBackoff,
    known_sources: SeenSet<HandshakeSource>,
    known_saes: SeenSet<String>,
}

struct Cached {
    psk: Arc<Psk>,
    since: Duration,
}

impl Drop for Cached {
    /// Erases the PSK explicitly: a handshake that looked it up shares it.
    fn drop(&mut self) {
        self.psk.erase();
    }
}

struct Pending {
    identity: PskIdentity,
    key_id: KeyId,
    source: HandshakeSource,
    known: bool,
    since: Duration,
    asked: bool,
}

impl Acceptor {
    /// Creates the acceptor of the host `sae_id`, which accepts `allowed`.
    pub fn new(sae_id: &str, allowed: QkdPeers, cipher: Cipher, clock: Clock) -> Self {
        Self(Arc::new(AcceptorInner {
            sae_id: sae_id.to_owned(),
            allowed,
            cipher,
            clock,
            state: Mutex::new(AcceptorState {
                cached: HashMap::new(),
                pending: Vec::new(),
                missed: SeenSet::new(UNKNOWN),
                unknown: SeenSet::new(UNKNOWN),
                failed: VecDeque::new(),
                spent: SeenSet::new(SPENT),
                buckets: Buckets::default(),
                unproven: ProofBackoff::default(),
                known_sources: SeenSet::new(KNOWN),
                known_saes: SeenSet::new(KNOWN),
            }),
        }))
    }

    /// Returns the resolver for one incoming connection from a validated `source`.
    pub fn resolver(&self, source: IpAddr) -> Arc<Resolver> {
        let acceptor = self.clone();
        Arc::new(Resolver { acceptor, source, last: Mutex::new(None) })
    }

    /// Looks up a key that a probe names before its handshake, and fetches it within the same limits.
    pub fn prefetch(&self, source: IpAddr, identity: &[u8]) -> Lookup {
        self.look_up(source, identity, CacheMiss::Fetch).0
    }

    /// Handles a complete handshake under `identity`: the key is spent, and erased.
    pub fn spent(&self, identity: &[u8]) -> Completion {
        let now = self.0.clock.now();
        let Ok(parsed) = PskIdentity::parse(identity) else { return Completion::Reused };
        let mut state = self.state();
        if let Some(cached) = state.cached.get_mut(parsed.client_sae()) {
            cached.retain(|c| c.psk.identity() != identity);
        }
        match state.spent.insert(now, fingerprint(parsed.key_id().as_bytes())) {
            true => Completion::First,
            false => Completion::Reused,
        }
    }

    /// Records that `client_sae` proved its name from `source`. Both have reserved capacity from now on.
    pub fn authenticated(&self, source: IpAddr, client_sae: &str) {
        let now = self.0.clock.now();
        let mut state = self.state();
        state.known_sources.insert(now, source.into());
        state.known_saes.insert(now, client_sae.to_owned());
        state.unproven.proven(source.into(), client_sae);
    }

    /// Records that a client that claims to be `client_sae` had a key announced and did not prove to hold it. Each such
    /// attempt costs a key, so repeated attempts from this source have to wait.
    pub fn unproven(&self, source: IpAddr, client_sae: &str) {
        let now = self.0.clock.now();
        self.state().unproven.failed(now, source.into(), client_sae);
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&self) -> Option<KmeRequest> {
        let mut state = self.state();
        let pending = state.pending.iter_mut().find(|p| !p.asked)?;
        pending.asked = true;
        Some(KmeRequest::Dec {
            master: pending.identity.client_sae().to_owned(),
            key_ids: vec![pending.key_id.clone()],
            purpose: KeyPurpose::Accept,
        })
    }

    /// Handles the KME's answer to one of this host's requests.
    pub fn handle_answer(&self, answer: Answer) {
        let now = self.0.clock.now();
        let KmeRequest::Dec { master, key_ids, .. } = answer.request else { return };
        let mut state = self.state();
        let Some(i) = state
            .pending
            .iter()
            .position(|p| p.identity.client_sae() == master && key_ids.first() == Some(&p.key_id))
        else {
            return;
        };
        let pending = state.pending.swap_remove(i);
        let seen = fingerprint(&pending.identity.to_bytes());
        let failure = match answer.outcome {
            Ok(Fetched::Keys(keys)) => match keys.as_slice() {
                [(key_id, key)] if *key_id == pending.key_id => {
                    let name = pending.identity.key_id();
                    match qkd::derive_psk(
                        key.expose_secret(),
                        name,
                        &master,
                        &self.0.sae_id,
                        self.0.cipher,
                    ) {
                        Ok(psk) => return state.keep(now, master, psk, name),
                        Err(e) => e.to_string(),
                    }
                }
                _ => "the KME did not give the one key asked for".to_owned(),
            },
            Ok(Fetched::Stock(_)) => "the KME answered another call".to_owned(),
            Err(failure) if failure.kind == FailureKind::Refused => {
                if state.missed.last_seen(&seen).is_some() {
                    state.unknown.insert(now, seen);
                } else {
                    state.missed.insert(now, seen);
                }
                return;
            }
            Err(failure) => failure.text,
        };
        if state.failed.len() == IN_FLIGHT {
            state.failed.pop_front();
        }
        state.failed.push_back((seen, failure));
    }

    /// Returns the number of unspent keys at hand, for status.
    pub fn cached(&self) -> usize {
        self.state().cached.values().map(VecDeque::len).sum()
    }

    /// Erases expired keys and entries; to be called about once a second.
    pub fn expire(&self) {
        let now = self.0.clock.now();
        self.state().expire(now);
    }

    fn look_up(
        &self,
        source: IpAddr,
        identity: &[u8],
        miss: CacheMiss,
    ) -> (Lookup, Option<Arc<Psk>>) {
        let inner = &*self.0;
        let Ok(parsed) = PskIdentity::parse(identity) else { return (Lookup::Malformed, None) };
        let Ok(key_id) = KeyId::new(parsed.key_id()) else { return (Lookup::Malformed, None) };
        // Only one encoding of an identity is accepted: here the same key in another encoding would count as another.
        if parsed.to_bytes() != identity {
            return (Lookup::Malformed, None);
        }
        if parsed.client_sae() == inner.sae_id {
            return (Lookup::OwnSaeId, None);
        }
        if !inner.allowed.allows(parsed.client_sae()) {
            return (Lookup::NotAPeer, None);
        }
        let now = inner.clock.now();
        let mut state = self.state();
        state.expire(now);
        if state.spent.contains(&fingerprint(key_id.as_bytes())) {
            return (Lookup::Spent, None);
        }
        if state.unproven.waits(now, source.into(), parsed.client_sae()) {
            let which = "it did not prove its name with the last keys, and has to wait";
            return (Lookup::Limited(which), None);
        }
        let cached = state.cached.get(parsed.client_sae());
        if let Some(c) = cached.and_then(|c| c.iter().find(|c| c.psk.identity() == identity)) {
            return (Lookup::Found, Some(Arc::clone(&c.psk)));
        }
        if state.pending.iter().any(|p| p.identity == parsed) {
            return (Lookup::Fetching, None);
        }
        if matches!(miss, CacheMiss::Leave) {
            return (Lookup::UnknownKeyId, None);
        }
        let seen = fingerprint(identity);
        let missed = state.missed.last_seen(&seen);
        let missed = missed.is_some_and(|at| now.saturating_sub(at) < MISSED_FOR);
        if missed || state.unknown.contains(&seen) {
            return (Lookup::UnknownKeyId, None);
        }
        let source = HandshakeSource::from(source);
        let limited = state.limit(now, &inner.allowed, source, parsed.client_sae());
        let failure = state.failed.iter().position(|(f, _)| *f == seen);
        let failure = failure.and_then(|i| state.failed.remove(i));
        if let Some(which) = limited {
            return (Lookup::Limited(which), None);
        }
        let known = state.known_sources.contains(&source);
        let identity = parsed;
        state.pending.push(Pending { identity, key_id, source, known, since: now, asked: false });
        drop(state);
        (failure.map_or(Lookup::Fetching, |(_, why)| Lookup::KmeFailed(why)), None)
    }

    fn state(&self) -> MutexGuard<'_, AcceptorState> {
        // No operation leaves the state half-changed, so the state is consistent even if a thread panicked.
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Acceptor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Acceptor").field("sae_id", &self.0.sae_id).finish_non_exhaustive()
    }
}

impl AcceptorState {
    /// Returns the limit that forbids another call, if any. Takes a token if no limit forbids it.
    fn limit(
        &mut self,
        now: Duration,
        allowed: &QkdPeers,
        source: HandshakeSource,
        sae: &str,
    ) -> Option<&'static str> {
        let known = self.known_sources.contains(&source);
        let strangers = self.pending.iter().filter(|p| !p.known).count();
        if self.pending.len() >= IN_FLIGHT {
            return Some("16 in flight");
        }
        if !known && strangers >= IN_FLIGHT - RESERVED_IN_FLIGHT {
            return Some("8 in flight for addresses that never authenticated");
        }
        let same = |p: &&Pending| p.source == source && p.identity.client_sae() == sae;
        if self.pending.iter().filter(same).count() >= PER_SOURCE {
            return Some("2 in flight for one address and SAE");
        }
        // With `*` any client can invent names, so names that never authenticated share a bucket.
        let own =
            matches!(allowed, QkdPeers::Listed(_)) || self.known_saes.contains(&sae.to_owned());
        // Unknown sources that name an SAE must not empty the bucket of this SAE's own address.
        let sae = if own { sae } else { "" };
        let bucket = format!("{} {sae}", if known { "known" } else { "new" });
        if !self.buckets.take(now, &bucket) {
            return Some("5 a second for one SAE");
        }
        None
    }

    fn keep(&mut self, now: Duration, sae: String, psk: Psk, key_id: &str) {
        if self.spent.contains(&fingerprint(key_id.as_bytes())) {
            return;
        }
        if !self.cached.contains_key(&sae) && self.cached.len() >= CACHED_SAES {
            let oldest = |c: &VecDeque<Cached>| c.front().map(|c| c.since);
            let oldest = self.cached.iter().min_by_key(|(_, c)| oldest(c)).map(|(s, _)| s.clone());
            oldest.and_then(|sae| self.cached.remove(&sae));
        }
        let cached = self.cached.entry(sae).or_default();
        if cached.len() >= CACHED {
            cached.pop_front();
        }
        cached.push_back(Cached { psk: Arc::new(psk), since: now });
    }

    fn expire(&mut self, now: Duration) {
        let young = |since: Duration, limit: Duration| now.saturating_sub(since) < limit;
        for cached in self.cached.values_mut() {
            cached.retain(|c| young(c.since, CACHED_FOR));
        }
        self.cached.retain(|_, cached| !cached.is_empty());
        self.pending.retain(|p| young(p.since, LOST));
        self.missed.forget_before(now.saturating_sub(UNKNOWN_FOR));
        self.unknown.forget_before(now.saturating_sub(UNKNOWN_FOR));
        self.buckets.expire(now);
        self.unproven.expire(now);
    }
}

/// The look-up of keys for one incoming connection, with its last result.
pub struct Resolver {
    acceptor: Acceptor,
    source: IpAddr,
    last: Mutex<Option<(Lookup, Option<PskIdentity>)>>,
}

impl Resolver {
    /// Returns the result of the look-up; `None` before the client's identity was seen.
    pub fn outcome(&self) -> Option<Lookup> {
        self.last().as_ref().map(|(lookup, _)| lookup.clone())
    }

    /// Returns the identity that was looked up, if it has the right form.
    pub fn identity(&self) -> Option<PskIdentity> {
        self.last().as_ref().and_then(|(_, identity)| identity.clone())
    }

    fn last(&self) -> MutexGuard<'_, Option<(Lookup, Option<PskIdentity>)>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PskResolver for Resolver {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        let (lookup, psk) = self.acceptor.look_up(self.source, identity, CacheMiss::Fetch);
        *self.last() = Some((lookup, PskIdentity::parse(identity).ok()));
        psk
    }

    fn resolve_known(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        let (lookup, psk) = self.acceptor.look_up(self.source, identity, CacheMiss::Leave);
        let psk = psk?;
        *self.last() = Some((lookup, PskIdentity::parse(identity).ok()));
        Some(psk)
    }
}

impl fmt::Debug for Resolver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Resolver").field("source", &self.source).finish_non_exhaustive()
    }
}
