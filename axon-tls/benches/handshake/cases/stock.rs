//! rustls as released, with ordinary certificates: ECDSA on P-256, one root, leaves below it.

use std::sync::Arc;

use axon_tls::Cipher;
use rcgen::{
    BasicConstraints, Certificate, CertificateParams, IsCa, Issuer, KeyPair, KeyUsagePurpose,
};
use rustls::client::Resumption;
use rustls::crypto::CryptoProvider;
use rustls::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls::pki_types::PrivateKeyDer;
use rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore, ServerConfig};

use super::ALPN;

/// A root, and a certificate with its key for each end.
pub(super) struct Pki {
    pub(super) root: Certificate,
    pub(super) client: (Certificate, KeyPair),
    pub(super) server: (Certificate, KeyPair),
}

impl Pki {
    pub(super) fn new() -> Self {
        let mut params = CertificateParams::new([]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
        let key = KeyPair::generate().unwrap();
        let root = params.self_signed(&key).unwrap();
        let issuer = Issuer::new(params, key);
        let leaf = |name: &str| {
            let key = KeyPair::generate().unwrap();
            let params = CertificateParams::new([name.to_owned()]).unwrap();
            (params.signed_by(&key, &issuer).unwrap(), key)
        };
        Self { root, client: leaf("client"), server: leaf("axon") }
    }

    /// Both ends with X25519 and one suite; the client has a certificate too if `client_auth`.
    pub(super) fn configs(
        &self,
        cipher: Cipher,
        client_auth: bool,
    ) -> (Arc<ClientConfig>, Arc<ServerConfig>) {
        let provider = Arc::new(CryptoProvider {
            kx_groups: vec![kx_group::X25519],
            cipher_suites: vec![match cipher {
                Cipher::ChaCha20Poly1305 => cipher_suite::TLS13_CHACHA20_POLY1305_SHA256,
                Cipher::Aes256Gcm => cipher_suite::TLS13_AES_256_GCM_SHA384,
            }],
            ..default_provider()
        });
        let mut roots = RootCertStore::empty();
        roots.add(self.root.der().clone()).unwrap();
        let roots = Arc::new(roots);
        let shown = |(cert, key): &(Certificate, KeyPair)| {
            let key = PrivateKeyDer::try_from(key.serialize_der()).unwrap();
            (vec![cert.der().clone()], key)
        };

        let builder = ClientConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[&TLS13])
            .unwrap()
            .with_root_certificates(Arc::clone(&roots));
        let mut client = if client_auth {
            let (chain, key) = shown(&self.client);
            builder.with_client_auth_cert(chain, key).unwrap()
        } else {
            builder.with_no_client_auth()
        };
        client.resumption = Resumption::disabled();
        client.alpn_protocols = vec![ALPN.to_vec()];

        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[&TLS13])
            .unwrap();
        let builder = if client_auth {
            let verifier = WebPkiClientVerifier::builder_with_provider(roots, provider);
            builder.with_client_cert_verifier(verifier.build().unwrap())
        } else {
            builder.with_no_client_auth()
        };
        let (chain, key) = shown(&self.server);
        let mut server = builder.with_single_cert(chain, key).unwrap();
        server.session_storage = Arc::new(NoServerSessionStorage {});
        server.send_tls13_tickets = 0;
        server.alpn_protocols = vec![ALPN.to_vec()];
        (Arc::new(client), Arc::new(server))
    }
}
