//! Ends in `classic` that reveal the shared secret of their key exchange, and the messages of their handshake.

use std::sync::Arc;

use axon_tls::{Cipher, hybrid, quic::ALPN};
use rustls::{
    ClientConfig, ServerConfig,
    client::{AlwaysResolvesClientRawPublicKeys, Resumption},
    crypto::{
        CryptoProvider,
        aws_lc_rs::{default_provider, sign::any_supported_type},
    },
    pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    server::AlwaysResolvesServerRawPublicKeys,
    sign::CertifiedKey,
    version::TLS13,
};

use crate::{
    anybody::Anybody,
    groups::{Told, of_rustls},
    quic,
    transcript::{Messages, TappedClient, TappedServer},
};

/// The secrets of an end.
#[derive(Default)]
pub(super) struct Learnt {
    /// The result of the key exchange.
    pub(super) shared: Told,
    /// ClientHello to the client's Finished.
    pub(super) transcript: Messages,
}

/// The credentials of an end, as PEM. The end accepts any peer.
pub(super) struct Own {
    pub(super) key: String,
    /// `None`: a raw public key (RFC 7250) is shown.
    pub(super) certificate: Option<String>,
}

impl Own {
    fn key(&self) -> PrivateKeyDer<'static> {
        PrivateKeyDer::from_pem_slice(self.key.as_bytes()).unwrap()
    }

    fn chain(&self) -> Option<Vec<CertificateDer<'static>>> {
        let pem = self.certificate.as_ref()?;
        Some(vec![CertificateDer::from_pem_slice(pem.as_bytes()).unwrap()])
    }

    fn raw(&self) -> Arc<CertifiedKey> {
        let key = any_supported_type(&self.key()).unwrap();
        let public = CertificateDer::from(key.public_key().unwrap().to_vec());
        Arc::new(CertifiedKey::new(vec![public], key))
    }

    fn anybody(&self) -> Arc<Anybody> {
        let schemes = default_provider().signature_verification_algorithms.supported_schemes();
        Arc::new(Anybody { schemes, raw: self.certificate.is_none() })
    }
}

fn provider(cipher: Cipher, learnt: &Learnt) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider {
        kx_groups: vec![Box::leak(Box::new(of_rustls::Group(learnt.shared.clone())))],
        ..hybrid::provider_with(cipher)
    })
}

pub(super) fn client(cipher: Cipher, own: &Own, learnt: &Learnt) -> quinn::ClientConfig {
    let builder = ClientConfig::builder_with_provider(provider(cipher, learnt))
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(own.anybody());
    let mut config = match own.chain() {
        Some(chain) => builder.with_client_auth_cert(chain, own.key()).unwrap(),
        None => {
            let raw = AlwaysResolvesClientRawPublicKeys::new(own.raw());
            builder.with_client_cert_resolver(Arc::new(raw))
        }
    };
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.resumption = Resumption::disabled();
    config.enable_sni = false;
    let crypto = TappedClient(quic::released::client(config), learnt.transcript.clone());
    quinn::ClientConfig::new(Arc::new(crypto))
}

pub(super) fn server(cipher: Cipher, own: &Own, learnt: &Learnt) -> quinn::ServerConfig {
    let builder = ServerConfig::builder_with_provider(provider(cipher, learnt))
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .with_client_cert_verifier(own.anybody());
    let mut config = match own.chain() {
        Some(chain) => builder.with_single_cert(chain, own.key()).unwrap(),
        None => {
            let raw = AlwaysResolvesServerRawPublicKeys::new(own.raw());
            builder.with_cert_resolver(Arc::new(raw))
        }
    };
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.send_tls13_tickets = 0;
    let crypto = TappedServer(quic::released::server(config), learnt.transcript.clone());
    quinn::ServerConfig::with_crypto(Arc::new(crypto))
}
