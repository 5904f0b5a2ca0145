//! What every task of the gateway shares.

use std::{
    fmt,
    net::SocketAddr,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::SystemTime,
};

use axon_tls::{
    identity::{Auth, SpkiDigest},
    quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server},
};

use super::{
    GatewayError,
    endpoint::transport,
    keyring::{Keyring, lock},
};
use crate::{
    config::{ClassicAuth, ClassicConfig, Config, Security},
    ids::DaemonId,
    keys::{Attempt, Resolver},
    link::Hello,
};

/// Shared by dialling, accepting and the hub.
pub(super) struct Context {
    /// The daemon's settings.
    pub(super) config: Arc<Config>,
    /// What this side says in HELLO.
    pub(super) hello: Hello,
    /// KME keys, in qkd.
    pub(super) keyring: Option<Arc<Keyring>>,
    /// The classic identity; `None` in qkd.
    auth: Option<Auth>,
    /// When the trust file was last written, as far as it was read.
    trust_read: Mutex<Option<SystemTime>>,
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
    pub(super) fn new(
        config: Arc<Config>,
        daemon: DaemonId,
        keyring: Option<Arc<Keyring>>,
    ) -> Result<Self, GatewayError> {
        let auth = match &config.security {
            Security::Classic(classic) => Some(load_identity(classic)?),
            Security::Qkd(_) => None,
        };
        let mut hello = Hello::new(&config, daemon);
        if let Security::Classic(classic) = &config.security {
            hello.host = super::identity::host(auth.as_ref(), classic, &hello.host)?;
        }
        Ok(Self {
            hello,
            transport: transport(&config),
            next_link: AtomicU64::new(1),
            trust_read: Mutex::new(None),
            config,
            keyring,
            auth,
        })
    }

    /// A number for a new connection, unique in this daemon's life.
    pub(super) fn next_link(&self) -> u64 {
        self.next_link.fetch_add(1, Ordering::Relaxed)
    }

    /// The trust that was configured, for its names.
    pub(super) fn auth(&self) -> Option<&Auth> {
        self.auth.as_ref()
    }

    /// Reads the trust file again if it changed. One that cannot be read leaves what was trusted
    /// before in force: it may be half written.
    pub(super) fn reload_trust(&self) {
        let Security::Classic(ClassicConfig { trust: path, .. }) = &self.config.security else {
            return;
        };
        let (Some(Auth::Pinned { trust, .. }), Some(file)) = (&self.auth, path) else { return };
        let written = std::fs::metadata(file).and_then(|m| m.modified()).ok();
        let mut read = lock(&self.trust_read);
        if written.is_none() || *read == written {
            return;
        }
        match super::identity::trust(Some(file)) {
            Ok(pins) => trust.replace(pins),
            Err(error) => tracing::error!(%error, "the trust file is not used as it is now"),
        }
        *read = written;
    }

    /// Whether a linked peer's key is still trusted: a pin can be removed or run out.
    pub(super) fn still_trusts(&self, peer: Option<&SpkiDigest>) -> bool {
        match &self.auth {
            Some(Auth::Pinned { trust, .. }) => peer.is_some_and(|p| trust.name_of(p).is_some()),
            _ => true,
        }
    }

    /// The client's side of a classic handshake.
    pub(super) fn classic_client(&self) -> Result<quinn::ClientConfig, GatewayError> {
        let auth = self.auth.as_ref().ok_or(GatewayError::WrongMode)?;
        let mut client = hybrid_client(auth, self.config.cipher, ALPN)?;
        client.transport_config(Arc::clone(&self.transport));
        Ok(client)
    }

    /// The client's side of a qkd handshake on one PSK.
    pub(super) fn qkd_client(
        &self,
        attempt: &Attempt,
    ) -> Result<quinn::ClientConfig, GatewayError> {
        let Security::Qkd(qkd) = &self.config.security else {
            return Err(GatewayError::WrongMode);
        };
        let mut client = qkd_client(Arc::clone(&attempt.psk), qkd.kex, ALPN)?;
        client.transport_config(Arc::clone(&self.transport));
        Ok(client)
    }

    /// The server's side, and in qkd the resolver that will tell why a PSK was not found.
    pub(super) fn server(
        &self,
        source: SocketAddr,
    ) -> Result<(quinn::ServerConfig, Option<Arc<Resolver>>), GatewayError> {
        let cipher = self.config.cipher;
        let (mut server, resolver) = match (&self.config.security, &self.keyring, &self.auth) {
            (Security::Qkd(qkd), Some(keyring), _) => {
                let resolver = keyring.acceptor.resolver(source.ip());
                let server = qkd_server(resolver.clone(), cipher, qkd.kex, ALPN)?;
                (server, Some(resolver))
            }
            (Security::Classic(_), _, Some(auth)) => (hybrid_server(auth, cipher, ALPN)?, None),
            _ => return Err(GatewayError::WrongMode),
        };
        server.transport_config(Arc::clone(&self.transport)).migration(true).max_incoming(256);
        Ok((server, resolver))
    }
}

/// The classic identity that the settings name.
fn load_identity(classic: &ClassicConfig) -> Result<Auth, GatewayError> {
    super::identity::load(classic).inspect(|_| {
        if classic.auth == ClassicAuth::None {
            tracing::warn!(
                "AXON_CLASSIC_AUTH=none: peers are UNAUTHENTICATED. A recording adversary learns \
                 nothing; an active one can pose as a peer. Set AXON_CLASSIC_KEY and \
                 AXON_CLASSIC_TRUST to pin peers."
            );
        }
    })
}
