//! The other end of a child that has one end alone: here the shared secret of the key exchange can be taken.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

use axon_tests::schedule::Mode;
use axon_tls::qkd::PskIdentity;
use axon_tls::{Cipher, hybrid};
use quinn::{Connection, Endpoint};
use rustls::version::TLS13;
use rustls_axon::crypto::aws_lc_rs::cipher_suite;
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};
use tokio::runtime::{Builder, Runtime};

use crate::certificates;
use crate::child::{self, CLIENT_SAE, KEY_ID};
use crate::groups::{Told, of_axon, of_rustls};
use crate::quic;
use crate::transcript::{Messages, TappedClient, TappedServer};

const LOCALHOST: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// The terms that both ends of a connection share.
#[derive(Clone, Copy)]
pub(crate) struct Terms<'a> {
    pub(crate) cipher: Cipher,
    pub(crate) mode: Mode,
    pub(crate) psk: &'a [u8],
}

/// The end of this process, which reports its secrets.
pub(crate) struct TappedEnd {
    told: Told,
    messages: Messages,
    runtime: Runtime,
    endpoint: Endpoint,
}

/// The secrets of an end.
pub(crate) struct Learnt {
    /// ClientHello to the client's Finished.
    pub(crate) transcript: Vec<u8>,
    /// The result of the key exchange.
    pub(crate) shared: Vec<u8>,
}

impl TappedEnd {
    /// Creates a client, which [`dial`](Self::dial)s.
    pub(crate) fn client(terms: Terms<'_>) -> Self {
        let told = Told::default();
        let messages = Messages::default();
        let runtime = runtime();
        let crypto = match terms.mode {
            Mode::Hybrid => quic::released::client(client_of_rustls(terms.cipher, &told)),
            Mode::Psk(_) => quic::axon::client(client_of_axon(terms, &told)),
        };
        let crypto = Arc::new(TappedClient(crypto, messages.clone()));
        let endpoint = runtime.block_on(async {
            let mut endpoint = Endpoint::client(LOCALHOST).unwrap();
            endpoint.set_default_client_config(quinn::ClientConfig::new(crypto));
            endpoint
        });
        Self { told, messages, runtime, endpoint }
    }

    /// Creates a server, and returns it with its port.
    pub(crate) fn server(terms: Terms<'_>) -> (Self, u16) {
        let told = Told::default();
        let messages = Messages::default();
        let runtime = runtime();
        let crypto = match terms.mode {
            Mode::Hybrid => quic::released::server(server_of_rustls(terms.cipher, &told)),
            Mode::Psk(_) => quic::axon::server(server_of_axon(terms, &told)),
        };
        let crypto = Arc::new(TappedServer(crypto, messages.clone()));
        let config = quinn::ServerConfig::with_crypto(crypto);
        let endpoint = runtime.block_on(async { Endpoint::server(config, LOCALHOST).unwrap() });
        let port = endpoint.local_addr().unwrap().port();
        (Self { told, messages, runtime, endpoint }, port)
    }

    /// Connects to the child and exchanges data with it.
    pub(crate) fn dial(&self, port: u16) -> (Connection, Learnt) {
        let connection = self.runtime.block_on(async {
            let address = SocketAddr::from((LOCALHOST.ip(), port));
            let connection = self.endpoint.connect(address, "axon").unwrap().await.unwrap();
            child::dial(&connection).await;
            connection
        });
        (connection, self.learnt())
    }

    /// Waits for the child, and exchanges data with it.
    pub(crate) fn accept(&self) -> (Connection, Learnt) {
        let connection = self.runtime.block_on(async {
            let connection = self.endpoint.accept().await.unwrap().await.unwrap();
            child::serve(&connection).await;
            connection
        });
        (connection, self.learnt())
    }

    fn learnt(&self) -> Learnt {
        let shared = std::mem::take(&mut *self.told.lock().unwrap());
        assert_eq!(shared.len(), 64, "of ML-KEM-768 and of X25519");
        Learnt { transcript: self.messages.lock().unwrap().clone(), shared }
    }
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap()
}

fn client_of_axon(terms: Terms<'_>, told: &Told) -> rustls_axon::ClientConfig {
    let mut config =
        rustls_axon::ClientConfig::builder_with_provider(provider_of_axon(terms, told))
            .with_external_psks(vec![external(terms)], PskKeyExchangeMode::PskDheKe)
            .unwrap();
    config.alpn_protocols = vec![axon_tls::quic::ALPN.to_vec()];
    config
}

fn server_of_axon(terms: Terms<'_>, told: &Told) -> rustls_axon::ServerConfig {
    let resolver = Arc::new(One(external(terms)));
    let mut config =
        rustls_axon::ServerConfig::builder_with_provider(provider_of_axon(terms, told))
            .with_external_psk_resolver(resolver, PskKeyExchangeMode::PskDheKe)
            .unwrap();
    config.alpn_protocols = vec![axon_tls::quic::ALPN.to_vec()];
    config
}

fn provider_of_axon(terms: Terms<'_>, told: &Told) -> Arc<rustls_axon::crypto::CryptoProvider> {
    let suite = match terms.cipher {
        Cipher::ChaCha20Poly1305 => cipher_suite::TLS13_CHACHA20_POLY1305_SHA256,
        Cipher::Aes256Gcm => cipher_suite::TLS13_AES_256_GCM_SHA384,
    };
    Arc::new(rustls_axon::crypto::CryptoProvider {
        cipher_suites: vec![suite],
        kx_groups: vec![Box::leak(Box::new(of_axon::Group(told.clone())))],
        ..rustls_axon::crypto::aws_lc_rs::default_provider()
    })
}

fn external(terms: Terms<'_>) -> Arc<ExternalPsk> {
    let identity = PskIdentity::new(CLIENT_SAE, KEY_ID).unwrap().to_bytes();
    let hash = match terms.cipher {
        Cipher::ChaCha20Poly1305 => HashAlgorithm::SHA256,
        Cipher::Aes256Gcm => HashAlgorithm::SHA384,
    };
    Arc::new(ExternalPsk::new(identity, terms.psk.to_vec().into(), hash).unwrap())
}

/// A server's only key.
struct One(Arc<ExternalPsk>);

impl fmt::Debug for One {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("One")
    }
}

impl ResolvesExternalPsk for One {
    fn resolve(&self, _: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        Some(self.0.clone())
    }
}

fn provider_of_rustls(cipher: Cipher, told: &Told) -> Arc<rustls::crypto::CryptoProvider> {
    Arc::new(rustls::crypto::CryptoProvider {
        kx_groups: vec![Box::leak(Box::new(of_rustls::Group(told.clone())))],
        ..hybrid::provider_with(cipher)
    })
}

fn client_of_rustls(cipher: Cipher, told: &Told) -> rustls::ClientConfig {
    let builder = rustls::ClientConfig::builder_with_provider(provider_of_rustls(cipher, told));
    certificates::client(builder.with_protocol_versions(&[&TLS13]).unwrap())
}

fn server_of_rustls(cipher: Cipher, told: &Told) -> rustls::ServerConfig {
    let builder = rustls::ServerConfig::builder_with_provider(provider_of_rustls(cipher, told));
    certificates::server(builder.with_protocol_versions(&[&TLS13]).unwrap())
}
