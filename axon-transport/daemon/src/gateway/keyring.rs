//! All KME keys of the daemon in `qkd`: wires the machines of [`crate::keys`] to the KME and to the
//! control streams.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use axon_envelope::{KeyId, KmeKey};
use axon_transport::config::{Config, KeyMode, QkdConfig, Security};
use tokio::sync::{Notify, mpsc};

use super::{control::Outbox, tls_settings::tls_cipher};
use crate::{
    keys::{
        Acceptor, Answer, Clock, Completion, Dialler, Event, Events, Exporters, KeyMessage, Kme,
        KmeError, Origin, Receiver, Request, Sender, SupplyError, UsedKeys,
    },
    link::Message,
};

/// Locks a mutex; a panic elsewhere leaves nothing half-done that a later holder could trip over.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The keys of the daemon.
pub(crate) struct Keyring {
    /// The daemon's monotonic clock.
    pub(super) clock: Clock,
    /// The settings that made it.
    pub(super) config: QkdConfig,
    /// Look-up of PSKs for incoming handshakes.
    pub(super) acceptor: Acceptor,
    /// Bootstrap keys for our own dials.
    dialler: Mutex<Dialler>,
    /// Wakes dials that wait for the KME.
    dialler_answered: Notify,
    kme: Kme,
    used: UsedKeys,
    peers: Mutex<HashMap<String, Arc<PeerKeys>>>,
    /// Answers for proofs under way, by link number.
    proofs: Mutex<HashMap<u64, mpsc::UnboundedSender<Answer>>>,
    next_peer: AtomicU64,
}

impl std::fmt::Debug for Keyring {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Keyring").field("sae", &self.config.sae_id).finish_non_exhaustive()
    }
}

impl Keyring {
    /// The keyring of a daemon in `qkd`, `None` in `classic`. Must run within a tokio runtime.
    /// `used` opens the record of the keys that this host had before.
    pub(super) fn start(
        config: &Config,
        used: impl FnOnce() -> UsedKeys,
    ) -> Result<Option<(Arc<Self>, Events)>, KmeError> {
        let Security::Qkd(qkd) = &config.security else { return Ok(None) };
        let clock = Clock::start();
        let used = used();
        let (kme, events) = Kme::start(qkd, used.clone())?;
        let keyring = Arc::new(Self {
            acceptor: Acceptor::new(
                &qkd.sae_id,
                qkd.peers.clone(),
                tls_cipher(config.cipher),
                clock.clone(),
            ),
            dialler: Mutex::new(Dialler::new(
                &qkd.sae_id,
                qkd.peers.clone(),
                tls_cipher(config.cipher),
                qkd.kme_answer_timeout,
            )),
            dialler_answered: Notify::new(),
            kme,
            used,
            peers: Mutex::default(),
            proofs: Mutex::default(),
            next_peer: AtomicU64::new(1),
            config: qkd.clone(),
            clock,
        });
        Ok(Some((keyring, events)))
    }

    /// Carries requests and answers until the keyring is dropped or the KME client ends.
    pub(super) async fn run(self: Arc<Self>, mut events: Events) {
        let mut second = tokio::time::interval(Duration::from_secs(1));
        loop {
            tokio::select! {
                event = events.recv() => match event {
                    Some(event) => self.dispatch(event),
                    None => return,
                },
                request = self.acceptor.next_request() => self.submit(Origin::Acceptor, request),
                _ = second.tick() => {
                    self.acceptor.expire();
                    self.with_dialler(|_, _| ());
                    let peers: Vec<_> = lock(&self.peers).values().cloned().collect();
                    for peer in peers {
                        peer.with_receiver(&self, |now, receiver| receiver.handle_timeout(now));
                        peer.warn(&self);
                    }
                }
            }
        }
    }

    /// Whether data is sealed per message.
    pub(super) fn seals_messages(&self) -> bool {
        self.config.key_mode == KeyMode::Messages10
    }

