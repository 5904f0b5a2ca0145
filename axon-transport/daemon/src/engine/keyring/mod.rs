//! All KME keys of the daemon in `qkd`: connects the machines of [`crate::keys`] with the KME and with the
//! control streams.
//!
//! The owner drains [`poll_request`](Keyring::poll_request), [`poll_message`](Keyring::poll_message),
//! [`poll_record`](Keyring::poll_record) and [`poll_changed`](Keyring::poll_changed) after each call that
//! changes the keyring.

use std::{
    collections::{HashMap, VecDeque},
    fmt, mem,
    net::IpAddr,
    sync::Arc,
    time::Duration,
};

use axon_envelope::{KeyId, KmeKey};
use axon_transport::config::{Config, KeyMode, QkdConfig, Security};

use super::quic::tls_settings::tls_cipher;
use crate::keys::{
    Acceptor, Answer, BootstrapDialler, Clock, Completion, DialDecision, Exporters, KeyMessage,
    KeyReceiver, KeySender, KmeAnswer, KmeRequest, RequestOrigin, Resolver, Statistics,
    SupplyError, UsedStatistics,
};

#[cfg(test)]
pub(crate) mod tests;

/// Time between two removals of expired keys.
const EXPIRE_EVERY: Duration = Duration::from_secs(1);
/// Shortest time to the next poll of a peer's machines. One of their deadlines may have passed while they
/// wait for an answer of the KME.
const SHORTEST_WAIT: Duration = Duration::from_millis(5);

/// The keys of the daemon in `qkd`.
pub(crate) struct Keyring {
    /// The settings of `qkd`.
    pub(crate) config: QkdConfig,
    /// Look-up of PSKs for incoming handshakes. TLS calls it in the middle of a handshake.
    pub(crate) acceptor: Acceptor,
    /// The time of the acceptor: the engine's, as of the last call.
    clock: Clock,
    dialler: BootstrapDialler,
    /// Whether the peer is in [`Keyring::touched`].
    dialler_touched: bool,
    /// The peers by number. A peer is never removed, because its keys outlive connections.
    peers: Vec<PeerKeys>,
    /// Numbers by SAE ID.
    numbers: HashMap<String, usize>,
    /// The numbers of peers by attached connection.
    connections: HashMap<u64, usize>,
    /// Peers whose machines may have requests or messages.
    touched: Vec<usize>,
    requests: VecDeque<(RequestOrigin, KmeRequest)>,
    messages: VecDeque<(u64, KeyMessage)>,
    records: VecDeque<(u64, String)>,
    changed: VecDeque<u64>,
    /// When keys are next expired.
    expires: Duration,
}

/// The message keys of both directions with one peer SAE.
struct PeerKeys {
    sae: String,
    sender: KeySender,
    receiver: KeyReceiver,
    /// Whether it is in [`Keyring::touched`].
    touched: bool,
    /// When to poll the peer's machines without another cause.
    due: Option<Duration>,
}

/// The destination of a KME answer.
#[derive(Debug)]
#[must_use]
pub(crate) enum Answered {
    /// The keyring took the answer.
    Here,
    /// The dialler took the answer: each dial that waits for a key can go on.
    Dialler,
    /// The answer is for the opening of this connection.
    Opening(u64, Answer),
}

impl fmt::Debug for Keyring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Keyring").field("sae", &self.config.sae_id).finish_non_exhaustive()
    }
}

impl Keyring {
    /// Returns the keyring of a daemon in `qkd`, `None` in `classic`.
    pub(crate) fn new(config: &Config) -> Option<Self> {
        let Security::Qkd(qkd) = &config.security else { return None };
        let (clock, cipher) = (Clock::default(), tls_cipher(config.cipher));
        let allowed = qkd.peers.clone();
        Some(Self {
            acceptor: Acceptor::new(&qkd.sae_id, allowed.clone(), cipher, clock.clone()),
            dialler: BootstrapDialler::new(&qkd.sae_id, allowed, cipher, qkd.kme_answer_timeout),
            clock,
            dialler_touched: false,
            peers: Vec::new(),
            numbers: HashMap::new(),
            connections: HashMap::new(),
            touched: Vec::new(),
            requests: VecDeque::new(),
            messages: VecDeque::new(),
            records: VecDeque::new(),
            changed: VecDeque::new(),
            expires: EXPIRE_EVERY,
            config: qkd.clone(),
        })
    }

    /// Returns whether data is sealed per message.
    pub(crate) fn seals_messages(&self) -> bool {
        self.config.key_mode == KeyMode::Messages10
    }

