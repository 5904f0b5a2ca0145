//! Tests whole QUIC connections in one process: refused ones, and working ones.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::sync::Arc;
use std::sync::atomic::Ordering;

use axon_tls::identity::{Auth, CaMaterial, SigningKey, SpkiDigest, Trust, TrustFile};
use axon_tls::qkd::{Psk, PskIdentity, PskResolver, derive_psk};
use axon_tls::quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server};
use axon_tls::{Cipher, KeyExchange, PskKex};
use common::pki::Authority;
use common::stock;
use common::{CLIENT_SAE, KEY_ID, OneKey, SERVER_SAE, connect, psk};
use quinn::crypto::rustls::QuicClientConfig;
use rustls::crypto::aws_lc_rs::{default_provider, kx_group};
use rustls::crypto::{CryptoProvider, SupportedKxGroup};

const HANDSHAKE_FAILURE: u8 = 40;
const DECRYPT_ERROR: u8 = 51;
const MISSING_EXTENSION: u8 = 109;
const UNKNOWN_PSK_IDENTITY: u8 = 115;
const NO_APPLICATION_PROTOCOL: u8 = 120;

fn unauthenticated() -> Auth {
    Auth::None(SigningKey::generate().unwrap())
}

fn pinned(key: &SigningKey, peer: SpkiDigest) -> Auth {
    let trust = TrustFile::parse(&format!("peer {peer}")).unwrap();
    Auth::Pinned { key: key.clone(), trust: Trust::new(trust) }
}

#[tokio::test]
async fn wrong_psk_is_refused() {
    for kex in PskKex::ALL {
        let cipher = Cipher::default();
        let outcome = connect(
            qkd_client(psk(1, cipher), kex, ALPN).unwrap(),
            qkd_server(OneKey::new(psk(2, cipher)), cipher, kex, ALPN).unwrap(),
        )
        .await;
        assert_eq!(outcome.alert(), DECRYPT_ERROR);
    }
}

