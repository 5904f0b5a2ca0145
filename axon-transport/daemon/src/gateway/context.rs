//! The state that all tasks of the gateway share.

use std::{
    collections::BTreeSet,
    fmt,
    net::{IpAddr, SocketAddr},
    sync::{
        Arc, PoisonError, RwLock,
        atomic::{AtomicU64, Ordering},
    },
    time::{Instant, SystemTime},
};

use axon_shm::ids::DaemonId;
use axon_tls::{
    Negotiated,
    identity::Auth,
    quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server},
};
use axon_transport::config::{ClassicAuth, ClassicConfig, Config, Security};

use rustls_pki_types::CertificateDer;

use super::{
    GatewayError,
    endpoint::transport,
    identity::Identity,
    keyring::Keyring,
    tls_settings::{psk_kex, tls_cipher},
};
use crate::{
    keys::{Attempt, Resolver},
    link::{Hello, Side},
};

/// Shared by dialling, accepting and the hub.
pub(crate) struct Context {
    /// The daemon's settings.
    pub(crate) config: Arc<Config>,
    /// What this side says in HELLO.
    pub(crate) hello: Hello,
    /// Addresses of listed peers.
    listed: RwLock<BTreeSet<IpAddr>>,
    /// KME keys, in qkd.
    pub(crate) keyring: Option<Arc<Keyring>>,
    /// The classic identity; `None` in qkd.
    identity: Option<Identity>,
    transport: Arc<quinn::TransportConfig>,
    next_link: AtomicU64,
}

impl fmt::Debug for Context {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Context").field("hello", &self.hello).finish_non_exhaustive()
    }
}

impl Context {
    /// Loads the classic identity from its files, if this is classic.
    pub(crate) fn new(
        config: Arc<Config>,
        daemon: DaemonId,
        keyring: Option<Arc<Keyring>>,
    ) -> Result<Self, GatewayError> {
        let mut hello = Hello::new(&config, daemon);
        let identity = match &config.security {
            Security::Classic(classic) => Some(load_identity(classic, &hello.host)?),
            Security::Qkd(_) => None,
        };
        if let Some(identity) = &identity {
            identity.host().clone_into(&mut hello.host);
        }
        Ok(Self {
            hello,
            transport: transport(&config),
            next_link: AtomicU64::new(1),
            listed: RwLock::default(),
            config,
            keyring,
            identity,
        })
    }

    /// From now on the listed peers have these addresses.
    pub(crate) fn set_listed(&self, addresses: BTreeSet<IpAddr>) {
        *self.listed.write().unwrap_or_else(PoisonError::into_inner) = addresses;
    }

    /// Whether a listed peer has this address.
    pub(crate) fn is_listed(&self, address: IpAddr) -> bool {
        let listed = self.listed.read().unwrap_or_else(PoisonError::into_inner);
        listed.contains(&address.to_canonical())
    }

    /// A number for a new connection, unique in this daemon's life.
    pub(crate) fn next_link(&self) -> u64 {
        self.next_link.fetch_add(1, Ordering::Relaxed)
    }

    /// The classic identity in force; `None` in qkd.
    pub(crate) fn auth(&self) -> Option<Auth> {
        self.identity.as_ref().map(Identity::auth)
    }

    /// Whether peers prove who they are.
    pub(crate) fn authenticates(&self) -> bool {
        !matches!(self.auth(), Some(Auth::None(_)))
    }

    /// Why nobody new is let in, if so: this host does not know at present whom to trust.
    pub(crate) fn closed(&self) -> Option<String> {
        self.identity.as_ref().and_then(Identity::closed)
    }

    /// Whether [`Context::look_at_files()`] is worth calling.
    pub(crate) fn has_files(&self) -> bool {
        self.identity.as_ref().is_some_and(Identity::has_files)
    }

    /// Reads the files of the classic identity again if they changed; whether somebody may be
    /// trusted now who was not, or the other way round. Blocks on the file system.
    pub(crate) fn look_at_files(&self) -> bool {
        self.identity.as_ref().is_some_and(|identity| identity.look(Instant::now()))
    }

