//! An ordinary QUIC or HTTP/3 server, with a web certificate, and a client without one: hybrid alone.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use axon_tls::quic::{hybrid_client_with, hybrid_server_with, tls_alert};
use axon_tls::{Cipher, Error, KeyExchange, hybrid};
use common::connect;
use common::hello::{CLIENT_CERTIFICATE_TYPE, ClientHello, EARLY_DATA, SUPPORTED_VERSIONS};
use common::pki::Authority;
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ConnectionError, Endpoint};
use rustls::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls::crypto::{CryptoProvider, SupportedKxGroup};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore, ServerConfig};

const ALPN: &[u8] = b"h3";
const HANDSHAKE_FAILURE: u8 = 40;

fn client_tls(ca: &Authority, provider: CryptoProvider) -> ClientConfig {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(ca.pem.as_bytes()).unwrap()).unwrap();
    let mut tls = ClientConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls
}

fn server_tls(ca: &Authority, provider: CryptoProvider) -> ServerConfig {
    let (certificate, key) = ca.certify(7, "axon");
    let key = PrivateKeyDer::try_from(key.serialize_der()).unwrap();
    let mut tls = ServerConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![certificate.der().clone()], key)
        .unwrap();
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls
}

/// Returns a client with quinn's own TLS on our provider.
fn stock_client(ca: &Authority) -> quinn::ClientConfig {
    let tls = Arc::new(client_tls(ca, hybrid::provider()));
    let crypto = QuicClientConfig::with_initial(tls, hybrid::quic_initial_suite()).unwrap();
    quinn::ClientConfig::new(Arc::new(crypto))
}

fn stock_server(ca: &Authority) -> quinn::ServerConfig {
    let tls = Arc::new(server_tls(ca, hybrid::provider()));
    let crypto = QuicServerConfig::with_initial(tls, hybrid::quic_initial_suite()).unwrap();
    quinn::ServerConfig::with_crypto(Arc::new(crypto))
}

fn with_groups(kx_groups: Vec<&'static dyn SupportedKxGroup>) -> CryptoProvider {
    CryptoProvider { kx_groups, ..default_provider() }
}

#[tokio::test]
async fn server_with_a_certificate_and_client_without_one_connect() {
    let ca = Authority::new();
    let outcome = connect(
        hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap(),
        hybrid_server_with(server_tls(&ca, hybrid::provider())).unwrap(),
    )
    .await;
    let (client, server) = outcome.agreed();
    for end in [&client, &server] {
        assert_eq!(end.key_exchange, KeyExchange::X25519MlKem768);
        assert!(Cipher::ALL.contains(&end.cipher));
        assert_eq!(end.alpn, ALPN);
    }
    assert!(client.peer.is_some(), "the server shows a certificate");
    assert_eq!(server.peer, None, "the client shows none");
}

#[tokio::test]
async fn certificate_of_another_authority_is_refused() {
    let (ca, stranger) = (Authority::new(), Authority::new());
    let outcome = connect(
        hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap(),
        hybrid_server_with(server_tls(&stranger, hybrid::provider())).unwrap(),
    )
    .await;
    assert!(outcome.client.is_err() && outcome.server.is_err());
}

/// Connects and sends a byte each way, for any TLS of either end. Returns the result of each end.
async fn echo(
    client: quinn::ClientConfig,
    server: quinn::ServerConfig,
) -> (Result<(), ConnectionError>, Result<(), ConnectionError>) {
    let localhost = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let server = Endpoint::server(server, localhost).unwrap();
    let addr = server.local_addr().unwrap();
    let serving = tokio::spawn(async move {
        let conn = server.accept().await.unwrap().await?;
        let (mut send, mut receive) = conn.accept_bi().await?;
        let received = receive.read_to_end(10).await.unwrap();
        send.write_all(&received).await.unwrap();
        send.finish().unwrap();
        conn.closed().await;
        Ok(())
    });
    let endpoint = Endpoint::client(localhost).unwrap();
    let dialled = async {
        let conn = endpoint.connect_with(client, addr, "axon").unwrap().await?;
        let (mut send, mut receive) = conn.open_bi().await?;
        send.write_all(b"x").await.unwrap();
        send.finish().unwrap();
        assert_eq!(receive.read_to_end(10).await.unwrap(), b"x");
        conn.close(0_u32.into(), b"done");
        Ok(())
    }
    .await;
    endpoint.wait_idle().await;
    (dialled, serving.await.unwrap())
}

#[tokio::test]
async fn stock_quinn_connects_with_the_initial_suite_beside_the_provider() {
    let ca = Authority::new();
    // what a provider without AES-128 comes to if quinn is left to look for it there
    assert!(QuicClientConfig::try_from(client_tls(&ca, hybrid::provider())).is_err());

    let ours = || hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap();
    let our_server = || hybrid_server_with(server_tls(&ca, hybrid::provider())).unwrap();
    for (client, server) in [
        (stock_client(&ca), stock_server(&ca)),
        (stock_client(&ca), our_server()),
        (ours(), stock_server(&ca)),
    ] {
        let (client, server) = echo(client, server).await;
        client.unwrap();
        server.unwrap();
    }
}

