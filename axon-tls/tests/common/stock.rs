//! quinn's own TLS on rustls as released, with X25519MLKEM768: a stranger that gets as far as strangers
//! can.

use std::sync::Arc;

use axon_tls::hybrid;
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::crypto::aws_lc_rs::cipher_suite::TLS13_AES_128_GCM_SHA256;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore, ServerConfig};

use super::pki::Authority;

fn roots(ca: &Authority) -> Arc<RootCertStore> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(ca.pem.as_bytes()).unwrap()).unwrap();
    Arc::new(roots)
}

fn shown(ca: &Authority) -> (Vec<CertificateDer<'static>>, PrivateKeyDer<'static>) {
    let (certificate, key) = ca.certify(77, "axon");
    (vec![certificate.der().clone()], PrivateKeyDer::try_from(key.serialize_der()).unwrap())
}

fn protocols(alpn: &[u8]) -> Vec<Vec<u8>> {
    if alpn.is_empty() { vec![] } else { vec![alpn.to_vec()] }
}

/// Creates a client with a certificate of `ca`. With `early_data` it sends some wherever a ticket allows it.
pub(crate) fn client(ca: &Authority, alpn: &[u8], early_data: bool) -> quinn::ClientConfig {
    let (chain, key) = shown(ca);
    let mut tls = ClientConfig::builder_with_provider(Arc::new(hybrid::provider()))
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .with_root_certificates(roots(ca))
        .with_client_auth_cert(chain, key)
        .unwrap();
    tls.alpn_protocols = protocols(alpn);
    tls.enable_early_data = early_data;
    let initial = TLS13_AES_128_GCM_SHA256.tls13().and_then(|suite| suite.quic_suite()).unwrap();
    let crypto = QuicClientConfig::with_initial(Arc::new(tls), initial).unwrap();
    quinn::ClientConfig::new(Arc::new(crypto))
}

/// Creates a server with a certificate of `ca`. With `early_data` its tickets allow it.
pub(crate) fn server(ca: &Authority, alpn: &[u8], early_data: bool) -> quinn::ServerConfig {
    let (chain, key) = shown(ca);
    let provider = Arc::new(hybrid::provider());
    let clients = WebPkiClientVerifier::builder_with_provider(roots(ca), Arc::clone(&provider));
    let mut tls = ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .with_client_cert_verifier(clients.build().unwrap())
        .with_single_cert(chain, key)
        .unwrap();
    tls.alpn_protocols = protocols(alpn);
    if early_data {
        tls.max_early_data_size = u32::MAX;
    }
    let initial = TLS13_AES_128_GCM_SHA256.tls13().and_then(|suite| suite.quic_suite()).unwrap();
    let crypto = QuicServerConfig::with_initial(Arc::new(tls), initial).unwrap();
    quinn::ServerConfig::with_crypto(Arc::new(crypto))
}