    /// Why a linked peer, of which this is the `side`, would not be accepted now: its pin was removed
    /// or ran out, its certificate ran out or was revoked.
    ///
    /// Certificates are checked only if `certificates` says so: that costs signatures.
    pub(crate) fn distrust(
        &self,
        connection: &quinn::Connection,
        negotiated: &Negotiated,
        side: Side,
        certificates: bool,
    ) -> Option<String> {
        match self.auth()? {
            Auth::Pinned { trust, .. } => {
                let pin = negotiated.peer.and_then(|key| trust.pin_of(&key));
                match pin {
                    Some(pin) if pin.holds(SystemTime::now()) => None,
                    Some(pin) => Some(format!(
                        "its pin in AXON_CLASSIC_TRUST, of {}, ended: its last day is {} (UTC)",
                        pin.name(),
                        pin.last_day().unwrap_or("unknown")
                    )),
                    None => Some("its key is no longer pinned in AXON_CLASSIC_TRUST".into()),
                }
            }
            Auth::Ca(material) if certificates => {
                let chain = chain(connection);
                let accepted = match side {
                    Side::Client => material.accepts_server(&chain),
                    Side::Server => material.accepts_client(&chain),
                };
                accepted
                    .err()
                    .map(|error| format!("its certificate is no longer accepted: {error}"))
            }
            _ => None,
        }
    }

    /// The client's side of a classic handshake.
    pub(crate) fn classic_client(&self) -> Result<quinn::ClientConfig, GatewayError> {
        let auth = self.auth().ok_or(GatewayError::WrongMode)?;
        let mut client = hybrid_client(&auth, tls_cipher(self.config.cipher), ALPN)?;
        client.transport_config(Arc::clone(&self.transport));
        Ok(client)
    }

    /// The client's side of a qkd handshake on one PSK.
    pub(crate) fn qkd_client(
        &self,
        attempt: &Attempt,
    ) -> Result<quinn::ClientConfig, GatewayError> {
        let Security::Qkd(qkd) = &self.config.security else {
            return Err(GatewayError::WrongMode);
        };
        let mut client = qkd_client(Arc::clone(&attempt.psk), psk_kex(qkd.kex), ALPN)?;
        client.transport_config(Arc::clone(&self.transport));
        Ok(client)
    }

    /// The server's side, and in qkd the resolver that will tell why a PSK was not found.
    pub(crate) fn server(
        &self,
        source: SocketAddr,
    ) -> Result<(quinn::ServerConfig, Option<Arc<Resolver>>), GatewayError> {
        let cipher = tls_cipher(self.config.cipher);
        let (mut server, resolver) = match (&self.config.security, &self.keyring, self.auth()) {
            (Security::Qkd(qkd), Some(keyring), _) => {
                let resolver = keyring.acceptor.resolver(source.ip());
                let server = qkd_server(resolver.clone(), cipher, psk_kex(qkd.kex), ALPN)?;
                (server, Some(resolver))
            }
            (Security::Classic(_), _, Some(auth)) => (hybrid_server(&auth, cipher, ALPN)?, None),
            _ => return Err(GatewayError::WrongMode),
        };
        server.transport_config(Arc::clone(&self.transport)).migration(true).max_incoming(256);
        Ok((server, resolver))
    }
}

/// What the peer showed in the handshake: certificates, or one raw public key.
pub(crate) fn chain(connection: &quinn::Connection) -> Vec<CertificateDer<'static>> {
    let shown = connection.peer_identity().and_then(|shown| shown.downcast().ok());
    shown.map(|shown| *shown).unwrap_or_default()
}

/// The classic identity that the settings name.
///
/// # Errors
/// A file of it cannot be used.
pub(crate) fn load_identity(classic: &ClassicConfig, node: &str) -> Result<Identity, GatewayError> {
    Identity::load(classic, node).inspect(|_| {
        if classic.auth == ClassicAuth::None {
            tracing::warn!(
                "AXON_CLASSIC_AUTH=none: peers are UNAUTHENTICATED. A recording adversary learns \
                 nothing; an active one can pose as a peer. Set AXON_CLASSIC_KEY and \
                 AXON_CLASSIC_TRUST to pin peers."
            );
        }
    })
}