/// quinn's own TLS as released, with all its groups and suites, takes the hybrid group.
#[tokio::test]
async fn stock_quinn_with_a_hybrid_group_among_others_connects() {
    let ca = Authority::new();
    let groups = || with_groups(vec![kx_group::X25519MLKEM768, kx_group::X25519]);
    let client = QuicClientConfig::try_from(client_tls(&ca, groups())).unwrap();
    let ours = hybrid_server_with(server_tls(&ca, hybrid::provider())).unwrap();
    let (client, server) = echo(quinn::ClientConfig::new(Arc::new(client)), ours).await;
    client.unwrap();
    server.unwrap();
}

#[tokio::test]
async fn classical_peers_are_refused() {
    let ca = Authority::new();
    for groups in [vec![kx_group::X25519], vec![kx_group::SECP256R1, kx_group::SECP384R1]] {
        let ours = hybrid_server_with(server_tls(&ca, hybrid::provider())).unwrap();
        for server in [ours, stock_server(&ca)] {
            let tls = client_tls(&ca, with_groups(groups.clone()));
            let classical = Arc::new(QuicClientConfig::try_from(tls).unwrap());
            is_refused(echo(quinn::ClientConfig::new(classical), server).await);
        }

        let classical = || {
            let tls = server_tls(&ca, with_groups(groups.clone()));
            quinn::ServerConfig::with_crypto(Arc::new(QuicServerConfig::try_from(tls).unwrap()))
        };
        let ours = hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap();
        for client in [ours, stock_client(&ca)] {
            is_refused(echo(client, classical()).await);
        }
    }
}

#[track_caller]
fn is_refused((client, server): (Result<(), ConnectionError>, Result<(), ConnectionError>)) {
    assert_eq!(tls_alert(&client.unwrap_err()), Some(HANDSHAKE_FAILURE));
    assert_eq!(tls_alert(&server.unwrap_err()), Some(HANDSHAKE_FAILURE));
}

/// The Initial suite is not offered: the ClientHello has the two 256-bit suites and the one group.
#[test]
fn client_hello_has_one_group_and_no_aes_128() {
    let ca = Authority::new();
    for client in
        [hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap(), stock_client(&ca)]
    {
        let hello = ClientHello::over_quic(client, stock_server(&ca));
        hello.has_one_group();
        let mut suites: Vec<&[u8]> = hello.suites.chunks(2).collect();
        suites.sort_unstable();
        assert_eq!(suites, [[0x13, 0x02], [0x13, 0x03]], "AES-256-GCM and ChaCha20-Poly1305 alone");
        assert_eq!(hello.extensions[&SUPPORTED_VERSIONS], [2, 3, 4], "TLS 1.3 alone");
        hello.lacks(CLIENT_CERTIFICATE_TYPE);
        hello.lacks(EARLY_DATA);
    }
}

#[test]
fn configuration_that_is_not_hybrid_alone_is_refused() {
    let ca = Authority::new();
    let aes_128 = CryptoProvider {
        cipher_suites: vec![
            cipher_suite::TLS13_AES_256_GCM_SHA384,
            cipher_suite::TLS13_AES_128_GCM_SHA256,
        ],
        ..hybrid::provider()
    };
    for provider in [
        default_provider(),
        with_groups(vec![kx_group::X25519MLKEM768]),
        CryptoProvider {
            kx_groups: vec![kx_group::X25519MLKEM768, kx_group::X25519],
            ..hybrid::provider()
        },
        CryptoProvider { kx_groups: vec![kx_group::X25519], ..hybrid::provider() },
        aes_128,
    ] {
        let client = hybrid_client_with(client_tls(&ca, provider.clone()));
        assert!(matches!(client, Err(Error::NotHybrid(_))));
        let server = hybrid_server_with(server_tls(&ca, provider));
        assert!(matches!(server, Err(Error::NotHybrid(_))));
    }

    let (mut client, mut server) =
        (client_tls(&ca, hybrid::provider()), server_tls(&ca, hybrid::provider()));
    client.enable_early_data = true;
    server.max_early_data_size = u32::MAX;
    assert!(matches!(hybrid_client_with(client.clone()), Err(Error::EarlyData)));
    assert!(matches!(hybrid_server_with(server.clone()), Err(Error::EarlyData)));

    client.enable_early_data = false;
    server.max_early_data_size = 0;
    for protocols in [vec![], vec![vec![]], vec![b"h3".to_vec(), vec![b'a'; 256]]] {
        client.alpn_protocols = protocols.clone();
        server.alpn_protocols = protocols;
        assert!(matches!(hybrid_client_with(client.clone()), Err(Error::Alpn)));
        assert!(matches!(hybrid_server_with(server.clone()), Err(Error::Alpn)));
    }
}

/// A second connection on a ticket of the first: the hybrid group all the same.
#[tokio::test]
async fn resumed_connection_is_hybrid_too() {
    let ca = Authority::new();
    let client = hybrid_client_with(client_tls(&ca, hybrid::provider())).unwrap();
    let server = hybrid_server_with(server_tls(&ca, hybrid::provider())).unwrap();
    for _ in 0..2 {
        let (client, server) = connect(client.clone(), server.clone()).await.agreed();
        assert_eq!(client.key_exchange, KeyExchange::X25519MlKem768);
        assert_eq!(server.key_exchange, KeyExchange::X25519MlKem768);
        assert!(client.peer.is_some());
    }
}