    /// Runs `f` on the dialler and sends off what it asks of the KME.
    pub(super) fn with_dialler<T>(&self, f: impl FnOnce(Duration, &mut Dialler) -> T) -> T {
        let now = self.clock.now();
        let mut requests = Vec::new();
        let result = {
            let mut dialler = lock(&self.dialler);
            let result = f(now, &mut dialler);
            while let Some(request) = dialler.poll_request(now) {
                requests.push(request);
            }
            result
        };
        for request in requests {
            self.submit(Origin::Dialler, request);
        }
        result
    }

    /// Resolves when the dialler got an answer, or at `until` (on the keyring's clock).
    pub(super) async fn dialler_ready(&self, until: Option<Duration>) {
        let answered = self.dialler_answered.notified();
        // A second at most: the dialler is asked again and says what it still waits for.
        let wait = until
            .map_or(Duration::from_secs(1), |u| u.saturating_sub(self.clock.now()))
            .min(Duration::from_secs(1));
        let _ = tokio::time::timeout(wait, answered).await;
    }

    /// The keys towards one peer SAE, which live across its connections.
    pub(super) fn peer(&self, sae: &str) -> Result<Arc<PeerKeys>, axon_envelope::ChannelError> {
        if let Some(peer) = lock(&self.peers).get(sae) {
            return Ok(Arc::clone(peer));
        }
        let number = self.next_peer.fetch_add(1, Ordering::Relaxed);
        let peer = Arc::new(PeerKeys {
            number,
            sae: sae.to_owned(),
            sender: Mutex::new(Sender::new(&self.config.sae_id, sae)?),
            receiver: Mutex::new(Receiver::new(&self.config.sae_id, sae)?),
            outboxes: Mutex::default(),
            changed: Notify::new(),
            timer: Notify::new(),
        });
        Ok(Arc::clone(lock(&self.peers).entry(sae.to_owned()).or_insert(peer)))
    }

    /// Registers a proof under way on `link`; its answers come out of the receiver.
    pub(super) fn proof_answers(&self, link: u64) -> mpsc::UnboundedReceiver<Answer> {
        let (sender, receiver) = mpsc::unbounded_channel();
        lock(&self.proofs).insert(link, sender);
        receiver
    }

    /// The proof on `link` is over.
    pub(super) fn proof_over(&self, link: u64) {
        lock(&self.proofs).remove(&link);
    }

    /// Hands a request to the KME; when its queue is full the machine is told at once.
    pub(super) fn submit(&self, origin: Origin, request: Request) {
        if let Err(event) = self.kme.submit(origin, request) {
            self.dispatch(*event);
        }
    }

    /// A handshake under `identity`, with the key `key_id`, is complete: the key is spent.
    pub(super) async fn spent(&self, identity: &[u8], key_id: &str) -> Completion {
        if self.acceptor.spent(identity) == Completion::Reused {
            return Completion::Reused;
        }
        let (used, key_id) = (self.used.clone(), [key_id.to_owned()]);
        // A daemon before this one may have had it.
        match tokio::task::spawn_blocking(move || used.record(&key_id)).await.as_deref() {
            Ok([true]) => Completion::First,
            _ => Completion::Reused,
        }
    }

    /// After READY's proof: this address is known from now on.
    pub(super) fn authenticated(&self, source: IpAddr, sae: &str) {
        self.acceptor.authenticated(source, sae);
    }

    /// A connection failed before it became a link.
    pub(super) fn forget_connection(&self, connection: u64) {
        let peers: Vec<_> = lock(&self.peers).values().cloned().collect();
        for peer in peers {
            if lock(&peer.outboxes).contains_key(&connection) {
                peer.detach(self, connection);
            }
        }
    }

    /// For status: counters of the KME client and of each peer's supply.
    pub(super) fn status(&self) -> serde_json::Value {
        let now = self.clock.now();
        let peers: Vec<_> = lock(&self.peers).values().cloned().collect();
        let peers: serde_json::Map<_, _> = peers
            .iter()
            .map(|p| {
                let status = serde_json::json!({
                    "sending": lock(&p.sender).statistics(now),
                    "receiving": lock(&p.receiver).statistics(),
                });
                (p.sae.clone(), status)
            })
            .collect();
        let used = self.used.statistics();
        serde_json::json!({ "kme": self.kme.statistics(), "peers": peers, "used_keys": used })
    }

