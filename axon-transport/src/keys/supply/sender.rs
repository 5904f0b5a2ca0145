//! The sending direction: fetches keys ahead, announces them, and seals under those that are READY.

use std::{
    collections::{HashMap, HashSet, VecDeque},
    time::Duration,
};

use axon_envelope::{
    Channel, ChannelError, Delivery, KEY_MAX_AGE, KeyId, KmeKey, MAX_HEADER_LEN, MESSAGES_PER_KEY,
    Sealer, Slot, TAG_LEN,
};
use serde::Serialize;
use zeroize::Zeroizing;

use super::{MAX_UNRETIRED, SupplyError, SupplyWarning, calls::Calls, demand::Demand};
use crate::keys::{
    Exporters, KeyMessage, Violation, message, proof,
    request::{Answer, Fetched, Request},
};

/// How long an announced key waits for READY or FAILED: the receiver's tries, and more.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);

/// The keys of this host's messages to one peer.
pub struct Sender {
    local: String,
    peer: String,
    link: Option<Link>,
    /// Held, to be announced.
    fresh: VecDeque<Fresh>,
    announced: HashMap<KeyId, Announced>,
    /// READY, in the order of use. Only the first may have sealed anything.
    ready: VecDeque<Sealer>,
    /// When the first of `ready` was first handed out.
    begun: Option<Duration>,
    outbox: VecDeque<(u64, KeyMessage)>,
    calls: Calls,
    demand: Demand,
    counts: Counts,
}

struct Link {
    conn: u64,
    channel: Channel,
    ready: Zeroizing<[u8; 32]>,
}

struct Fresh {
    key_id: KeyId,
    key: KmeKey,
    /// When it was asked for, where its lead time is to be measured.
    asked: Option<Duration>,
}

struct Announced {
    key: KmeKey,
    asked: Option<Duration>,
    since: Duration,
}

#[derive(Default)]
struct Counts {
    sealed: u64,
    retired: u64,
    failed: u64,
    no_key: u64,
    last_failure: Option<String>,
}

/// Why no message can be sealed now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NoKey {
    /// No key is READY.
    #[error("no_key: no key is ready")]
    None,
    /// Those that are READY are kept for RELIABLE and services.
    #[error("no_key: the last keys are kept for RELIABLE and services")]
    Reserved,
    /// There is no connection.
    #[error("no_key: no connection")]
    Detached,
}

/// How a [`Sender`] stands, for status. Rates are keys a second.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct SenderStatistics {
    /// Keys that are READY, with the one in use.
    pub ready: usize,
    /// Keys announced and not answered.
    pub announced: usize,
    /// Keys asked for and not there.
    pub asked: usize,
    /// Keys that should be on their way or READY.
    pub target: usize,
    /// Keys that the messages need.
    pub demand: f64,
    /// Keys that the KME gives, where it was seen at its limit.
    pub supply: Option<f64>,
    /// From asking for a key to READY.
    pub lead_ms: f64,
    /// Messages sealed under keys that are retired.
    pub sealed: u64,
    /// Keys retired.
    pub retired: u64,
    /// Keys that the peer could not fetch, or did not answer.
    pub failed: u64,
    /// How often a message was refused for want of a key.
    pub no_key: u64,
    /// Why the last key failed.
    pub last_failure: Option<String>,
}

impl Sender {
    /// For what `local_sae` sends to `peer_sae`.
    ///
    /// # Errors
    /// SAE IDs that make no channel: empty, too long, equal.
    pub fn new(local_sae: &str, peer_sae: &str) -> Result<Self, ChannelError> {
        Channel::new(local_sae, peer_sae, [])?;
        Ok(Self {
            local: local_sae.to_owned(),
            peer: peer_sae.to_owned(),
            link: None,
            fresh: VecDeque::new(),
            announced: HashMap::new(),
            ready: VecDeque::new(),
            begun: None,
            outbox: VecDeque::new(),
            calls: Calls::new(),
            demand: Demand::new(),
            counts: Counts::default(),
        })
    }

