//! The sending direction: fetches keys ahead, announces them, and seals messages under keys that are READY.
//!
//! The messages leave over one connection. Copies of small messages may also leave over a connection that stands by, each
//! under a key of that connection. Both draw from one stock of keys, and the messages come first.

use std::{collections::VecDeque, time::Duration};

use axon_envelope::{
    Channel, ChannelError, Delivery, KeyId, KmeKey, MAX_HEADER_LEN, MESSAGES_PER_KEY, Retirement,
    Slot, TAG_LEN,
};

use super::{
    Disagreement, MAX_UNRETIRED, SupplyError, SupplyWarning,
    connection_keys::{AnnouncedKey, ConnectionKeys, ReleasedKeys},
    disagreement::Disagreements,
    key_plan::KeyPlan,
    pool::{KeyStock, UnusedKey},
    sender_connections::SenderConnections,
    sender_statistics::{SenderCounts, SenderStatistics},
};
use crate::{
    keys::{
        Exporters, KeyMessage, KeyViolation,
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
    connections: SenderConnections,
    /// Keys that are drawn or being drawn, and have to be announced.
    pool: KeyStock,
    outbox: VecDeque<(u64, KeyMessage)>,
    plan: KeyPlan,
    disagreements: Disagreements,
    counts: SenderCounts,
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
            connections: SenderConnections::default(),
            pool: KeyStock::new(jitter),
            outbox: VecDeque::new(),
            plan: KeyPlan::new(),
            disagreements: Disagreements::default(),
            counts: SenderCounts::default(),
        };
        sender.plan(Duration::ZERO);
        Ok(sender)
    }

    /// Moves to a new connection. Keys that sealed no message are announced again there; a key in use is retired. If the
    /// connection stood by, it keeps the keys that it has.
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
        let next = match self.connections.standby.take_if(|standby| standby.connection() == conn) {
            Some(standby) => standby,
            None => ConnectionKeys::new(conn, (&self.local, &self.peer), exporters)?,
        };
        self.settle(now);
        let before = self.connections.in_use.replace(next);
        let Some(mut before) = before else { return Ok(Vec::new()) };
        let number = before.connection();
        self.put_back(number, before.release());
        let (owed, others) = self.outbox.drain(..).partition(|(of, _)| *of == number);
        self.outbox = others;
        Ok(Vec::from(owed))
    }

    /// Lets copies of messages leave over another connection, which stands by. Its keys are fetched once copies need them.
    ///
    /// # Errors
    /// The SAE IDs do not make a channel.
    pub fn attach_standby(
        &mut self,
        now: Duration,
        conn: u64,
        exporters: &Exporters,
    ) -> Result<(), SupplyError> {
        if self.attached() == Some(conn) {
            return Ok(());
        }
        let next = ConnectionKeys::new(conn, (&self.local, &self.peer), exporters)?;
        if let Some(before) = self.connections.standby.as_ref().map(ConnectionKeys::connection) {
            self.detach(now, before);
        }
        self.connections.standby = Some(next);
        Ok(())
    }

    /// Ends the use of a connection that stood by, which was superseded and is not closed yet.
    pub fn release_standby(&mut self, now: Duration, conn: u64) {
        self.settle(now);
        if let Some(mut standby) =
            self.connections.standby.take_if(|standby| standby.connection() == conn)
        {
            self.put_back(conn, standby.release());
        }
    }

    /// Detaches a closed connection. Keys that sealed no message wait for the next connection.
    pub fn detach(&mut self, now: Duration, conn: u64) {
        self.settle(now);
        if let Some(mut closed) = self.connections.take(conn) {
            self.put_back(conn, closed.release());
        }
        self.outbox.retain(|(of, _)| *of != conn);
    }

    /// Returns the connection that [`slot`](Self::slot) seals for. The sealed messages open on no other connection.
    pub fn attached(&self) -> Option<u64> {
        self.connections.in_use.as_ref().map(ConnectionKeys::connection)
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
            self.counts.failed(why);
            return Ok(());
        }
        match &mut self.connections.in_use {
            Some(keys) if keys.connection() == conn => keys.add_ready(key_id, key)?,
            _ => self.pool.put(now, key_id, key),
        }
        Ok(())
    }

    /// Counts `messages` more that are to be sent to this peer. Each message counts once, however often it is tried.
    pub fn demand(&mut self, now: Duration, messages: u32) {
        self.plan.messages(now, messages);
    }

    /// Counts `messages` more whose copies are to be sent over the connection that stands by.
    pub fn demand_copies(&mut self, now: Duration, messages: u32) {
        self.plan.copies(now, messages);
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
        self.connections.in_use.as_mut().ok_or(NoKey::Detached)?.slot(now, delivery)
    }

    /// Returns a permit to seal one copy of a message, at once and on connection `conn`, which stands by. The peer waits for
    /// no copy, so its delivery is that of BEST_EFFORT.
    ///
    /// # Errors
    /// [`NoKey`].
    pub fn copy_slot(&mut self, now: Duration, conn: u64) -> Result<Slot<'_>, NoKey> {
        self.settle(now);
        self.plan(now);
        let standby =
            self.connections.standby.as_mut().filter(|standby| standby.connection() == conn);
        standby.ok_or(NoKey::Detached)?.slot(now, Delivery::BestEffort)
    }

    /// Returns the bytes that an envelope has in addition to its plaintext. It is an upper bound for the next
    /// [`slot`](Self::slot), because KMEs choose the names of keys.
    pub fn overhead(&self) -> usize {
        self.connections.in_use.as_ref().map_or(MAX_HEADER_LEN + TAG_LEN, ConnectionKeys::overhead)
    }

    /// Returns the number of messages that could be sealed now, with the reserved keys as last planned.
    pub fn available(&self, delivery: Delivery) -> u32 {
        let Some(keys) =
            self.connections.in_use.as_ref().filter(|_| self.allowed(delivery).is_ok())
        else {
            return 0;
        };
        let kept = match delivery {
            Delivery::Reliable => 0,
            Delivery::BestEffort => self.plan.reserve() as u32 * u32::from(MESSAGES_PER_KEY),
        };
        keys.remaining().saturating_sub(kept)
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
        let Some(keys) = self.connections.get_mut(conn) else { return Ok(()) };
        match message {
            KeyMessage::Ready { key_id, proof } => {
                let Some(proven) = keys.proves(key_id, proof) else { return Ok(()) };
                if !proven {
                    self.give_up(now, conn, key_id);
                    self.counts.disagreed += 1;
                    self.disagreements.add(key_id.clone());
                    self.counts.failed(format!("peer holds another key under key_ID {key_id}"));
                    return Ok(());
                }
                let Some(AnnouncedKey { key, asked, .. }) = keys.take_announced(key_id) else {
                    return Ok(());
                };
                keys.add_ready(key_id.clone(), key)?;
                self.pool.key_ready();
                if let Some(asked) = asked {
                    self.plan.ready(now.saturating_sub(asked));
                }
                Ok(())
            }
            KeyMessage::Failed { key_id, reason } => {
                if let Some(refused) = keys.take_announced(key_id) {
                    self.pool.key_refused(now, refused.since);
                    self.counts.failed(format!("peer could not fetch key_ID {key_id}: {reason}"));
                }
                Ok(())
            }
            other => Err(KeyViolation::Unexpected(other.name()).into()),
        }
    }

    /// Returns the next message to send, and its connection.
    pub fn poll_message(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        self.settle(now);
        self.reclaim_from_copies(now);
        self.drop_unanswered(now);
        let message = self.outbox.pop_front().or_else(|| self.announce(now));
        self.plan(now);
        message
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        self.settle(now);
        self.plan(now);
        self.connections.in_use.as_ref()?;
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
        let of_connection = |keys: &ConnectionKeys| {
            let unanswered = keys.unanswered_since().map(|since| since + ANSWER_WITHIN);
            [keys.spent_at(), unanswered].into_iter().flatten().min()
        };
        let keys = self.connections.iter().filter_map(of_connection).min();
        let calls = self.connections.in_use.as_ref().and_then(|_| self.pool.poll_timeout());
        [keys, calls, self.plan.poll_timeout(&self.connections)].into_iter().flatten().min()
    }

    /// Returns whether nothing can be sealed because this host's KME gives no keys. While the peer owes an answer for a
    /// key, the peer is the cause instead.
    pub fn lacks_keys_of_kme(&self) -> bool {
        let has_none = |keys: &ConnectionKeys| keys.ready() == 0 && keys.announced() == 0;
        self.connections.in_use.as_ref().is_none_or(has_none) && self.pool.fails()
    }

    /// Returns the statistics.
    pub fn statistics(&self, now: Duration) -> SenderStatistics {
        let pool = self.pool.status(now);
        SenderStatistics {
            ready: self.connections.iter().map(ConnectionKeys::ready).sum(),
            announced: self.connections.iter().map(ConnectionKeys::announced).sum(),
            asked: pool.asked,
            target: pool.target,
            demand: self.plan.needed(now),
            supply: pool.supply,
            lead_ms: self.plan.lead_time().as_secs_f64() * 1e3,
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
        self.plan.warning(now, supply)
    }

    /// Returns a report of keys that the peer holds with other bytes; at most every ten seconds.
    pub fn disagreement(&mut self, now: Duration) -> Option<Disagreement> {
        self.disagreements.take(now)
    }

    /// Takes back the unused keys of the connection that stands by if no copies need them, or if the messages have none: they
    /// are announced again on the connection in use.
    fn reclaim_from_copies(&mut self, now: Duration) {
        let is_needed = self.plan.copies_ahead(now, &self.connections) > 0;
        let has_keys = |keys: &ConnectionKeys| keys.ready() + keys.announced() > 0;
        if is_needed && self.connections.in_use.as_ref().is_none_or(has_keys) {
            return;
        }
        let Some(standby) = self.connections.standby.as_mut().filter(|standby| standby.ahead() > 0)
        else {
            return;
        };
        let (conn, unused) = (standby.connection(), standby.release_unused());
        self.put_back(conn, unused);
    }

    /// Reports to the pool the number of keys to hold ahead, and the number of them that left it.
    fn plan(&mut self, now: Duration) {
        self.plan.update(now, &self.connections, &mut self.pool);
    }

    fn allowed(&self, delivery: Delivery) -> Result<(), NoKey> {
        let Some(keys) = &self.connections.in_use else { return Err(NoKey::Detached) };
        match (keys.ready(), delivery) {
            (0, _) => Err(NoKey::None),
            (n, Delivery::BestEffort) if n <= self.plan.reserve() => Err(NoKey::Reserved),
            _ => Ok(()),
        }
    }

    /// Retires the keys in use that are finished.
    fn settle(&mut self, now: Duration) {
        while let Some((conn, retired)) = self.connections.poll_spent(now) {
            self.retire(conn, retired);
        }
    }

    fn drop_unanswered(&mut self, now: Duration) {
        for (conn, key_id) in self.connections.unanswered(now.checked_sub(ANSWER_WITHIN)) {
            self.give_up(now, conn, &key_id);
            self.counts.failed(format!("peer did not answer ANNOUNCE of key_ID {key_id}"));
        }
    }

    /// Erases an announced key that will seal no message, and asks the peer to erase its own.
    fn give_up(&mut self, now: Duration, conn: u64, key_id: &KeyId) {
        let keys = self.connections.get_mut(conn);
        if let Some(refused) = keys.and_then(|keys| keys.take_announced(key_id)) {
            self.pool.key_refused(now, refused.since);
        }
        let (used, reliable) = Default::default();
        let retire = KeyMessage::Retire { key_id: key_id.clone(), used, reliable };
        self.outbox.push_back((conn, retire));
    }

    fn retire(&mut self, conn: u64, retirement: Retirement) {
        self.counts.retired(&retirement);
        let (key_id, used) = (retirement.key_id, retirement.used);
        let retire = KeyMessage::Retire { key_id, used, reliable: retirement.reliable };
        self.outbox.push_back((conn, retire));
    }

    /// Announces keys of the pool.
    fn announce(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        let room = MAX_UNRETIRED.saturating_sub(self.connections.held()).min(MAX_ANNOUNCED);
        let (mut key_ids, mut of_copies) = (Vec::new(), Vec::new());
        while key_ids.len() + of_copies.len() < room
            && let Some(in_use) = &mut self.connections.in_use
            && let Some(UnusedKey { key_id, key, asked, announced }) = self.pool.take(now)
        {
            let since = announced.unwrap_or(now);
            if now.saturating_sub(since) >= ANSWER_WITHIN {
                self.pool.key_refused(now, since);
                self.counts.failed(format!("peer did not answer ANNOUNCE of key_ID {key_id}"));
                continue;
            }
            // The peer may hold an earlier key for a connection that was in use, from which it moves none to one that stands
            // by. Keys from the KME have the time of their request.
            let is_new = asked.is_some();
            let share = self.plan.share();
            let standby = self.connections.standby.as_mut().filter(|standby| {
                is_new && in_use.ahead() >= share.messages && standby.ahead() < share.copies
            });
            let announced = AnnouncedKey { key, asked, since };
            match standby {
                Some(standby) => {
                    of_copies.push(key_id.clone());
                    standby.announce(key_id, announced);
                }
                None => {
                    key_ids.push(key_id.clone());
                    in_use.announce(key_id, announced);
                }
            }
        }
        let announce = |keys: &Option<ConnectionKeys>, key_ids: Vec<KeyId>| {
            let conn = keys.as_ref().filter(|_| !key_ids.is_empty())?.connection();
            Some((conn, KeyMessage::Announce(key_ids)))
        };
        self.outbox.extend(announce(&self.connections.in_use, key_ids));
        self.outbox.extend(announce(&self.connections.standby, of_copies));
        self.outbox.pop_front()
    }

    /// Takes back the keys of a connection that is not used any more: the key in use is retired, and the others become
    /// fresh again.
    fn put_back(&mut self, conn: u64, released: ReleasedKeys) {
        if let Some(retired) = released.retired {
            self.retire(conn, retired);
        }
        for (key_id, key) in released.unused {
            self.pool.put_back(key_id, key, None);
        }
        for (key_id, AnnouncedKey { key, since, .. }) in released.announced {
            self.pool.put_back(key_id, key, Some(since));
        }
    }

    fn unretired(&self, now: Duration) -> usize {
        let pool = self.pool.status(now);
        pool.held + pool.asked + self.connections.held()
    }
}
