//! A server with a self-made certificate, and a client that accepts any: the authentication of a peer has no part in
//! the secrets.

use std::sync::Arc;

use axon_tls::quic::ALPN;
use rustls::pki_types::PrivateKeyDer;
use rustls::{ClientConfig, ConfigBuilder, ServerConfig, SignatureScheme, WantsVerifier};

use crate::anybody::Anybody;

pub(crate) fn server(builder: ConfigBuilder<ServerConfig, WantsVerifier>) -> ServerConfig {
    let own = rcgen::generate_simple_self_signed(["axon".to_owned()]).unwrap();
    let key = PrivateKeyDer::Pkcs8(own.signing_key.serialize_der().into());
    let chain = vec![own.cert.der().clone()];
    let mut config = builder.with_no_client_auth().with_single_cert(chain, key).unwrap();
    config.alpn_protocols = vec![ALPN.to_vec()];
    config.send_tls13_tickets = 0;
    config
}

pub(crate) fn client(builder: ConfigBuilder<ClientConfig, WantsVerifier>) -> ClientConfig {
    let schemes = vec![SignatureScheme::ECDSA_NISTP256_SHA256];
    let any = Arc::new(Anybody { schemes, raw: false });
    let mut config =
        builder.dangerous().with_custom_certificate_verifier(any).with_no_client_auth();
    config.alpn_protocols = vec![ALPN.to_vec()];
    config
}