    fn dispatch(&self, event: Event) {
        let Event { origin, answer } = event;
        match origin {
            Origin::Dialler => {
                self.with_dialler(|now, dialler| dialler.handle_answer(now, answer));
                self.dialler_answered.notify_waiters();
            }
            Origin::Acceptor => self.acceptor.handle_answer(answer),
            Origin::Proof(link) | Origin::Responder(link) => {
                if let Some(waiting) = lock(&self.proofs).get(&link) {
                    let _ = waiting.send(answer);
                }
            }
            Origin::Sender(number) => {
                if let Some(peer) = self.by_number(number) {
                    peer.with_sender(self, |now, sender| sender.handle_answer(now, answer));
                }
            }
            Origin::Receiver(number) => {
                if let Some(peer) = self.by_number(number) {
                    peer.with_receiver(self, |now, receiver| receiver.handle_answer(now, answer));
                }
            }
        }
    }

    fn by_number(&self, number: u64) -> Option<Arc<PeerKeys>> {
        lock(&self.peers).values().find(|p| p.number == number).cloned()
    }
}

/// The peer's KME gave it another key than this host's KME gave here, under the same key_ID.
pub(crate) fn warn_disagreement(config: &QkdConfig, peer: &str, what: &impl std::fmt::Display) {
    tracing::warn!(
        "the KMEs disagree about {what}: SAE {} has one key from {}, SAE {peer} another one from \
         its own KME. It is given up and protects nothing. If this comes again, have the operators \
         of both KMEs compare what they hold for these two SAEs",
        config.sae_id,
        config.kme_url,
    );
}

/// The message keys of both directions with one peer SAE.
pub(crate) struct PeerKeys {
    number: u64,
    sae: String,
    sender: Mutex<Sender>,
    receiver: Mutex<Receiver>,
    /// Where the messages of a connection go.
    outboxes: Mutex<HashMap<u64, Outbox>>,
    /// Wakes streams that wait for a key.
    pub(super) changed: Notify,
    timer: Notify,
}

impl PeerKeys {
    /// A connection begins: its messages go to `outbox`, and it can receive. Timers run from here.
    pub(super) fn attach_receiver(
        self: &Arc<Self>,
        keyring: &Arc<Keyring>,
        connection: u64,
        exporters: &Exporters,
        outbox: Outbox,
    ) -> Result<(), SupplyError> {
        lock(&self.outboxes).insert(connection, outbox);
        self.with_receiver(keyring, |now, r| r.attach(now, connection, exporters))?;
        tokio::spawn(Arc::clone(self).run_timers(Arc::clone(keyring), connection));
        Ok(())
    }

    /// The connection was elected: keys may be announced on it. `first` is the key that proved the
    /// client's name, which the server uses for its first messages.
    pub(super) fn attach_sender(
        &self,
        keyring: &Keyring,
        connection: u64,
        exporters: &Exporters,
        first: Option<(KeyId, KmeKey)>,
    ) -> Result<(), SupplyError> {
        let owed = self.with_sender(keyring, |now, sender| {
            let owed = sender.attach(now, connection, exporters)?;
            if let Some((key_id, key)) = first {
                sender.adopt(now, connection, key_id, key)?;
            }
            Ok::<_, SupplyError>(owed)
        })?;
        // They belong to the previous connection, which a successor has not closed yet. A third one
        // that is not open yet would be closed over them.
        for message in owed {
            self.post(message);
        }
        Ok(())
    }

    /// A connection ended.
    pub(super) fn detach(&self, keyring: &Keyring, connection: u64) {
        lock(&self.outboxes).remove(&connection);
        self.with_receiver(keyring, |now, r| r.detach(now, connection));
        self.with_sender(keyring, |now, s| s.detach(now, connection));
    }

