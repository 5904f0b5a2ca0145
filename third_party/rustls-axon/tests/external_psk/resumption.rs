//! External and resumption PSKs are never taken for each other.

use std::sync::Arc;

use rustls_axon::client::danger::{
    HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier,
};
use rustls_axon::client::Resumption;
use rustls_axon::crypto::aws_lc_rs::{kx_group, sign::any_ecdsa_type};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{ExternalPsk, PskKeyExchangeMode};
use rustls_axon::pki_types::{CertificateDer, PrivatePkcs8KeyDer, ServerName, UnixTime};
use rustls_axon::server::ServerSessionMemoryCache;
use rustls_axon::server::{ClientHello as StockClientHello, ResolvesServerCert};
use rustls_axon::sign::CertifiedKey;
use rustls_axon::{
    ClientConfig, ClientConnection, DigitallySignedStruct, Error, HandshakeKind, PeerIncompatible,
    PeerMisbehaved, ServerConfig, ServerConnection, SignatureScheme,
};
use zeroize::Zeroizing;

use crate::common::*;
use crate::peer::{
    list16, plaintext, records, resumption_psk, ClientHello, Offer, Peer, Role, HANDSHAKE,
};
use crate::server_hello::parts;

/// A certificate that nobody here looks at, with a key that signs.
#[derive(Debug)]
pub(crate) struct Unchecked(Arc<CertifiedKey>);

impl Unchecked {
    pub(crate) fn new() -> Arc<Self> {
        use aws_lc_rs::rand::SystemRandom;
        use aws_lc_rs::signature::{EcdsaKeyPair, ECDSA_P256_SHA256_ASN1_SIGNING};

        let key =
            EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_ASN1_SIGNING, &SystemRandom::new())
                .unwrap();
        let key = any_ecdsa_type(&PrivatePkcs8KeyDer::from(key.as_ref().to_vec()).into()).unwrap();
        let certificate = CertificateDer::from(vec![0x30, 0]);
        Arc::new(Self(Arc::new(CertifiedKey::new(vec![certificate], key))))
    }
}

impl ResolvesServerCert for Unchecked {
    fn resolve(&self, _: StockClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.0.clone())
    }
}

impl ServerCertVerifier for Unchecked {
    fn verify_server_cert(
        &self,
        _: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ECDSA_NISTP256_SHA256]
    }
}

/// A server as rustls has it, with certificates and tickets.
pub(crate) fn stock_server() -> Arc<ServerConfig> {
    let mut config = ServerConfig::builder_with_provider(provider(&[SHA256], &[kx_group::X25519]))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Unchecked::new());
    config.session_storage = ServerSessionMemoryCache::new(32);
    Arc::new(config)
}

pub(crate) fn stock_client() -> ClientConfig {
    ClientConfig::builder_with_provider(provider(&[SHA256], &[kx_group::X25519]))
        .with_safe_default_protocol_versions()
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Unchecked::new())
        .with_no_client_auth()
}

fn external_server(psks: Vec<Arc<ExternalPsk>>) -> ServerConfig {
    let mode = PskKeyExchangeMode::PskDheKe;
    server_config_over(&[SHA256], &[kx_group::X25519], Known::new(psks), mode)
}

/// A ClientHello that any server could take: it has what certificates need, too.
fn client_hello(offers: Vec<Offer>, share: &[u8]) -> ClientHello {
    ClientHello::new(offers).in_psk_dhe_ke(29, share).with(13, &list16(&[4, 3]))
}

/// The peer connects as a client, and gets through. Gives its end, past both Finished.
fn connect(server: &mut ServerConnection, offers: Vec<Offer>) -> Result<(Peer, Vec<u8>), Error> {
    let psk = offers.first().map(|offer| offer.secret.clone());
    let ours = kx_group::X25519.start().unwrap();
    let hello = client_hello(offers, ours.pub_key()).encode();
    feed(server, &records(HANDSHAKE, &hello))?;
    let flight = written(server);
    let server_hello = plaintext(&flight);
    let head = [0, 51, 0, 36, 0, 29, 0, 32];
    let at = server_hello.windows(8).position(|window| window == head).unwrap() + 8;
    let shared = ours.complete(&server_hello[at..at + 32]).unwrap();
    let transcript = [&hello[..], &server_hello].concat();
    let mut client =
        Peer::new(Role::Client, psk.as_deref(), Some(shared.secret_bytes()), transcript);
    let before = client.expect_finished(&flight);
    feed(server, &client.finish())?;
    assert!(!server.is_handshaking());
    Ok((client, before))
}

/// A ticket of a stock server, and the PSK it stands for.
fn ticket_of(config: &Arc<ServerConfig>) -> Offer {
    let mut server = ServerConnection::new(config.clone()).unwrap();
    let (mut client, _) = connect(&mut server, vec![]).unwrap();
    let (_, message) = client.read.open_all(&written(&mut server)).swap_remove(0);
    // header 4, lifetime 4, age_add 4
    let (nonce, rest) = message[13..].split_at(usize::from(message[12]));
    let len = usize::from(u16::from_be_bytes([rest[0], rest[1]]));
    let psk = resumption_psk(&client.resumption_master(), nonce);
    Offer { label: "res binder", ..Offer::new(&rest[2..2 + len], &psk) }
}

fn refused_binder(mut server: ServerConnection, offer: Offer) {
    let label = offer.label;
    let error = connect(&mut server, vec![offer]).err();
    assert_eq!(error, Some(PeerMisbehaved::IncorrectBinder.into()), "{label}");
    assert_eq!(written(&mut server).last(), Some(&51), "{label}");
}