    /// Moves the acceptor's time to `now`. The owner calls it before it gives a datagram to QUIC, because
    /// TLS then asks the acceptor; every other method that takes `now` does the same.
    pub(crate) fn set_time(&self, now: Duration) {
        self.clock.advance(now.saturating_sub(self.clock.now()));
    }

    /// Returns the resolver for one incoming connection from a validated `source`.
    pub(crate) fn resolver(&self, now: Duration, source: IpAddr) -> Arc<Resolver> {
        self.set_time(now);
        self.acceptor.resolver(source)
    }

    /// Decides whether, and with which key, to dial `sae` now.
    pub(crate) fn dial(&mut self, now: Duration, sae: &str) -> DialDecision {
        self.dialler().dial(now, sae)
    }

    /// Returns the dialler, to report how a dial ended.
    pub(crate) fn dialler(&mut self) -> &mut BootstrapDialler {
        self.dialler_touched = true;
        &mut self.dialler
    }

    /// Records that the TLS handshake of connection `link` under `identity`, with the key `key_id`, is complete: the
    /// key is spent. After [`Completion::First`] the ledger of used keys still has to be asked
    /// ([`poll_record`](Self::poll_record)).
    pub(crate) fn spent(
        &mut self,
        now: Duration,
        link: u64,
        identity: &[u8],
        key_id: &str,
    ) -> Completion {
        self.set_time(now);
        let completion = self.acceptor.spent(identity);
        if completion == Completion::First {
            self.records.push_back((link, key_id.to_owned()));
        }
        completion
    }

    /// Records that the client at `source` proved that it is `sae`: the acceptor knows both from now on.
    pub(crate) fn authenticated(&self, now: Duration, source: IpAddr, sae: &str) {
        self.set_time(now);
        self.acceptor.authenticated(source, sae);
    }

    /// Registers a new connection with the peer `sae`, on which announced keys can arrive.
    ///
    /// # Errors
    /// The SAE IDs make no channel, or the system gives no random bytes.
    pub(crate) fn attach_receiver(
        &mut self,
        now: Duration,
        connection: u64,
        sae: &str,
        exporters: &Exporters,
    ) -> Result<(), SupplyError> {
        let number = self.number(sae)?;
        self.peers[number].receiver.attach(now, connection, exporters)?;
        self.connections.insert(connection, number);
        self.touch(number);
        Ok(())
    }

    /// Handles the election of a connection: keys may be announced on it. `first` is the key that proved the client's
    /// name, under which the server seals its first messages.
    ///
    /// # Errors
    /// The connection has no receiver, the SAE IDs make no channel, or the system gives no random bytes.
    pub(crate) fn attach_sender(
        &mut self,
        now: Duration,
        connection: u64,
        exporters: &Exporters,
        first: Option<(KeyId, KmeKey)>,
    ) -> Result<(), SupplyError> {
        let number = self.attached(connection)?;
        self.touch(number);
        self.peers[number].receiver.elect(connection);
        let sender = &mut self.peers[number].sender;
        // RETIRE messages that are still sent on the previous connection, which a successor has not closed
        // yet. If a third connection took over in the meantime, these messages are lost.
        let owed = sender.attach(now, connection, exporters)?;
        self.messages.extend(owed);
        if let Some((key_id, key)) = first {
            sender.adopt(now, connection, key_id, key)?;
        }
        self.changed.push_back(connection);
        Ok(())
    }

    /// Lets copies of messages leave over a connection that stands by.
    ///
    /// # Errors
    /// The connection has no receiver, or the SAE IDs make no channel.
    pub(crate) fn attach_standby(
        &mut self,
        now: Duration,
        connection: u64,
        exporters: &Exporters,
    ) -> Result<(), SupplyError> {
        let number = self.attached(connection)?;
        self.touch(number);
        self.peers[number].sender.attach_standby(now, connection, exporters)
    }

    /// Ends the use of a connection that stood by and was superseded: no copies leave over it any more.
    pub(crate) fn release_standby(&mut self, now: Duration, connection: u64) {
        if let Ok(number) = self.attached(connection) {
            self.peers[number].sender.release_standby(now, connection);
            self.touch(number);
        }
    }

    /// Forgets a connection that ended, or that failed before it became a link.
    pub(crate) fn forget_connection(&mut self, now: Duration, connection: u64) {
        let Some(number) = self.connections.remove(&connection) else { return };
        let peer = &mut self.peers[number];
        peer.receiver.detach(now, connection);
        peer.sender.detach(now, connection);
        self.touch(number);
    }