    /// Moves to a new connection. Keys under which nothing was sealed are announced again there;
    /// a begun one is retired. Returns the RETIREs that are owed on the connection before, each
    /// with that connection: to be sent there, if it is open, and nowhere else.
    ///
    /// # Errors
    /// The SAE IDs make no channel.
    pub fn attach(
        &mut self,
        now: Duration,
        conn: u64,
        exporters: &Exporters,
    ) -> Result<Vec<(u64, KeyMessage)>, SupplyError> {
        let channel = Channel::new(&self.local, &self.peer, exporters.envelope())?;
        self.unbind(now);
        let retire = |(_, m): &(u64, KeyMessage)| matches!(m, KeyMessage::Retire { .. });
        let owed = self.outbox.drain(..).filter(retire).collect();
        self.link = Some(Link { conn, channel, ready: Zeroizing::new(*exporters.ready()) });
        Ok(owed)
    }

    /// A connection is closed. Keys under which nothing was sealed wait for the next.
    pub fn detach(&mut self, now: Duration, conn: u64) {
        if self.link.as_ref().is_some_and(|link| link.conn == conn) {
            self.unbind(now);
            self.outbox.clear();
            self.link = None;
        }
    }

    /// The connection that [`slot`](Self::slot) seals for. What is sealed opens on no other.
    pub fn attached(&self) -> Option<u64> {
        self.link.as_ref().map(|link| link.conn)
    }

    /// Takes on a key that the peer has proven to hold on `conn`, as READY.
    ///
    /// # Errors
    /// The system gives no random bytes.
    pub fn adopt(
        &mut self,
        _now: Duration,
        conn: u64,
        key_id: KeyId,
        key: KmeKey,
    ) -> Result<(), SupplyError> {
        match &self.link {
            Some(link) if link.conn == conn => {
                self.ready.push_back(Sealer::new(&link.channel, key_id, key)?);
            }
            _ if self.unretired() >= MAX_UNRETIRED => {}
            _ => self.fresh.push_back(Fresh { key_id, key, asked: None }),
        }
        Ok(())
    }

    /// `messages` more are to be sent to this peer. Once for each, however often it is tried.
    pub fn demand(&mut self, now: Duration, messages: u32) {
        self.demand.messages(now, messages);
    }

