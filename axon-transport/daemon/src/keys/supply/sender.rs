//! The sending direction: fetches keys ahead, announces them, and seals messages under keys that are READY.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
    time::Duration,
};

use axon_envelope::{
    Channel, ChannelError, Delivery, KEY_MAX_AGE, KeyId, KmeKey, MAX_HEADER_LEN, MESSAGES_PER_KEY,
    Sealer, Slot, TAG_LEN,
};
use serde::Serialize;

use super::{
    Disagreement, MAX_UNRETIRED, SupplyError, SupplyWarning,
    demand::{self, Demand},
    disagreement::Disagreements,
    pool::{KeyStock, UnusedKey},
};
use crate::{
    keys::{
        Exporters, KeyMessage, KeyViolation,
        exporters::Exporter,
        proof,
        request::{Answer, KmeRequest},
    },
    wire::keys::MAX_ANNOUNCED,
};

/// The longest wait for READY or FAILED of an announced key, over all connections that it is announced on. It is longer
/// than the receiver's attempts.
const ANSWER_WITHIN: Duration = Duration::from_secs(60);

/// The keys of this host's messages to one peer.
pub struct KeySender {
    local: String,
    peer: String,
    link: Option<SenderLink>,
    /// Keys that are drawn or being drawn, and have to be announced.
    pool: KeyStock,
    announced: HashMap<KeyId, Announced>,
    /// READY keys, in the order of use. Only the first may have sealed messages.
    ready: VecDeque<Sealer>,
    /// The time at which the first key of `ready` was first handed out.
    begun: Option<Duration>,
    outbox: VecDeque<(u64, KeyMessage)>,
    demand: Demand,
    disagreements: Disagreements,
    counts: SenderCounts,
}

struct SenderLink {
    conn: u64,
    channel: Channel,
    ready: Exporter,
}

struct Announced {
    key: KmeKey,
    asked: Option<Duration>,
    /// The time of its first announcement, on any connection.
    since: Duration,
}

#[derive(Default)]
struct SenderCounts {
    sealed: u64,
    retired: u64,
    failed: u64,
    disagreed: u64,
    no_key: u64,
    last_failure: Option<String>,
}

/// The reason for which no message can be sealed now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NoKey {
    /// No key is READY.
    #[error("no_key: no key is ready")]
    None,
    /// The READY keys are reserved for RELIABLE and services.
    #[error("no_key: the last keys are kept for RELIABLE and services")]
    Reserved,
    /// There is no connection.
    #[error("no_key: no connection")]
    Detached,
}

/// The statistics of a [`KeySender`], for status. Rates are keys per second.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct SenderStatistics {
    /// Keys that are READY, including the key in use.
    pub ready: usize,
    /// Keys that are announced and not answered.
    pub announced: usize,
    /// Keys that are requested and have not arrived.
    pub asked: usize,
    /// The number of keys that should be in flight or READY, within the KME's stock.
    pub target: usize,
    /// Keys per second that the messages need.
    pub demand: f64,
    /// Keys per second that the KME gives, if the KME was observed at its limit.
    pub supply: Option<f64>,
    /// The time from the request for a key to READY, in milliseconds.
    pub lead_ms: f64,
    /// Messages that were sealed under retired keys.
    pub sealed: u64,
    /// Retired keys.
    pub retired: u64,
    /// Keys that the peer could not fetch or did not answer, or that the KME gave before.
    pub failed: u64,
    /// Keys whose proof did not match: the peer's KME gave it another key under the same key_ID.
    pub disagreed: u64,
    /// The number of times that a message was refused for lack of a key.
    pub no_key: u64,
    /// The reason for which the last key or call failed.
    pub last_failure: Option<String>,
}

impl KeySender {
    /// Creates the sender of the messages that `local_sae` sends to `peer_sae`.
    ///
    /// # Errors
    /// The SAE IDs do not make a channel: one is empty or too long, or both are equal.
    pub fn new(local_sae: &str, peer_sae: &str) -> Result<Self, ChannelError> {
        Self::with_jitter(local_sae, peer_sae, rand::random)
    }