    /// Handles a key announcement on `connection`.
    ///
    /// # Errors
    /// The peer broke a rule, or the connection has no receiver.
    pub(crate) fn handle_message(
        &mut self,
        now: Duration,
        connection: u64,
        message: &KeyMessage,
    ) -> Result<(), SupplyError> {
        let number = self.attached(connection)?;
        self.touch(number);
        let peer = &mut self.peers[number];
        match message {
            KeyMessage::Announce(_) | KeyMessage::Retire { .. } => {
                peer.receiver.handle_message(now, connection, message)
            }
            KeyMessage::Ready { .. } | KeyMessage::Failed { .. } => {
                let result = peer.sender.handle_message(now, connection, message);
                peer.warn(now, &self.config);
                self.changed.push_back(connection);
                result
            }
        }
    }

    /// Handles an answer of the KME.
    pub(crate) fn handle_answer(&mut self, now: Duration, event: KmeAnswer) -> Answered {
        self.set_time(now);
        let KmeAnswer { origin, answer } = event;
        match origin {
            RequestOrigin::Dialler => {
                self.dialler().handle_answer(now, answer);
                return Answered::Dialler;
            }
            RequestOrigin::Acceptor => self.acceptor.handle_answer(answer),
            RequestOrigin::Proof(link) | RequestOrigin::Responder(link) => {
                return Answered::Opening(link, answer);
            }
            RequestOrigin::Sender(number) => {
                if let Some(number) = self.known(number) {
                    self.peers[number].sender.handle_answer(now, answer);
                    self.touch(number);
                }
            }
            RequestOrigin::Receiver(number) => {
                if let Some(number) = self.known(number) {
                    self.peers[number].receiver.handle_answer(now, answer);
                    self.touch(number);
                }
            }
        }
        Answered::Here
    }

    /// Returns the sender that seals for `connection`. `None` before [`attach_sender`](Self::attach_sender), and from
    /// the time at which a successor has the keys.
    pub(crate) fn sender(&mut self, connection: u64) -> Option<&mut KeySender> {
        let number = self.attached(connection).ok()?;
        if self.peers[number].sender.attached() != Some(connection) {
            return None;
        }
        self.touch(number);
        Some(&mut self.peers[number].sender)
    }

    /// Returns the receiver that opens messages of `connection`, `None` once the connection has ended.
    pub(crate) fn receiver(&mut self, connection: u64) -> Option<&mut KeyReceiver> {
        let number = self.attached(connection).ok()?;
        self.touch(number);
        Some(&mut self.peers[number].receiver)
    }

    /// Returns the next request to the KME.
    pub(crate) fn poll_request(&mut self, now: Duration) -> Option<(RequestOrigin, KmeRequest)> {
        self.drain(now);
        if let Some(request) = self.acceptor.poll_request() {
            return Some((RequestOrigin::Acceptor, request));
        }
        self.requests.pop_front()
    }

    /// Returns the next key announcement, and the connection on whose control stream it goes.
    pub(crate) fn poll_message(&mut self, now: Duration) -> Option<(u64, KeyMessage)> {
        self.drain(now);
        loop {
            let (connection, message) = self.messages.pop_front()?;
            if self.connections.contains_key(&connection) {
                return Some((connection, message));
            }
        }
    }

    /// Returns the next key_ID to record in the ledger of used keys, which blocks on a file. The opening of the
    /// connection takes the result (`Opening::handle_recorded`).
    pub(crate) fn poll_record(&mut self) -> Option<(u64, String)> {
        self.records.pop_front()
    }

    /// Returns the next connection whose keys changed: its flows may seal again, or its opening may be over.
    pub(crate) fn poll_changed(&mut self, now: Duration) -> Option<u64> {
        self.drain(now);
        let connection = self.changed.pop_front()?;
        self.changed.retain(|other| *other != connection);
        Some(connection)
    }

    /// Returns when to call [`handle_timeout`](Self::handle_timeout).
    pub(crate) fn poll_timeout(&self) -> Duration {
        let due = self.peers.iter().filter_map(|peer| peer.due).min();
        due.map_or(self.expires, |due| due.min(self.expires))
    }

