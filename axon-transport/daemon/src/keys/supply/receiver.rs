//! The receiving direction: fetches announced keys, and opens messages.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
    time::Duration,
};

use axon_envelope::{Channel, ChannelError, Expired, KeyId, KmeKey, Opener};
use serde::Serialize;

use super::{MAX_UNRETIRED, SupplyError};
use crate::keys::{
    Exporters, KeyMessage, KeyViolation,
    exporters::Exporter,
    fetch::Fetches,
    proof,
    request::{Answer, KeyPurpose, KmeRequest},
};

/// The time for which unused keys of a lost connection wait to be announced on the next one.
const KEY_RETENTION: Duration = Duration::from_secs(120);
/// Maximum number of these waiting keys.
const MAX_RETAINED_KEYS: usize = 512;

/// The keys of one peer's messages to this host.
pub struct KeyReceiver {
    local: String,
    peer: String,
    links: HashMap<u64, ReceiverLink>,
    /// The number of connections that were elected so far.
    elected: u64,
    /// Keys that are being fetched, each with the connection that last announced it. The answer goes there. `None`: the key
    /// was retired meanwhile, and counts until its fetch ends.
    wanted: HashMap<KeyId, Option<u64>>,
    fetches: Fetches,
    /// Unused keys of closed connections.
    kept: VecDeque<(Duration, KeyId, KmeKey)>,
    outbox: VecDeque<(u64, KeyMessage)>,
    counts: ReceiverCounts,
}

struct ReceiverLink {
    /// The link's place in the order in which connections were elected, which is the same on both hosts; 0 if it was
    /// not elected.
    order: u64,
    opener: Opener,
    ready: Exporter,
}

#[derive(Default)]
struct ReceiverCounts {
    ready: u64,
    failed: u64,
    retired: u64,
    expired: u64,
    missing: u64,
}

impl ReceiverCounts {
    fn add(&mut self, expired: Expired) {
        self.expired += expired.keys as u64;
        self.missing += expired.messages_missing as u64;
    }
}

/// The statistics of a [`KeyReceiver`], for status.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct ReceiverStatistics {
    /// Keys that are held and not retired, on all connections.
    pub held: usize,
    /// Keys being fetched.
    pub fetching: usize,
    /// Keys answered with READY.
    pub ready: u64,
    /// Keys answered with FAILED.
    pub failed: u64,
    /// Keys that the peer retired.
    pub retired: u64,
    /// Keys that expired.
    pub expired: u64,
    /// Messages that the peer reports as sealed and that never arrived, under retired keys.
    pub messages_missing: u64,
}

impl KeyReceiver {
    /// Creates the receiver of the messages that `peer_sae` sends to `local_sae`.
    ///
    /// # Errors
    /// The SAE IDs do not make a channel: one is empty or too long, or both are equal.
    pub fn new(local_sae: &str, peer_sae: &str) -> Result<Self, ChannelError> {
        Channel::new(peer_sae, local_sae, [])?;
        Ok(Self {
            local: local_sae.to_owned(),
            peer: peer_sae.to_owned(),
            links: HashMap::new(),
            elected: 0,
            wanted: HashMap::new(),
            fetches: Fetches::new(peer_sae, KeyPurpose::Messages),
            kept: VecDeque::new(),
            outbox: VecDeque::new(),
            counts: ReceiverCounts::default(),
        })
    }

    /// Attaches a connection. A connection that it succeeds may stay attached until it is closed.
    ///
    /// # Errors
    /// The system returns no random bytes.
    pub fn attach(
        &mut self,
        now: Duration,
        conn: u64,
        exporters: &Exporters,
    ) -> Result<(), SupplyError> {
        self.detach(now, conn);
        let channel = Channel::new(&self.peer, &self.local, exporters.envelope())?;
        let opener = Opener::new(channel)?;
        let ready = Arc::clone(exporters.ready());
        self.links.insert(conn, ReceiverLink { order: 0, opener, ready });
        Ok(())
    }

    /// Records that both hosts use this connection from now on: the peer announces its keys there, and on no other one.
    pub fn elect(&mut self, conn: u64) {
        if let Some(link) = self.links.get_mut(&conn) {
            self.elected += 1;
            link.order = self.elected;
        }
    }

    /// Detaches a closed connection: no message opens on it any more. Keys that opened no message wait a while to be
    /// announced on the next connection.
    pub fn detach(&mut self, now: Duration, conn: u64) {
        let Some(mut link) = self.links.remove(&conn) else { return };
        self.outbox.retain(|(c, _)| *c != conn);
        self.counts.add(link.opener.expire(now));
        let unused: Vec<KeyId> = link.opener.unused_keys().cloned().collect();
        for key_id in unused {
            if let Some((key_id, key)) = link.opener.take_unused(key_id.as_bytes()) {
                self.keep(now, key_id, key);
            }
        }
    }

    /// Returns the opener of the messages on this connection.
    pub fn opener(&mut self, conn: u64) -> Option<&mut Opener> {
        self.links.get_mut(&conn).map(|link| &mut link.opener)
    }