#[test]
fn a_ticket_is_not_accepted_under_an_external_binder() {
    let config = stock_server();
    for label in ["ext binder", "imp binder"] {
        let server = ServerConnection::new(config.clone()).unwrap();
        refused_binder(server, Offer { label, ..ticket_of(&config) });
    }

    // the same ticket and secret are good, under the right label
    let mut server = ServerConnection::new(config.clone()).unwrap();
    connect(&mut server, vec![ticket_of(&config)]).unwrap();
    assert_eq!(server.handshake_kind(), Some(HandshakeKind::Resumed));
    assert!(server.external_psk().is_none());
}

#[test]
fn an_external_psk_is_not_accepted_under_a_resumption_binder() {
    // a PSK that has the identity and the secret of a ticket
    let stock = stock_server();
    let ticket = ticket_of(&stock);
    let known = || {
        let secret = Zeroizing::new(ticket.secret.clone());
        let psk = ExternalPsk::new(&ticket.identity[..], secret, HashAlgorithm::SHA256).unwrap();
        ServerConnection::new(Arc::new(external_server(vec![Arc::new(psk)]))).unwrap()
    };
    for label in ["res binder", "imp binder"] {
        refused_binder(known(), Offer { label, ..ticket.clone() });
    }

    let mut server = known();
    let offer = Offer { label: "ext binder", ..ticket.clone() };
    connect(&mut server, vec![offer]).unwrap();
    assert_eq!(server.external_psk().unwrap().identity(), ticket.identity);
    assert_eq!(server.handshake_kind(), Some(HandshakeKind::Full));
}

/// Even where a server's storage has the session of the ticket.
#[test]
fn a_server_with_external_psks_looks_up_no_tickets() {
    let stock = stock_server();
    let mut config = external_server(vec![psk("a", 1, SHA256)]);
    config.session_storage = stock.session_storage.clone();
    config.ticketer = stock.ticketer.clone();
    let config = Arc::new(config);
    let ticket = ticket_of(&stock);

    let mut server = ServerConnection::new(config.clone()).unwrap();
    assert!(connect(&mut server, vec![ticket.clone()]).is_err());
    assert_eq!(written(&mut server).last(), Some(&115));

    // not even beside a PSK that it knows
    let mut server = ServerConnection::new(config).unwrap();
    connect(&mut server, vec![Offer::new("a", &[1; 32]), ticket.clone()]).unwrap();
    assert_eq!(server.handshake_kind(), Some(HandshakeKind::Full));

    // and the ticket is still there
    let mut server = ServerConnection::new(stock).unwrap();
    connect(&mut server, vec![ticket]).unwrap();
    assert_eq!(server.handshake_kind(), Some(HandshakeKind::Resumed));
}

/// One store for a config that resumes and for one with external PSKs.
#[test]
fn a_client_with_external_psks_takes_no_tickets() {
    let mut stock = ServerConfig::clone(&stock_server());
    // one, so that it is missed if it is taken
    stock.send_tls13_tickets = 1;
    stock.max_early_data_size = 1_000;
    let stock = Arc::new(stock);
    let store = Resumption::in_memory_sessions(8);
    let verifier = Unchecked::new();
    let mut resuming = stock_client();
    resuming.dangerous().set_certificate_verifier(verifier.clone());
    resuming.resumption = store.clone();
    resuming.enable_early_data = true;
    let resuming = Arc::new(resuming);
    let connect_stock = || {
        let name = "example.com".try_into().unwrap();
        let mut client = ClientConnection::new(resuming.clone(), name).unwrap();
        let early = client.early_data().is_some();
        let mut server = ServerConnection::new(stock.clone()).unwrap();
        handshake(&mut client, &mut server).unwrap();
        (client.handshake_kind(), early)
    };
    assert_eq!(connect_stock(), (Some(HandshakeKind::Full), false));
    assert_eq!(connect_stock(), (Some(HandshakeKind::Resumed), true));

    let mode = PskKeyExchangeMode::PskDheKe;
    let psks = vec![psk("a", 1, SHA256)];
    let groups = [kx_group::SECP256R1, kx_group::X25519];
    let mut config = client_config_over(&[SHA256], &groups, psks, mode);
    config.resumption = store;
    config.enable_early_data = true;
    // rustls resumes under the same verifier and certificates alone
    config.dangerous().set_certificate_verifier(verifier);
    config.client_auth_cert_resolver = resuming.client_auth_cert_resolver.clone();
    let mut client = client(config);
    assert!(client.early_data().is_none());
    let mut server = ServerConnection::new(stock.clone()).unwrap();
    let hello = written(&mut client);
    let (_, extensions) = parts(&plaintext(&hello));
    assert!(extensions.iter().all(|(kind, _)| *kind != 42), "early_data");
    // one identity, `a`, of age 0, and one binder at the end
    let tail = [&[0, 41, 0, 44, 0, 7, 0, 1, b'a', 0, 0, 0, 0, 0, 33, 32][..]].concat();
    let end = hello.len() - 32;
    assert_eq!(&hello[end - tail.len()..end], tail);
    // and what the other config learned about groups is not asked for
    let first_share = [0, 51, 0, 71, 0, 69, 0, 23];
    assert!(hello.windows(8).any(|window| window == first_share), "the first group configured");
    // which a server with certificates cannot take: there is no `signature_algorithms` in it
    let error = feed(&mut server, &hello).unwrap_err();
    assert_eq!(error, PeerIncompatible::SignatureAlgorithmsExtensionRequired.into());
    assert_eq!(written(&mut server).last(), Some(&40));

    let again = (Some(HandshakeKind::Resumed), true);
    assert_eq!(connect_stock(), again, "nothing was taken or removed");
}
