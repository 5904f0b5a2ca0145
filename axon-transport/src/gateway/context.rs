//! What every task of the gateway shares.

use std::{
    fmt,
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use axon_tls::{
    identity::Auth,
    quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server},
};

use super::{GatewayError, endpoint::transport, keyring::Keyring};
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
        Ok(Self {
            hello: Hello::new(&config, daemon),
            transport: transport(&config),
            next_link: AtomicU64::new(1),
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