    /// A permit to seal one message, at once and on the attached connection. Services seal as
    /// [`Delivery::Reliable`].
    ///
    /// # Errors
    /// [`NoKey`]. Never an eleventh message under a key, never a key that is not READY.
    pub fn slot(&mut self, now: Duration, delivery: Delivery) -> Result<Slot<'_>, NoKey> {
        self.settle(now);
        if let Err(no_key) = self.allowed(now, delivery) {
            self.counts.no_key += 1;
            return Err(no_key);
        }
        self.begun.get_or_insert(now);
        let first = self.ready.front_mut().ok_or(NoKey::None)?;
        first.slot(now, delivery).map_err(|_| NoKey::None)
    }

    /// Bytes that an envelope has more than its plaintext: an upper bound for the next
    /// [`slot`](Self::slot), since KMEs name keys as they like.
    pub fn overhead(&self) -> usize {
        self.ready.iter().map(Sealer::overhead).max().unwrap_or(MAX_HEADER_LEN + TAG_LEN)
    }

    /// How many messages could be sealed now.
    pub fn available(&self, now: Duration, delivery: Delivery) -> u32 {
        if self.allowed(now, delivery).is_err() {
            return 0;
        }
        let all: u32 = self.ready.iter().map(|s| u32::from(s.remaining())).sum();
        let kept = match delivery {
            Delivery::Reliable => 0,
            Delivery::BestEffort => self.demand.reserve(now) as u32 * u32::from(MESSAGES_PER_KEY),
        };
        all.saturating_sub(kept)
    }

    /// READY or FAILED from the peer.
    ///
    /// # Errors
    /// The peer broke a rule, or the system gives no random bytes.
    pub fn on_message(
        &mut self,
        now: Duration,
        conn: u64,
        message: &KeyMessage,
    ) -> Result<(), SupplyError> {
        // What comes late on a connection before is about keys that were announced anew.
        let Some(link) = self.link.as_ref().filter(|link| link.conn == conn) else {
            return Ok(());
        };
        match message {
            KeyMessage::Ready { key_id, proof } => {
                let Some(waiting) = self.announced.get(key_id) else { return Ok(()) };
                if !proof::verify(&waiting.key, key_id, &link.ready, proof) {
                    return Err(Violation::WrongProof(key_id.clone()).into());
                }
                let Some(Announced { key, asked, .. }) = self.announced.remove(key_id) else {
                    return Ok(());
                };
                self.calls.key_ready();
                if let Some(asked) = asked {
                    self.demand.ready(now.saturating_sub(asked));
                }
                self.ready.push_back(Sealer::new(&link.channel, key_id.clone(), key)?);
                Ok(())
            }
            KeyMessage::Failed { key_id, reason } => {
                if self.announced.remove(key_id).is_some() {
                    self.calls.key_refused(now);
                    self.failed(format!("peer could not fetch key_ID {key_id}: {reason}"));
                }
                Ok(())
            }
            other => Err(Violation::Unexpected(other.name()).into()),
        }
    }

    /// What is to be sent next, and on which connection.
    pub fn poll_message(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        self.settle(now);
        self.drop_unanswered(now);
        self.outbox.pop_front().or_else(|| self.announce(now))
    }

    /// The next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<Request> {
        self.settle(now);
        self.link.as_ref()?;
        let room = MAX_UNRETIRED.saturating_sub(self.unretired());
        let ahead = self.fresh.len() + self.announced.len() + self.unbegun();
        let target = self.demand.target(now).min(ahead + room);
        self.calls.poll(now, &self.peer, target.saturating_sub(ahead), self.demand.per_call())
    }

    /// The KME's answer to one of our requests.
    pub fn on_answer(&mut self, now: Duration, answer: Answer) {
        let Some(waited) = self.calls.answered(now, &answer) else { return };
        let asked = now.saturating_sub(answer.took);
        match answer.outcome {
            Ok(Fetched::Stock(stock)) => self.demand.stocked(now, stock),
            Ok(Fetched::Keys(keys)) => {
                self.demand.answered(waited, keys.len());
                let held: HashSet<KeyId> = self.held().cloned().collect();
                for (key_id, key) in keys {
                    if held.contains(&key_id) {
                        self.failed(format!("the KME gave key_ID {key_id} twice"));
                    } else if !message::announceable(&key_id) {
                        self.failed(format!("key_ID {key_id} is no text of at most 128 bytes"));
                    } else {
                        self.fresh.push_back(Fresh { key_id, key, asked: Some(asked) });
                    }
                }
            }
            Err(failure) => {
                self.demand.answered(waited, 0);
                self.counts.last_failure = Some(failure.text);
            }
        }
    }

    /// When to poll again without other cause.
    pub fn poll_timeout(&self, _now: Duration) -> Option<Duration> {
        let used = self.begun.map(|at| at + KEY_MAX_AGE);
        let unanswered = self.announced.values().map(|a| a.since + ANSWER_WITHIN).min();
        let calls = self.link.as_ref().and_then(|_| self.calls.poll_timeout());
        [used, unanswered, calls].into_iter().flatten().min()
    }

    /// How it stands.
    pub fn statistics(&self, now: Duration) -> SenderStatistics {
        SenderStatistics {
            ready: self.ready.len(),
            announced: self.announced.len(),
            asked: self.calls.keys_asked(),
            target: self.demand.target(now),
            demand: self.demand.demand(now),
            supply: self.demand.supply(),
            lead_ms: self.demand.lead_time().as_secs_f64() * 1e3,
            sealed: self.counts.sealed,
            retired: self.counts.retired,
            failed: self.counts.failed,
            no_key: self.counts.no_key,
            last_failure: self.counts.last_failure.clone(),
        }
    }

    /// Says that demand comes close to supply; at most every ten seconds.
    pub fn warning(&mut self, now: Duration) -> Option<SupplyWarning> {
        self.demand.warning(now)
    }

    fn allowed(&self, now: Duration, delivery: Delivery) -> Result<(), NoKey> {
        if self.link.is_none() {
            return Err(NoKey::Detached);
        }
        match (self.ready.len(), delivery) {
            (0, _) => Err(NoKey::None),
            (n, Delivery::BestEffort) if n <= self.demand.reserve(now) => Err(NoKey::Reserved),
            _ => Ok(()),
        }
    }

    /// Retires the key in use once it is finished.
    fn settle(&mut self, now: Duration) {
        while let Some(first) = self.ready.front() {
            let old = self.begun.is_some_and(|at| now.saturating_sub(at) >= KEY_MAX_AGE);
            if !old && first.spent(now).is_none() {
                break;
            }
            self.retire_first();
        }
    }

    fn drop_unanswered(&mut self, now: Duration) {
        let late = |a: &Announced| now.saturating_sub(a.since) >= ANSWER_WITHIN;
        let late: Vec<KeyId> =
            self.announced.iter().filter(|(_, a)| late(a)).map(|(id, _)| id.clone()).collect();
        for key_id in late {
            self.announced.remove(&key_id);
            self.calls.key_refused(now);
            self.failed(format!("peer did not answer ANNOUNCE of key_ID {key_id}"));
            let (used, reliable) = Default::default();
            self.tell(KeyMessage::Retire { key_id, used, reliable });
        }
    }

    fn retire_first(&mut self) {
        self.begun = None;
        let Some(sealer) = self.ready.pop_front() else { return };
        let retirement = sealer.retire();
        self.counts.retired += 1;
        self.counts.sealed += retirement.used.len() as u64;
        let (key_id, used) = (retirement.key_id, retirement.used);
        self.tell(KeyMessage::Retire { key_id, used, reliable: retirement.reliable });
    }

    fn tell(&mut self, message: KeyMessage) {
        if let Some(link) = &self.link {
            self.outbox.push_back((link.conn, message));
        }
    }

    fn announce(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        let conn = self.link.as_ref()?.conn;
        let room = MAX_UNRETIRED.saturating_sub(self.announced.len() + self.ready.len());
        let count = self.fresh.len().min(message::MAX_ANNOUNCED).min(room);
        if count == 0 {
            return None;
        }
        let mut key_ids = Vec::with_capacity(count);
        for Fresh { key_id, key, asked } in self.fresh.drain(..count) {
            key_ids.push(key_id.clone());
            self.announced.insert(key_id, Announced { key, asked, since: now });
        }
        Some((conn, KeyMessage::Announce(key_ids)))
    }

    /// Takes all keys off the connection: the begun one ends, the others are fresh again.
    fn unbind(&mut self, now: Duration) {
        self.settle(now);
        let mut unused = VecDeque::new();
        while let Some(sealer) = self.ready.pop_front() {
            match sealer.into_unused() {
                Ok((key_id, key)) => unused.push_back(Fresh { key_id, key, asked: None }),
                Err(begun) => {
                    self.ready.push_front(begun);
                    self.retire_first();
                }
            }
        }
        self.begun = None;
        for (key_id, Announced { key, .. }) in self.announced.drain() {
            unused.push_back(Fresh { key_id, key, asked: None });
        }
        unused.append(&mut self.fresh);
        self.fresh = unused;
    }

    /// READY keys under which nothing was sealed.
    fn unbegun(&self) -> usize {
        self.ready.len() - usize::from(self.begun.is_some() && !self.ready.is_empty())
    }

    fn unretired(&self) -> usize {
        self.fresh.len() + self.announced.len() + self.ready.len() + self.calls.keys_asked()
    }

    fn held(&self) -> impl Iterator<Item = &KeyId> {
        let fresh = self.fresh.iter().map(|f| &f.key_id);
        fresh.chain(self.announced.keys()).chain(self.ready.iter().map(Sealer::key_id))
    }

    fn failed(&mut self, why: String) {
        self.counts.failed += 1;
        self.counts.last_failure = Some(why);
    }
}
