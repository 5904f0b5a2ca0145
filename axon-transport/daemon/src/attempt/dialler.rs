//! Takes an attempt from its settings to a connection that awaits its election.

use std::{
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::{KeyId, KmeKey};
use axon_shm::ids::DaemonId;
use axon_tls::{qkd::derive_psk, quic::negotiated};
use axon_transport::config::{Config, Security};
use quinn::{Connecting, Connection, ConnectionError, TokioRuntime, VarInt};
use secrecy::ExposeSecret;

use super::{
    Bootstrap,
    control::{AttemptControl, Unreadable},
    internal,
    keys::Keys,
};
use crate::{
    engine::{
        credentials::Credentials,
        keyring::{Answered, Keyring},
        link::{
            dialling::{DialAction, Dialling},
            failure::{HELLO_TIMEOUT, close_text},
            opening::{Handshake, OpenedConnection, Opening, RefusedConnection},
            target::{DialTarget, UNKNOWN_PSK_IDENTITY},
        },
        quic::{endpoints::reaches, tls_settings::tls_cipher, transport::endpoint_config},
        refusal::Refusal,
    },
    error::{EndpointError, GatewayError},
    identity,
    keys::{DialKey, Exporters},
    link::{CloseCode, LinkHello, LinkMessage, Side},
    reactor::bind_daemon,
};

/// The number of the one connection that an attempt makes.
pub(super) const LINK: u64 = 1;
/// Dials under a key_ID that the daemon's KME has: the daemon looks it up after its first refusal.
const TRIES: u32 = 12;
/// Dials under a key_ID that no KME has.
const TRIES_UNKNOWN: u32 = 3;
/// Time between two of these dials.
const TRY_AGAIN: Duration = Duration::from_millis(200);

/// The client's side of an attempt.
pub(super) struct AttemptDialler {
    config: Arc<Config>,
    credentials: Credentials,
    hello: LinkHello,
    target: DialTarget,
    /// `None` if no bound address reaches the target.
    endpoint: Option<quinn::Endpoint>,
    keys: Option<Keys>,
    /// When the time of the machines was zero.
    epoch: Instant,
}

impl AttemptDialler {
    /// Binds a port and starts the KME client. Must run within a tokio runtime.
    ///
    /// # Errors
    /// A setting, or a file that it names, cannot be used, or no port can be bound.
    pub(super) fn start(
        config: &Config,
        target: SocketAddr,
        sae: Option<&str>,
    ) -> Result<Self, GatewayError> {
        let config = Arc::new(config.clone());
        let keys = Keys::start(&config)?;
        // The lowest id: this side elects.
        let mut hello = LinkHello::new(&config, DaemonId::default());
        let identity = match &config.security {
            Security::Classic(classic) => Some(identity::load(classic, &hello.host)?),
            Security::Qkd(_) => None,
        };
        if let Some(identity) = &identity {
            identity.host().clone_into(&mut hello.host);
        }
        Ok(Self {
            credentials: Credentials::new(Arc::clone(&config), identity.map(Arc::new)),
            endpoint: bind(&config, target)?,
            config,
            hello,
            target: DialTarget {
                daemon: None,
                sae: sae.map(Into::into),
                addresses: vec![target],
                listed: false,
                standing: None,
                replaces: None,
                beside: None,
            },
            keys,
            epoch: Instant::now(),
        })
    }

    /// Returns the settings.
    pub(super) fn config(&self) -> &Config {
        &self.config
    }

    /// Returns the daemon that this side poses as.
    pub(super) fn daemon(&self) -> DaemonId {
        self.hello.daemon
    }

    /// Returns the time of the machines.
    pub(super) fn now(&self) -> Duration {
        self.epoch.elapsed()
    }

    /// Returns the keyring, in qkd.
    pub(super) fn keyring(&mut self) -> Option<&mut Keyring> {
        self.keys.as_mut().map(|keys| &mut keys.keyring)
    }

    /// Dials the target: in qkd under a key from the KME, or under this `forged` one.
    pub(super) async fn connect(
        &mut self,
        forged: Option<&DialKey>,
    ) -> Result<Connection, Refusal> {
        let own_keys = forged.is_none();
        let (now, target) = (self.now(), self.target.clone());
        let mut dialling =
            Dialling::new(now, target, self.keyring().filter(|_| own_keys).as_deref());
        let (mut connecting, mut connected) = (None::<Connecting>, None::<Connection>);
        loop {
            let now = self.now();
            // A dial without a keyring uses its one key as it is.
            while let Some(action) = dialling.poll_action(now, self.keyring().filter(|_| own_keys))
            {
                match action {
                    DialAction::Connect { address, attempt } => {
                        match self.credentials.client(forged.or(attempt.as_deref()), address.ip()) {
                            Ok(client) => match self.begin(client, address) {
                                Ok(begun) => connecting = Some(begun),
                                Err(error) => dialling.handle_unreachable(error.as_ref()),
                            },
                            Err(error) => dialling.handle_unusable(error),
                        }
                    }
                    DialAction::Close { code, reason } => {
                        connecting = None;
                        if let Some(connection) = connected.take() {
                            close(&connection, code, reason);
                        }
                    }
                    DialAction::Open => {
                        let none = || internal("the dial ended without a connection");
                        return connected.ok_or_else(none);
                    }
                    DialAction::Failed(refusal) => return Err(refusal),
                }
            }
            tokio::select! {
                ended = handshake(&mut connecting) => match ended {
                    Ok(connection) => {
                        connected = Some(connection);
                        dialling.handle_connected();
                    }
                    Err(error) => dialling.handle_failed(&error),
                },
                answered = self.wait(dialling.poll_timeout()) => {
                    if let Some(Answered::Dialler) = answered {
                        dialling.handle_key();
                    }
                }
            }
        }
    }

    /// Dials the target under a PSK that it must refuse.
    pub(super) async fn connect_forged(
        &mut self,
        bootstrap: Bootstrap,
    ) -> Result<Connection, Refusal> {
        let attempt = self.forge(bootstrap).await?;
        let most = if bootstrap == Bootstrap::WrongKey { TRIES } else { TRIES_UNKNOWN };
        let mut tries = 1;
        loop {
            match self.connect(Some(&attempt)).await {
                // The daemon looks the key up after its first answer. Only a repeated refusal after that is final.
                Err(refusal) if refusal.alert == Some(UNKNOWN_PSK_IDENTITY) && tries < most => {
                    tries += 1;
                    tokio::time::sleep(TRY_AGAIN).await;
                }
                outcome => return outcome,
            }
        }
    }

    /// Makes a PSK that the target must refuse.
    async fn forge(&mut self, bootstrap: Bootstrap) -> Result<DialKey, Refusal> {
        let now = self.now();
        let (Security::Qkd(qkd), Some(keys), Some(peer)) =
            (&self.config.security, &mut self.keys, &self.target.sae)
        else {
            return Err(internal("a forged PSK needs qkd and the peer's SAE ID"));
        };
        let (key_id, key) = match bootstrap {
            Bootstrap::WrongKey => {
                let (key_id, key) = keys.fetch(now, peer).await.map_err(internal)?;
                let mut wrong = *key.expose_secret();
                wrong[0] ^= 1;
                (key_id, KmeKey::take(&mut wrong))
            }
            _ => {
                let id = format!("{:032x}", rand::random::<u128>());
                (KeyId::new(id).map_err(internal)?, KmeKey::take(&mut rand::random()))
            }
        };
        let id = String::from_utf8_lossy(key_id.as_bytes()).into_owned();
        let cipher = tls_cipher(self.config.cipher);
        let psk = derive_psk(key.expose_secret(), &id, &qkd.sae_id, peer, cipher);
        Ok(DialKey { key_id, psk: Arc::new(psk.map_err(internal)?) })
    }

    /// Carries a connection through HELLO and the proof of this side's name. Closes it if that fails.
    pub(super) async fn open(
        &mut self,
        connection: &Connection,
    ) -> Result<(OpenedConnection, AttemptControl), Refusal> {
        let mut control = match tokio::time::timeout(HELLO_TIMEOUT, connection.open_bi()).await {
            Ok(Ok(streams)) => AttemptControl::new(streams),
            Ok(Err(error)) => return Err(Refusal::of(&error)),
            Err(_) => {
                let text = "no HELLO within 5 s";
                close(connection, CloseCode::OutOfOrder, text);
                return Err(Refusal::here(CloseCode::OutOfOrder, text));
            }
        };
        let mut opening = self.opening(connection);
        loop {
            let now = self.now();
            let outcome = opening.poll_outcome(now, self.keyring());
            while let Some(message) = opening.poll_message() {
                // HELLO and proofs always fit.
                let _ = control.send(&message);
            }
            if let Some(keys) = &mut self.keys {
                while let Some(request) = opening.poll_request(now) {
                    keys.submit(request);
                }
            }
            self.say_keys(&mut control);
            control.set_limits(opening.limits());
            match outcome {
                Some(Ok(opened)) => {
                    // The daemon waits for the proof, whatever the caller does with the link. An error shows with
                    // the next message.
                    let _ = tokio::time::timeout(HELLO_TIMEOUT, control.flush()).await;
                    return Ok((opened, control));
                }
                Some(Err(RefusedConnection { refusal, close: told })) => {
                    if let Some((code, told)) = told {
                        close(connection, code, &told);
                    }
                    return Err(refusal);
                }
                None => {}
            }
            tokio::select! {
                message = control.next(opening.reads()) => {
                    let now = self.now();
                    match (message, connection.close_reason()) {
                        (Ok(message), _) => opening.handle_message(now, &message, self.keyring()),
                        (Err(Unreadable::Frame(error)), _) => {
                            opening.handle_unreadable(now, error, self.keyring());
                        }
                        (Err(Unreadable::Ended(_)), Some(error)) => {
                            opening.handle_lost(now, &error, self.keyring());
                        }
                        (Err(Unreadable::Ended(why)), None) => {
                            opening.handle_ended(now, &why, self.keyring());
                        }
                    }
                }
                error = connection.closed() => {
                    opening.handle_lost(self.now(), &error, self.keyring());
                }
                answered = self.wait(opening.poll_timeout()) => match answered {
                    Some(Answered::Opening(_, answer)) => {
                        opening.handle_answer(self.now(), answer, self.keyring());
                    }
                    Some(_) => {}
                    None => opening.handle_timeout(self.now(), self.keyring()),
                },
            }
        }
    }

    fn opening(&mut self, connection: &Connection) -> Opening {
        let exporters =
            Exporters::derive(|out, label| connection.export_keying_material(out, label, b""));
        let shown = connection.peer_identity().and_then(|shown| shown.downcast().ok());
        let handshake = Handshake {
            connection: LINK,
            side: Side::Client,
            remote: connection.remote_address(),
            negotiated: negotiated(connection),
            exporters: exporters.ok(),
            chain: shown.map(|shown| *shown).unwrap_or_default(),
            dialled: self.target.sae.clone(),
        };
        let ours = self.target.hello(&self.hello);
        let (now, closed) = (self.now(), self.credentials.closed());
        let keyring = self.keys.as_mut().map(|keys| &mut keys.keyring);
        Opening::new(now, handshake, ours, &self.config, closed, keyring)
    }

    /// Queues the keyring's announcements on the control stream.
    pub(super) fn say_keys(&mut self, control: &mut AttemptControl) {
        let now = self.now();
        let Some(keyring) = self.keyring() else { return };
        while let Some((_, message)) = keyring.poll_message(now) {
            // Key announcements always fit.
            let _ = control.send(&LinkMessage::Keys(message));
        }
        // The caller looks at its keys after each wait.
        while keyring.poll_changed(now).is_some() {}
    }

    /// Waits for an answer of the KME, which the keyring takes, until `due` or until the keyring is due. Returns
    /// where the answer went, `None` at a timeout. Cancel safe.
    pub(super) async fn wait(&mut self, due: Option<Duration>) -> Option<Answered> {
        let Some(keys) = &mut self.keys else {
            sleep_until(self.epoch, due).await;
            return None;
        };
        keys.submit_all(self.epoch.elapsed());
        let keyring_due = keys.keyring.poll_timeout();
        let due = due.map_or(keyring_due, |due| due.min(keyring_due));
        tokio::select! {
            event = keys.answer() => {
                Some(keys.keyring.handle_answer(self.epoch.elapsed(), event))
            }
            () = sleep_until(self.epoch, Some(due)) => {
                let now = self.epoch.elapsed();
                if keys.keyring.poll_timeout() <= now {
                    keys.keyring.handle_timeout(now);
                }
                None
            }
        }
    }

    /// Begins a handshake.
    ///
    /// # Errors
    /// QUIC refuses; `None` if no bound address reaches `address`.
    fn begin(
        &self,
        client: quinn::ClientConfig,
        address: SocketAddr,
    ) -> Result<Connecting, Option<quinn::ConnectError>> {
        let endpoint = self.endpoint.as_ref().ok_or(None)?;
        // The name is neither sent nor checked: a peer is known by its key, its SAE, or its certificate and HELLO.
        endpoint.connect_with(client, address, "axon").map_err(Some)
    }
}

/// Closes a connection and tells the peer why.
pub(super) fn close(connection: &Connection, code: CloseCode, reason: &str) {
    connection.close(VarInt::from_u32(code.code()), close_text(reason));
}

/// Binds an endpoint to a port of the domain, on the first configured address that reaches `target`. `None` if no
/// address does.
fn bind(config: &Config, target: SocketAddr) -> Result<Option<quinn::Endpoint>, EndpointError> {
    let (_, sockets) = bind_daemon(config)?;
    let socket = sockets.into_iter().find(|(address, _)| reaches(*address, target));
    let Some((_, socket)) = socket else { return Ok(None) };
    let settings = endpoint_config(&rand::random());
    let endpoint = quinn::Endpoint::new(settings, None, socket, Arc::new(TokioRuntime))?;
    Ok(Some(endpoint))
}

/// Waits for the end of the handshake under way; without one, waits for ever. Cancel safe.
async fn handshake(connecting: &mut Option<Connecting>) -> Result<Connection, ConnectionError> {
    let Some(begun) = connecting else { return std::future::pending().await };
    let ended = begun.await;
    *connecting = None;
    ended
}

async fn sleep_until(epoch: Instant, due: Option<Duration>) {
    match due {
        Some(due) => tokio::time::sleep_until((epoch + due).into()).await,
        None => std::future::pending().await,
    }
}
