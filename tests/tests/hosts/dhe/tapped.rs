//! Ends in `psk_dhe_ke` that reveal the shared secret of their key exchange.

use std::{fmt, sync::Arc};

use axon_tests::schedule::{Mode, Schedule, Terms};
use axon_tls::{Cipher, PskKex, qkd::PskIdentity, quic::ALPN};
use rustls_axon::{
    ClientConfig, ServerConfig,
    crypto::{
        CryptoProvider,
        aws_lc_rs::{cipher_suite, default_provider},
        hash::HashAlgorithm,
    },
    external_psk::{ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk},
};

use crate::{
    groups::{Told, of_axon},
    mode::{Kmes, SAE},
    quic,
};

/// The mode of all of these tests.
pub(super) const MODE: Mode = Mode::Psk(PskKex::PskDheKe);

fn provider(cipher: Cipher, told: &Told) -> Arc<CryptoProvider> {
    let suite = match cipher {
        Cipher::ChaCha20Poly1305 => cipher_suite::TLS13_CHACHA20_POLY1305_SHA256,
        Cipher::Aes256Gcm => cipher_suite::TLS13_AES_256_GCM_SHA384,
    };
    Arc::new(CryptoProvider {
        cipher_suites: vec![suite],
        kx_groups: vec![Box::leak(Box::new(of_axon::Group(told.clone())))],
        ..default_provider()
    })
}

fn external(terms: Terms<'_>) -> Arc<ExternalPsk> {
    let hash = match terms.cipher {
        Cipher::ChaCha20Poly1305 => HashAlgorithm::SHA256,
        Cipher::Aes256Gcm => HashAlgorithm::SHA384,
    };
    let identity = PskIdentity::new(terms.client, terms.key_id).unwrap().to_bytes();
    Arc::new(ExternalPsk::new(identity, Schedule::psk(terms).into(), hash).unwrap())
}

/// Returns the configuration of a client on these terms.
pub(super) fn client(terms: Terms<'_>, told: &Told) -> quinn::ClientConfig {
    let psks = vec![external(terms)];
    let mut config = ClientConfig::builder_with_provider(provider(terms.cipher, told))
        .with_external_psks(psks, PskKeyExchangeMode::PskDheKe)
        .unwrap();
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.enable_sni = false;
    quinn::ClientConfig::new(quic::axon::client(config))
}

/// Returns the configuration of a server, as the SAE of host 1, that knows each key which the SAE of host 0 draws.
pub(super) fn server(cipher: Cipher, kmes: &Arc<Kmes>, told: &Told) -> quinn::ServerConfig {
    let drawn = Arc::new(Drawn(cipher, kmes.clone()));
    let mut config = ServerConfig::builder_with_provider(provider(cipher, told))
        .with_external_psk_resolver(drawn, PskKeyExchangeMode::PskDheKe)
        .unwrap();
    config.alpn_protocols = vec![ALPN.to_vec()];
    quinn::ServerConfig::with_crypto(quic::axon::server(config))
}

/// The keys that were drawn.
struct Drawn(Cipher, Arc<Kmes>);

impl fmt::Debug for Drawn {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Drawn")
    }
}

impl ResolvesExternalPsk for Drawn {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        let [client, server] = SAE;
        let mut psks = self.1.drawn().into_iter().map(|(key_id, key)| {
            let (key, key_id) = (&key[..], &key_id[..]);
            external(Terms { cipher: self.0, mode: MODE, key, key_id, client, server })
        });
        psks.find(|psk| offer.identities().any(|identity| identity == psk.identity()))
    }
}