#[tokio::test]
async fn unknown_identity_is_refused() {
    let cipher = Cipher::default();
    let outcome = connect(
        qkd_client(psk(1, cipher), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(OneKey::none(), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), UNKNOWN_PSK_IDENTITY);
}

#[tokio::test]
async fn identity_of_another_key_is_refused() {
    let cipher = Cipher::default();
    let other = derive_psk(&[1; 32], "another", CLIENT_SAE, SERVER_SAE, cipher).unwrap();
    let outcome = connect(
        qkd_client(Arc::new(other), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(OneKey::new(psk(1, cipher)), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), UNKNOWN_PSK_IDENTITY);
}

/// Selfie, RFC 9257 section 4.1: a client whose ClientHello comes back to the server of its own
/// host. That server holds the same QKD key, and derives from it as any server does: the claimed
/// name in the role of the client, its own in the role of the server.
#[tokio::test]
async fn reflected_handshake_is_refused() {
    #[derive(Debug)]
    struct HostOfTheClient;
    impl PskResolver for HostOfTheClient {
        fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
            let claimed = PskIdentity::parse(identity).unwrap();
            let own_sae = CLIENT_SAE;
            derive_psk(&[1; 32], claimed.key_id(), claimed.client_sae(), own_sae, Cipher::default())
                .ok()
                .map(Arc::new)
        }
    }

    let outcome = connect(
        qkd_client(psk(1, Cipher::default()), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(Arc::new(HostOfTheClient), Cipher::default(), PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), UNKNOWN_PSK_IDENTITY);
}

/// The server's name is in the derivation: the same key at another host is another PSK.
#[tokio::test]
async fn handshake_redirected_to_another_host_is_refused() {
    let cipher = Cipher::default();
    let at_another_host = derive_psk(&[1; 32], KEY_ID, CLIENT_SAE, "sae-other", cipher).unwrap();
    let outcome = connect(
        qkd_client(psk(1, cipher), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(OneKey::new(Arc::new(at_another_host)), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), DECRYPT_ERROR);
}

#[tokio::test]
async fn modes_do_not_mix() {
    let cipher = Cipher::default();
    let outcome = connect(
        qkd_client(psk(1, cipher), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(OneKey::new(psk(1, cipher)), cipher, PskKex::PskDheKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), HANDSHAKE_FAILURE);

    let outcome = connect(
        qkd_client(psk(1, cipher), PskKex::PskDheKe, ALPN).unwrap(),
        qkd_server(OneKey::new(psk(1, cipher)), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), HANDSHAKE_FAILURE);

    let classic_client = connect(
        hybrid_client(&unauthenticated(), cipher, ALPN).unwrap(),
        qkd_server(OneKey::new(psk(1, cipher)), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(classic_client.alert(), MISSING_EXTENSION);

    for kex in PskKex::ALL {
        let classic_server = connect(
            qkd_client(psk(1, cipher), kex, ALPN).unwrap(),
            hybrid_server(&unauthenticated(), cipher, ALPN).unwrap(),
        )
        .await;
        assert_eq!(classic_server.alert(), HANDSHAKE_FAILURE);
    }
}

/// Returns a client on quinn's own TLS with classical groups only.
fn classical_client(groups: Vec<&'static dyn SupportedKxGroup>) -> quinn::ClientConfig {
    let provider = CryptoProvider { kx_groups: groups, ..default_provider() };
    let mut tls = rustls::ClientConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(rustls::RootCertStore::empty())
        .with_no_client_auth();
    tls.alpn_protocols = vec![ALPN.to_vec()];
    quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()))
}

#[tokio::test]
async fn classical_groups_are_refused() {
    for groups in [
        vec![kx_group::X25519],
        vec![kx_group::SECP256R1],
        vec![kx_group::X25519, kx_group::SECP256R1, kx_group::SECP384R1],
    ] {
        let cipher = Cipher::default();
        let hybrid = hybrid_server(&unauthenticated(), cipher, ALPN).unwrap();
        let outcome = connect(classical_client(groups.clone()), hybrid).await;
        assert_eq!(outcome.alert(), HANDSHAKE_FAILURE);
        let reason = outcome.server.unwrap_err().to_string();
        assert!(reason.contains("NoKxGroupsInCommon"), "{reason}");

        for kex in PskKex::ALL {
            let qkd = qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
            let outcome = connect(classical_client(groups.clone()), qkd).await;
            assert_eq!(outcome.alert(), MISSING_EXTENSION);
        }
    }
}

#[tokio::test]
async fn ciphers_do_not_mix() {
    let [one, other] = Cipher::ALL;
    let resolver = OneKey::new(psk(1, other));
    let outcome = connect(
        qkd_client(psk(1, one), PskKex::PskKe, ALPN).unwrap(),
        qkd_server(resolver.clone(), other, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), HANDSHAKE_FAILURE);
    assert_eq!(resolver.asked.load(Ordering::Relaxed), 0, "no look-up for what cannot work");

    let outcome = connect(
        hybrid_client(&unauthenticated(), one, ALPN).unwrap(),
        hybrid_server(&unauthenticated(), other, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), HANDSHAKE_FAILURE);
}

#[tokio::test]
async fn another_alpn_is_refused() {
    let cipher = Cipher::default();
    let outcome = connect(
        qkd_client(psk(1, cipher), PskKex::PskKe, b"h3").unwrap(),
        qkd_server(OneKey::new(psk(1, cipher)), cipher, PskKex::PskKe, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), NO_APPLICATION_PROTOCOL);

    let outcome = connect(
        hybrid_client(&unauthenticated(), cipher, b"h3").unwrap(),
        hybrid_server(&unauthenticated(), cipher, ALPN).unwrap(),
    )
    .await;
    assert_eq!(outcome.alert(), NO_APPLICATION_PROTOCOL);

    assert!(qkd_client(psk(1, cipher), PskKex::PskKe, b"").is_err(), "ALPN is mandatory");
    assert!(hybrid_server(&unauthenticated(), cipher, &[b'a'; 256]).is_err());
}

/// RFC 9001 section 8.1: a client without ALPN is refused like one with another ALPN.
#[tokio::test]
async fn no_alpn_is_refused() {
    let ca = Authority::new();
    let auth = ca.member(1, "axon", &ca, None);
    let ours = hybrid_server(&auth, Cipher::default(), ALPN).unwrap();
    let outcome = connect(stock::client(&ca, b"", false), ours).await;
    assert_eq!(outcome.alert(), NO_APPLICATION_PROTOCOL);
}

#[tokio::test]
async fn keys_that_are_not_pinned_are_refused() {
    let (ours, theirs, stranger) = (
        SigningKey::generate().unwrap(),
        SigningKey::generate().unwrap(),
        SigningKey::generate().unwrap(),
    );
    let cipher = Cipher::default();
    let server = || hybrid_server(&pinned(&theirs, ours.spki_digest()), cipher, ALPN).unwrap();

    let imposter = hybrid_client(&pinned(&stranger, theirs.spki_digest()), cipher, ALPN).unwrap();
    // the client's own part is done when the server gets to refuse its key
    assert!(connect(imposter, server()).await.server.is_err());

    let misled = hybrid_client(&pinned(&ours, stranger.spki_digest()), cipher, ALPN).unwrap();
    let outcome = connect(misled, server()).await;
    assert!(outcome.client.is_err() && outcome.server.is_err());
}

#[tokio::test]
async fn certificates_of_the_given_roots_alone_are_accepted() {
    let (ca, stranger) = (Authority::new(), Authority::new());
    let crl = ca.revoke(666);
    let server = ca.member(1, "axon", &ca, Some(&crl));
    let works = |client: Auth, server: Auth| async move {
        let cipher = Cipher::default();
        let outcome = connect(
            hybrid_client(&client, cipher, ALPN).unwrap(),
            hybrid_server(&server, cipher, ALPN).unwrap(),
        )
        .await;
        outcome.client.is_ok() && outcome.server.is_ok()
    };

    let another_root = stranger.member(2, "client", &ca, None);
    assert!(!works(another_root, server.clone()).await);
    let revoked = ca.member(666, "client", &ca, None);
    assert!(!works(revoked, server.clone()).await);
    let key_alone = unauthenticated();
    assert!(!works(key_alone, server.clone()).await);
    let client = ca.member(2, "client", &ca, None);
    let another_name = ca.member(3, "other", &ca, None);
    assert!(!works(client.clone(), another_name).await);

    assert!(works(client, server).await);
    assert!(CaMaterial::from_pem("", "", "", None).is_err());
    assert!(CaMaterial::from_pem(&ca.pem, &ca.pem, "", Some("")).is_err());
}

#[tokio::test]
async fn qkd_works() {
    for cipher in Cipher::ALL {
        for (kex, key_exchange) in
            [(PskKex::PskKe, KeyExchange::PskKe), (PskKex::PskDheKe, KeyExchange::PskDheKe)]
        {
            let outcome = connect(
                qkd_client(psk(1, cipher), kex, ALPN).unwrap(),
                qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap(),
            )
            .await;
            let (client, server) = outcome.agreed();
            assert_eq!(client, server);
            assert_eq!(client.key_exchange, key_exchange);
            assert_eq!(client.cipher, cipher);
            assert_eq!(client.psk_identity.as_deref(), Some(psk(1, cipher).identity()));
            assert_eq!(client.peer, None);
            assert_eq!(client.alpn, ALPN);
        }
    }
}

#[tokio::test]
async fn hybrid_works() {
    let (ours, theirs) = (SigningKey::generate().unwrap(), SigningKey::generate().unwrap());
    for cipher in Cipher::ALL {
        for (client, server) in [
            (Auth::None(ours.clone()), Auth::None(theirs.clone())),
            (pinned(&ours, theirs.spki_digest()), pinned(&theirs, ours.spki_digest())),
        ] {
            let outcome = connect(
                hybrid_client(&client, cipher, ALPN).unwrap(),
                hybrid_server(&server, cipher, ALPN).unwrap(),
            )
            .await;
            let (client, server) = outcome.agreed();
            assert_eq!(client.peer, Some(theirs.spki_digest()));
            assert_eq!(server.peer, Some(ours.spki_digest()));
            for end in [client, server] {
                assert_eq!(end.key_exchange, KeyExchange::X25519MlKem768);
                assert_eq!(end.cipher, cipher);
                assert_eq!(end.psk_identity, None);
                assert_eq!(end.alpn, ALPN);
            }
        }
    }
}