    /// Polls the machines whose time has come, and expires keys.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        self.set_time(now);
        for number in 0..self.peers.len() {
            if self.peers[number].due.is_some_and(|due| due <= now) {
                self.touch(number);
            }
        }
        if now < self.expires {
            return;
        }
        self.expires = now + EXPIRE_EVERY;
        self.acceptor.expire();
        self.dialler_touched = true;
        for number in 0..self.peers.len() {
            let peer = &mut self.peers[number];
            peer.receiver.handle_timeout(now);
            peer.warn(now, &self.config);
            self.touch(number);
        }
    }

    /// Returns the counters for status: of the KME client, of the ledger of used keys, and of each peer's
    /// supply.
    pub(crate) fn status(
        &self,
        now: Duration,
        kme: &Statistics,
        used: &UsedStatistics,
    ) -> serde_json::Value {
        let peers: serde_json::Map<_, _> = self
            .peers
            .iter()
            .map(|peer| {
                let status = serde_json::json!({
                    "sending": peer.sender.statistics(now),
                    "receiving": peer.receiver.statistics(),
                });
                (peer.sae.clone(), status)
            })
            .collect();
        serde_json::json!({ "kme": kme, "peers": peers, "used_keys": used })
    }

    /// Returns the number of the peer `sae`, and assigns one if it has none.
    fn number(&mut self, sae: &str) -> Result<usize, SupplyError> {
        if let Some(number) = self.numbers.get(sae) {
            return Ok(*number);
        }
        let number = self.peers.len();
        self.peers.push(PeerKeys {
            sae: sae.to_owned(),
            sender: KeySender::new(&self.config.sae_id, sae)?,
            receiver: KeyReceiver::new(&self.config.sae_id, sae)?,
            touched: false,
            due: None,
        });
        self.numbers.insert(sae.to_owned(), number);
        Ok(number)
    }

    /// Returns the number of the peer that the connection is attached to.
    fn attached(&self, connection: u64) -> Result<usize, SupplyError> {
        let number = self.connections.get(&connection).copied();
        number.ok_or(SupplyError::Unattached(connection))
    }

    /// Returns the number in a [`RequestOrigin`] if it belongs to a peer.
    fn known(&self, number: u64) -> Option<usize> {
        usize::try_from(number).ok().filter(|number| *number < self.peers.len())
    }

    fn touch(&mut self, number: usize) {
        if !mem::replace(&mut self.peers[number].touched, true) {
            self.touched.push(number);
        }
    }

    /// Collects requests and messages from the touched machines.
    fn drain(&mut self, now: Duration) {
        self.set_time(now);
        if mem::take(&mut self.dialler_touched) {
            while let Some(request) = self.dialler.poll_request(now) {
                self.requests.push_back((RequestOrigin::Dialler, request));
            }
        }
        while let Some(number) = self.touched.pop() {
            let peer = &mut self.peers[number];
            peer.touched = false;
            // Small: the number of peers that have or had a link.
            let origin = number as u64;
            while let Some(request) = peer.receiver.poll_request(now) {
                self.requests.push_back((RequestOrigin::Receiver(origin), request));
            }
            while let Some((connection, message)) = peer.receiver.poll_message() {
                if matches!(message, KeyMessage::Ready { .. }) {
                    self.changed.push_back(connection);
                }
                self.messages.push_back((connection, message));
            }
            while let Some(request) = peer.sender.poll_request(now) {
                self.requests.push_back((RequestOrigin::Sender(origin), request));
            }
            while let Some(message) = peer.sender.poll_message(now) {
                self.messages.push_back(message);
            }
            let due = [peer.sender.poll_timeout(), peer.receiver.poll_timeout()];
            let due = due.into_iter().flatten().min();
            peer.due = due.map(|due| due.max(now + SHORTEST_WAIT));
        }
    }
}

impl PeerKeys {
    /// Logs warnings about keys for the operator of this host.
    fn warn(&mut self, now: Duration, config: &QkdConfig) {
        if let Some(warning) = self.sender.warning(now) {
            tracing::warn!(peer = %self.sae, "{warning}");
        }
        if let Some(disagreement) = self.sender.disagreement(now) {
            warn_disagreement(config, &self.sae, &disagreement);
        }
    }
}

/// Logs that the peer's KME and this host's KME gave different keys under the same key_ID.
pub(crate) fn warn_disagreement(config: &QkdConfig, peer: &str, what: &impl fmt::Display) {
    tracing::warn!(
        "the KMEs disagree about {what}: SAE {} has one key from {}, SAE {peer} another one from \
         its own KME. It is given up and protects nothing. If this comes again, have the operators \
         of both KMEs compare what they hold for these two SAEs",
        config.sae_id,
        config.kme_url,
    );
}