    /// Creates a sender. `jitter` returns a random byte for each pause after a failed call.
    pub(super) fn with_jitter(
        local_sae: &str,
        peer_sae: &str,
        jitter: impl FnMut() -> u8 + Send + 'static,
    ) -> Result<Self, ChannelError> {
        Channel::new(local_sae, peer_sae, [])?;
        let mut sender = Self {
            local: local_sae.to_owned(),
            peer: peer_sae.to_owned(),
            link: None,
            pool: KeyStock::new(jitter),
            announced: HashMap::new(),
            ready: VecDeque::new(),
            begun: None,
            outbox: VecDeque::new(),
            demand: Demand::new(),
            disagreements: Disagreements::default(),
            counts: SenderCounts::default(),
        };
        sender.plan(Duration::ZERO);
        Ok(sender)
    }

    /// Moves to a new connection. Keys that sealed no message are announced again there; a key in use is retired.
    /// Returns the RETIREs that are owed on the connection before, each with that connection. The caller sends them
    /// there, if that connection is open, and nowhere else.
    ///
    /// # Errors
    /// The SAE IDs do not make a channel.
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
        self.link = Some(SenderLink { conn, channel, ready: Arc::clone(exporters.ready()) });
        Ok(owed)
    }

    /// Detaches a closed connection. Keys that sealed no message wait for the next connection.
    pub fn detach(&mut self, now: Duration, conn: u64) {
        if self.link.as_ref().is_some_and(|link| link.conn == conn) {
            self.unbind(now);
            self.outbox.clear();
            self.link = None;
        }
    }

    /// Returns the connection that [`slot`](Self::slot) seals for. The sealed messages open on no other connection.
    pub fn attached(&self) -> Option<u64> {
        self.link.as_ref().map(|link| link.conn)
    }

    /// Adds a key that the peer has proven to hold on `conn`, as READY. If `conn` is not attached, the key has to be
    /// announced instead. The key is dropped if its key_ID was there before or cannot be announced, or if there are too
    /// many keys.
    ///
    /// # Errors
    /// The system returns no random bytes.
    pub fn adopt(
        &mut self,
        now: Duration,
        conn: u64,
        key_id: KeyId,
        key: KmeKey,
    ) -> Result<(), SupplyError> {
        if self.unretired(now) >= MAX_UNRETIRED {
            return Ok(());
        }
        if let Err(why) = self.pool.admit(&key_id) {
            self.failed(why);
            return Ok(());
        }
        match &self.link {
            Some(link) if link.conn == conn => {
                self.ready.push_back(Sealer::new(&link.channel, key_id, key)?);
            }
            _ => self.pool.put(now, key_id, key),
        }
        Ok(())
    }

    /// Counts `messages` more that are to be sent to this peer. Each message counts once, however often it is tried.
    pub fn demand(&mut self, now: Duration, messages: u32) {
        self.demand.messages(now, messages);
    }

    /// Returns a permit to seal one message, at once and on the attached connection. Services seal as
    /// [`Delivery::Reliable`].
    ///
    /// # Errors
    /// [`NoKey`]. No key seals an eleventh message, and only READY keys seal.
    pub fn slot(&mut self, now: Duration, delivery: Delivery) -> Result<Slot<'_>, NoKey> {
        self.settle(now);
        self.plan(now);
        if let Err(no_key) = self.allowed(delivery) {
            self.counts.no_key += 1;
            return Err(no_key);
        }
        self.begun.get_or_insert(now);
        let first = self.ready.front_mut().ok_or(NoKey::None)?;
        first.slot(now, delivery).map_err(|_| NoKey::None)
    }

    /// Returns the bytes that an envelope has in addition to its plaintext. It is an upper bound for the next
    /// [`slot`](Self::slot), because KMEs choose the names of keys.
    pub fn overhead(&self) -> usize {
        self.ready.iter().map(Sealer::overhead).max().unwrap_or(MAX_HEADER_LEN + TAG_LEN)
    }

    /// Returns the number of messages that could be sealed now, with the reserved keys as last planned.
    pub fn available(&self, delivery: Delivery) -> u32 {
        if self.allowed(delivery).is_err() {
            return 0;
        }
        let all: u32 = self.ready.iter().map(|s| u32::from(s.remaining())).sum();
        let kept = match delivery {
            Delivery::Reliable => 0,
            Delivery::BestEffort => self.reserve() as u32 * u32::from(MESSAGES_PER_KEY),
        };
        all.saturating_sub(kept)
    }

    /// Handles READY or FAILED from the peer. A proof that does not match retires its key and nothing else: the peer's
    /// KME may have given it another key, which [`disagreement`](Self::disagreement) reports.
    ///
    /// # Errors
    /// The peer violated the protocol, or the system returns no random bytes.
    pub fn handle_message(
        &mut self,
        now: Duration,
        conn: u64,
        message: &KeyMessage,
    ) -> Result<(), SupplyError> {
        // A late message on an earlier connection concerns keys that were announced again.
        let Some(link) = self.link.as_ref().filter(|link| link.conn == conn) else {
            return Ok(());
        };
        match message {
            KeyMessage::Ready { key_id, proof } => {
                let Some(waiting) = self.announced.get(key_id) else { return Ok(()) };
                if !proof::verify(&waiting.key, key_id, &link.ready, proof) {
                    self.give_up(now, key_id);
                    self.counts.disagreed += 1;
                    self.disagreements.add(key_id.clone());
                    self.failed(format!("peer holds another key under key_ID {key_id}"));
                    return Ok(());
                }
                let Some(Announced { key, asked, .. }) = self.announced.remove(key_id) else {
                    return Ok(());
                };
                self.pool.key_ready();
                if let Some(asked) = asked {
                    self.demand.ready(now.saturating_sub(asked));
                }
                self.ready.push_back(Sealer::new(&link.channel, key_id.clone(), key)?);
                Ok(())
            }
            KeyMessage::Failed { key_id, reason } => {
                if let Some(refused) = self.announced.remove(key_id) {
                    self.pool.key_refused(now, refused.since);
                    self.failed(format!("peer could not fetch key_ID {key_id}: {reason}"));
                }
                Ok(())
            }
            other => Err(KeyViolation::Unexpected(other.name()).into()),
        }
    }

    /// Returns the next message to send, and its connection.
    pub fn poll_message(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        self.settle(now);
        self.drop_unanswered(now);
        let message = self.outbox.pop_front().or_else(|| self.announce(now));
        self.plan(now);
        message
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        self.settle(now);
        self.plan(now);
        self.link.as_ref()?;
        self.pool.poll(now, &self.peer)
    }

    /// Handles the KME's answer to one of this host's requests.
    pub fn handle_answer(&mut self, now: Duration, answer: Answer) {
        if let Some(failure) = self.pool.handle_answer(now, answer) {
            self.counts.last_failure = Some(failure);
        }
    }

    /// Returns when to poll again without other cause.
    pub fn poll_timeout(&self) -> Option<Duration> {
        let used = self.begun.map(|at| at + KEY_MAX_AGE);
        let unanswered = self.announced.values().map(|a| a.since + ANSWER_WITHIN).min();
        let calls = self.link.as_ref().and_then(|_| self.pool.poll_timeout());
        [used, unanswered, calls].into_iter().flatten().min()
    }

    /// Returns whether nothing can be sealed because this host's KME gives no keys. While the peer owes an answer for a
    /// key, the peer is the cause instead.
    pub fn lacks_keys_of_kme(&self) -> bool {
        self.ready.is_empty() && self.announced.is_empty() && self.pool.fails()
    }

    /// Returns the statistics.
    pub fn statistics(&self, now: Duration) -> SenderStatistics {
        let pool = self.pool.status(now);
        SenderStatistics {
            ready: self.ready.len(),
            announced: self.announced.len(),
            asked: pool.asked,
            target: pool.target,
            demand: self.demand.demand(now),
            supply: pool.supply,
            lead_ms: self.demand.lead_time().as_secs_f64() * 1e3,
            sealed: self.counts.sealed,
            retired: self.counts.retired,
            failed: self.counts.failed + pool.unusable,
            disagreed: self.counts.disagreed,
            no_key: self.counts.no_key,
            last_failure: self.counts.last_failure.clone(),
        }
    }

    /// Returns a warning if the demand comes close to the supply; at most every ten seconds.
    pub fn warning(&mut self, now: Duration) -> Option<SupplyWarning> {
        let supply = self.pool.status(now).supply?;
        self.demand.warning(now, supply)
    }

    /// Returns a report of keys that the peer holds with other bytes; at most every ten seconds.
    pub fn disagreement(&mut self, now: Duration) -> Option<Disagreement> {
        self.disagreements.take(now)
    }

    /// Reports to the pool the number of keys to hold ahead, and the number of them that left it.
    fn plan(&mut self, now: Duration) {
        let elsewhere = self.announced.len() + self.unbegun();
        self.pool.plan(self.demand.ahead(now), elsewhere);
    }

    /// Returns the number of READY keys that are reserved for RELIABLE and services, as last planned.
    fn reserve(&self) -> usize {
        demand::reserve(self.pool.target())
    }

    fn allowed(&self, delivery: Delivery) -> Result<(), NoKey> {
        if self.link.is_none() {
            return Err(NoKey::Detached);
        }
        match (self.ready.len(), delivery) {
            (0, _) => Err(NoKey::None),
            (n, Delivery::BestEffort) if n <= self.reserve() => Err(NoKey::Reserved),
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
            self.give_up(now, &key_id);
            self.failed(format!("peer did not answer ANNOUNCE of key_ID {key_id}"));
        }
    }

    /// Erases an announced key that will seal no message, and asks the peer to erase its own.
    fn give_up(&mut self, now: Duration, key_id: &KeyId) {
        if let Some(refused) = self.announced.remove(key_id) {
            self.pool.key_refused(now, refused.since);
        }
        let (used, reliable) = Default::default();
        self.tell(KeyMessage::Retire { key_id: key_id.clone(), used, reliable });
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
        let mut key_ids = Vec::new();
        while key_ids.len() < MAX_ANNOUNCED.min(room)
            && let Some(UnusedKey { key_id, key, asked, announced }) = self.pool.take(now)
        {
            let since = announced.unwrap_or(now);
            if now.saturating_sub(since) >= ANSWER_WITHIN {
                self.pool.key_refused(now, since);
                self.failed(format!("peer did not answer ANNOUNCE of key_ID {key_id}"));
                continue;
            }
            key_ids.push(key_id.clone());
            self.announced.insert(key_id, Announced { key, asked, since });
        }
        (!key_ids.is_empty()).then_some((conn, KeyMessage::Announce(key_ids)))
    }

    /// Removes all keys from the connection: the key in use is retired, and the others become fresh again.
    fn unbind(&mut self, now: Duration) {
        self.settle(now);
        while let Some(sealer) = self.ready.pop_front() {
            match sealer.into_unused() {
                Ok((key_id, key)) => self.pool.put_back(key_id, key, None),
                Err(begun) => {
                    self.ready.push_front(begun);
                    self.retire_first();
                }
            }
        }
        self.begun = None;
        for (key_id, Announced { key, since, .. }) in self.announced.drain() {
            self.pool.put_back(key_id, key, Some(since));
        }
    }

    /// Returns the number of READY keys that sealed no message.
    fn unbegun(&self) -> usize {
        self.ready.len() - usize::from(self.begun.is_some() && !self.ready.is_empty())
    }

    fn unretired(&self, now: Duration) -> usize {
        let pool = self.pool.status(now);
        pool.held + pool.asked + self.announced.len() + self.ready.len()
    }

    fn failed(&mut self, why: String) {
        self.counts.failed += 1;
        self.counts.last_failure = Some(why);
    }
}
