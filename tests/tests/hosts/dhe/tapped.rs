//! A client in `psk_dhe_ke` that tells the shared secret of its key exchange.

use std::sync::{Arc, Mutex};

use axon_tests::schedule::{Schedule, Terms};
use axon_tls::{Cipher, qkd::PskIdentity, quic::ALPN};
use rustls_axon::{
    ClientConfig, Error, NamedGroup,
    crypto::{
        ActiveKeyExchange, CryptoProvider, SharedSecret, SupportedKxGroup,
        aws_lc_rs::{cipher_suite, default_provider, kx_group::X25519MLKEM768},
        hash::HashAlgorithm,
    },
    external_psk::{ExternalPsk, PskKeyExchangeMode},
};

use crate::quic;

/// What the last key exchange gave.
pub(super) type Told = Arc<Mutex<Vec<u8>>>;

/// A group that tells the shared secret.
#[derive(Debug)]
struct Group(Told);

struct Active(Box<dyn ActiveKeyExchange>, Told);

impl SupportedKxGroup for Group {
    fn start(&self) -> Result<Box<dyn ActiveKeyExchange>, Error> {
        Ok(Box::new(Active(X25519MLKEM768.start()?, self.0.clone())))
    }

    fn name(&self) -> NamedGroup {
        X25519MLKEM768.name()
    }
}

impl ActiveKeyExchange for Active {
    fn complete(self: Box<Self>, peer: &[u8]) -> Result<SharedSecret, Error> {
        let secret = self.0.complete(peer)?;
        *self.1.lock().unwrap() = secret.secret_bytes().to_vec();
        Ok(secret)
    }

    fn pub_key(&self) -> &[u8] {
        self.0.pub_key()
    }

    fn group(&self) -> NamedGroup {
        self.0.group()
    }
}

/// The configuration of a client on these terms.
pub(super) fn client(terms: Terms<'_>, told: &Told) -> quinn::ClientConfig {
    let (suite, hash) = match terms.cipher {
        Cipher::ChaCha20Poly1305 => {
            (cipher_suite::TLS13_CHACHA20_POLY1305_SHA256, HashAlgorithm::SHA256)
        }
        Cipher::Aes256Gcm => (cipher_suite::TLS13_AES_256_GCM_SHA384, HashAlgorithm::SHA384),
    };
    let provider = CryptoProvider {
        cipher_suites: vec![suite],
        kx_groups: vec![Box::leak(Box::new(Group(told.clone())))],
        ..default_provider()
    };
    let identity = PskIdentity::new(terms.client, terms.key_id).unwrap().to_bytes();
    let psk = ExternalPsk::new(identity, Schedule::psk(terms).into(), hash).unwrap();
    let mut config = ClientConfig::builder_with_provider(Arc::new(provider))
        .with_external_psks(vec![Arc::new(psk)], PskKeyExchangeMode::PskDheKe)
        .unwrap();
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.enable_sni = false;
    quinn::ClientConfig::new(quic::axon::client(config))
}