    /// A key announcement came in.
    pub(super) fn handle_message(
        &self,
        keyring: &Keyring,
        connection: u64,
        message: &KeyMessage,
    ) -> Result<(), SupplyError> {
        match message {
            KeyMessage::Announce(_) | KeyMessage::Retire { .. } => {
                self.with_receiver(keyring, |now, r| r.handle_message(now, connection, message))
            }
            KeyMessage::Ready { .. } | KeyMessage::Failed { .. } => {
                let result =
                    self.with_sender(keyring, |now, s| s.handle_message(now, connection, message));
                // A key may have become READY.
                self.changed.notify_waiters();
                self.warn(keyring);
                result
            }
        }
    }

    /// Runs `f` on the sending side, then sends off what it asks for and has to say.
    pub(super) fn with_sender<T>(
        &self,
        keyring: &Keyring,
        f: impl FnOnce(Duration, &mut Sender) -> T,
    ) -> T {
        let now = keyring.clock.now();
        let (mut requests, mut said) = (Vec::new(), false);
        let result = {
            let mut sender = lock(&self.sender);
            let result = f(now, &mut sender);
            while let Some(request) = sender.poll_request(now) {
                requests.push(request);
            }
            // Under the lock: whoever then sees the new state finds its messages in the outbox.
            while let Some(message) = sender.poll_message(now) {
                said |= self.post(message);
            }
            result
        };
        self.carry(keyring, Origin::Sender(self.number), requests, said);
        result
    }

    /// Runs `f` on the receiving side, then sends off what it asks for and has to say.
    pub(super) fn with_receiver<T>(
        &self,
        keyring: &Keyring,
        f: impl FnOnce(Duration, &mut Receiver) -> T,
    ) -> T {
        let now = keyring.clock.now();
        let (mut requests, mut said) = (Vec::new(), false);
        let result = {
            let mut receiver = lock(&self.receiver);
            let result = f(now, &mut receiver);
            while let Some(request) = receiver.poll_request(now) {
                requests.push(request);
            }
            // Under the lock: ELECTED, for one, must not overtake the READY that allows it.
            while let Some(message) = receiver.poll_message() {
                said |= self.post(message);
            }
            result
        };
        self.carry(keyring, Origin::Receiver(self.number), requests, said);
        result
    }

    /// Drives the timers of both directions until `connection` is detached.
    async fn run_timers(self: Arc<Self>, keyring: Arc<Keyring>, connection: u64) {
        while lock(&self.outboxes).contains_key(&connection) {
            let now = keyring.clock.now();
            let next = [lock(&self.sender).poll_timeout(), lock(&self.receiver).poll_timeout()];
            let next = next.into_iter().flatten().min();
            let sleep = next
                .map_or(Duration::from_secs(1), |at| at.saturating_sub(now))
                .clamp(Duration::from_millis(5), Duration::from_secs(1));
            let _ = tokio::time::timeout(sleep, self.timer.notified()).await;
            self.with_sender(&keyring, |_, _| ());
            self.with_receiver(&keyring, |_, _| ());
        }
    }

    /// Puts a key message into its connection's outbox.
    fn post(&self, (connection, message): (u64, KeyMessage)) -> bool {
        if let Some(outbox) = lock(&self.outboxes).get(&connection) {
            outbox.send(Message::Keys(message));
        }
        true
    }

    fn carry(&self, keyring: &Keyring, origin: Origin, requests: Vec<Request>, said: bool) {
        if said || !requests.is_empty() {
            self.timer.notify_one();
            self.changed.notify_waiters();
        }
        for request in requests {
            keyring.submit(origin, request);
        }
    }

    /// Says what the owner of this host should know of the keys.
    fn warn(&self, keyring: &Keyring) {
        let now = keyring.clock.now();
        let (supply, disagreement) = {
            let mut sender = lock(&self.sender);
            (sender.warning(now), sender.disagreement(now))
        };
        if let Some(warning) = supply {
            tracing::warn!(peer = %self.sae, "{warning}");
        }
        if let Some(disagreement) = disagreement {
            warn_disagreement(&keyring.config, &self.sae, &disagreement);
        }
    }
}
