//! Configs, PSKs, a resolver, and ways to move bytes between two ends.

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;

use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::crypto::{CryptoProvider, SupportedKxGroup};
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::{
    ClientConfig, ClientConnection, ConnectionCommon, Error, ServerConfig, ServerConnection,
    SupportedCipherSuite,
};
use zeroize::Zeroizing;

pub(crate) const SHA256: SupportedCipherSuite = cipher_suite::TLS13_CHACHA20_POLY1305_SHA256;
pub(crate) const SHA384: SupportedCipherSuite = cipher_suite::TLS13_AES_256_GCM_SHA384;
pub(crate) const HYBRID: &dyn SupportedKxGroup = kx_group::X25519MLKEM768;
pub(crate) const MODES: [PskKeyExchangeMode; 2] =
    [PskKeyExchangeMode::PskKe, PskKeyExchangeMode::PskDheKe];

pub(crate) fn provider(
    suites: &[SupportedCipherSuite],
    groups: &[&'static dyn SupportedKxGroup],
) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider {
        cipher_suites: suites.to_vec(),
        kx_groups: groups.to_vec(),
        ..default_provider()
    })
}

pub(crate) fn hash_of(suite: SupportedCipherSuite) -> HashAlgorithm {
    suite.tls13().unwrap().common.hash_provider.algorithm()
}

pub(crate) fn psk(identity: &str, secret: u8, suite: SupportedCipherSuite) -> Arc<ExternalPsk> {
    let secret = Zeroizing::new(vec![secret; 32]);
    Arc::new(ExternalPsk::new(identity, secret, hash_of(suite)).unwrap())
}

/// Knows some PSKs, and counts how often it was asked.
pub(crate) struct Known {
    pub(crate) psks: Vec<Arc<ExternalPsk>>,
    pub(crate) asked: AtomicUsize,
}

impl Known {
    pub(crate) fn new(psks: Vec<Arc<ExternalPsk>>) -> Arc<Self> {
        Arc::new(Self { psks, asked: AtomicUsize::new(0) })
    }
}

impl fmt::Debug for Known {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Known")
    }
}

impl ResolvesExternalPsk for Known {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        offer
            .identities()
            .find_map(|offered| self.psks.iter().find(|psk| psk.identity() == offered))
            .cloned()
    }
}

pub(crate) fn groups_for(mode: PskKeyExchangeMode) -> &'static [&'static dyn SupportedKxGroup] {
    match mode {
        PskKeyExchangeMode::PskKe => &[],
        PskKeyExchangeMode::PskDheKe => &[HYBRID],
    }
}

pub(crate) fn client_config(
    suites: &[SupportedCipherSuite],
    psks: Vec<Arc<ExternalPsk>>,
    mode: PskKeyExchangeMode,
) -> ClientConfig {
    client_config_over(suites, groups_for(mode), psks, mode)
}

pub(crate) fn client_config_over(
    suites: &[SupportedCipherSuite],
    groups: &[&'static dyn SupportedKxGroup],
    psks: Vec<Arc<ExternalPsk>>,
    mode: PskKeyExchangeMode,
) -> ClientConfig {
    ClientConfig::builder_with_provider(provider(suites, groups))
        .with_external_psks(psks, mode)
        .unwrap()
}

pub(crate) fn server_config(
    suites: &[SupportedCipherSuite],
    resolver: Arc<Known>,
    mode: PskKeyExchangeMode,
) -> ServerConfig {
    server_config_over(suites, groups_for(mode), resolver, mode)
}

pub(crate) fn server_config_over(
    suites: &[SupportedCipherSuite],
    groups: &[&'static dyn SupportedKxGroup],
    resolver: Arc<dyn ResolvesExternalPsk>,
    mode: PskKeyExchangeMode,
) -> ServerConfig {
    ServerConfig::builder_with_provider(provider(suites, groups))
        .with_external_psk_resolver(resolver, mode)
        .unwrap()
}

pub(crate) fn client(config: ClientConfig) -> ClientConnection {
    ClientConnection::new(Arc::new(config), "example.com".try_into().unwrap()).unwrap()
}

pub(crate) fn server(config: ServerConfig) -> ServerConnection {
    ServerConnection::new(Arc::new(config)).unwrap()
}

/// What an end has to send.
pub(crate) fn written<D>(from: &mut ConnectionCommon<D>) -> Vec<u8> {
    let mut bytes = Vec::new();
    while from.wants_write() {
        from.write_tls(&mut bytes).unwrap();
    }
    bytes
}

/// Gives an end what was written to it. Its first error, if it has one.
pub(crate) fn feed<D>(to: &mut ConnectionCommon<D>, mut bytes: &[u8]) -> Result<(), Error> {
    while !bytes.is_empty() {
        to.read_tls(&mut bytes).unwrap();
        to.process_new_packets()?;
    }
    Ok(())
}

/// Moves what one end wrote to the other.
pub(crate) fn pass<F, T>(
    from: &mut ConnectionCommon<F>,
    to: &mut ConnectionCommon<T>,
) -> Result<(), Error> {
    feed(to, &written(from))
}

/// Whoever fails first, `Ok` if nobody does.
pub(crate) fn handshake(
    client: &mut ClientConnection,
    server: &mut ServerConnection,
) -> Result<(), Error> {
    for _ in 0..4 {
        pass(client, server)?;
        pass(server, client)?;
    }
    assert!(!client.is_handshaking() && !server.is_handshaking());
    Ok(())
}