    /// Handles ANNOUNCE or RETIRE from the peer.
    ///
    /// # Errors
    /// The peer violated the protocol, or the connection is not attached.
    pub fn handle_message(
        &mut self,
        now: Duration,
        conn: u64,
        message: &KeyMessage,
    ) -> Result<(), SupplyError> {
        let link = self.links.get_mut(&conn).ok_or(SupplyError::Unattached(conn))?;
        match message {
            KeyMessage::Announce(key_ids) => {
                let new: Vec<KeyId> =
                    key_ids.iter().filter(|&id| self.announced(conn, id)).cloned().collect();
                if !new.is_empty() {
                    self.fetches.start(now, new);
                }
                Ok(())
            }
            KeyMessage::Retire { key_id, used, reliable } => {
                link.opener
                    .retire(now, key_id.as_bytes(), *used, *reliable)
                    .map_err(|e| KeyViolation::Masks(key_id.clone(), e.to_string()))?;
                self.counts.retired += 1;
                if let Some(wanted) = self.wanted.get_mut(key_id) {
                    *wanted = None;
                }
                self.kept.retain(|(_, id, _)| id != key_id);
                Ok(())
            }
            other => Err(KeyViolation::Unexpected(other.name()).into()),
        }
    }

    /// Returns the next message to send, and its connection.
    pub fn poll_message(&mut self) -> Option<(u64, KeyMessage)> {
        self.outbox.pop_front()
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        self.fetches.poll_request(now)
    }

    /// Handles the KME's answer to one of this host's requests.
    pub fn handle_answer(&mut self, now: Duration, answer: Answer) {
        for (key_id, outcome) in self.fetches.handle_answer(now, answer) {
            // The key was retired meanwhile: no connection waits for it.
            let Some(conn) = self.wanted.remove(&key_id).flatten() else { continue };
            match outcome {
                Ok(key) if self.links.contains_key(&conn) => self.add(conn, key_id, key),
                Ok(key) => self.keep(now, key_id, key),
                Err(failure) => self.fail(conn, key_id, failure.kind.told().to_owned()),
            }
        }
    }

    /// Returns when to poll again without other cause.
    pub fn poll_timeout(&self) -> Option<Duration> {
        self.fetches.poll_timeout()
    }

    /// Erases expired keys; to be called about once a second.
    pub fn handle_timeout(&mut self, now: Duration) {
        for link in self.links.values_mut() {
            self.counts.add(link.opener.expire(now));
        }
        self.kept.retain(|(since, ..)| now.saturating_sub(*since) < KEY_RETENTION);
    }

    /// Returns the statistics.
    pub fn statistics(&self) -> ReceiverStatistics {
        ReceiverStatistics {
            held: self.links.values().map(|l| l.opener.key_count()).sum(),
            fetching: self.wanted.len(),
            ready: self.counts.ready,
            failed: self.counts.failed,
            retired: self.counts.retired,
            expired: self.counts.expired,
            messages_missing: self.counts.missing,
        }
    }

    /// Handles one announced key_ID. Returns true if the key has to be fetched.
    fn announced(&mut self, conn: u64, key_id: &KeyId) -> bool {
        if let Some(link) = self.links.get_mut(&conn)
            && link.opener.contains(key_id.as_bytes())
        {
            // The sender moved the key to another connection, whose announcement did not arrive, and back.
            match link.opener.take_unused(key_id.as_bytes()) {
                Some((key_id, key)) => self.add(conn, key_id, key),
                None => self.fail(conn, key_id.clone(), "announced after its use".to_owned()),
            }
            return false;
        }
        let order = |conn: &u64| self.links.get(conn).map_or(0, |link| link.order);
        let (this, waiting) =
            (order(&conn), self.wanted.get(key_id).and_then(|conn| conn.as_ref().map(order)));
        let holds = |link: &&ReceiverLink| link.opener.contains(key_id.as_bytes());
        let held = self.links.values().find(holds).map(|link| link.order);
        // The sender announced the key on a later connection meanwhile, and seals for that one.
        if held.max(waiting).is_some_and(|order| order > this) {
            return false;
        }
        if let Some(key) = self.take_unused(key_id) {
            self.add(conn, key_id.clone(), key);
            return false;
        }
        if let Some(waiting) = self.wanted.get_mut(key_id) {
            *waiting = Some(conn);
            return false;
        }
        let held: usize = self.links.values().map(|link| link.opener.key_count()).sum();
        if held + self.wanted.len() >= MAX_UNRETIRED {
            self.fail(conn, key_id.clone(), format!("{MAX_UNRETIRED} keys are not retired"));
            return false;
        }
        self.wanted.insert(key_id.clone(), Some(conn));
        true
    }

    /// Takes a key that was announced before and never used, from another connection or a closed one.
    fn take_unused(&mut self, key_id: &KeyId) -> Option<KmeKey> {
        if let Some(i) = self.kept.iter().position(|(_, id, _)| id == key_id) {
            return self.kept.remove(i).map(|(_, _, key)| key);
        }
        let mut openers = self.links.values_mut().map(|l| &mut l.opener);
        openers.find_map(|o| o.take_unused(key_id.as_bytes())).map(|(_, key)| key)
    }

    fn add(&mut self, conn: u64, key_id: KeyId, key: KmeKey) {
        let Some(link) = self.links.get_mut(&conn) else { return };
        let proof = proof::compute(&key, &key_id, &link.ready);
        match link.opener.add_key(key_id.clone(), key) {
            Ok(()) => {
                self.counts.ready += 1;
                self.outbox.push_back((conn, KeyMessage::Ready { key_id, proof }));
            }
            Err(e) => self.fail(conn, key_id, e.to_string()),
        }
    }

    fn fail(&mut self, conn: u64, key_id: KeyId, reason: String) {
        self.counts.failed += 1;
        self.outbox.push_back((conn, KeyMessage::Failed { key_id, reason }));
    }

    fn keep(&mut self, now: Duration, key_id: KeyId, key: KmeKey) {
        if self.kept.len() >= MAX_RETAINED_KEYS {
            self.kept.pop_front();
        }
        self.kept.push_back((now, key_id, key));
    }
}
