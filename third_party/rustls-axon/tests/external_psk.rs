//! Handshakes on external PSKs over a byte stream: hostile peers first, then those that work.

use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;

use rustls_axon::client::Resumption;
use rustls_axon::crypto::aws_lc_rs::{cipher_suite, default_provider, kx_group};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::crypto::{CryptoProvider, SupportedKxGroup};
use rustls_axon::external_psk::{
    ExternalPsk, ExternalPskOffer, PskKeyExchangeMode, ResolvesExternalPsk,
};
use rustls_axon::server::ServerSessionMemoryCache;
use rustls_axon::{
    AlertDescription, ClientConfig, ClientConnection, Error, HandshakeKind, KeyLog, NamedGroup,
    PeerIncompatible, PeerMisbehaved, ServerConfig, ServerConnection, SupportedCipherSuite,
};
use zeroize::Zeroizing;

const SHA256: SupportedCipherSuite = cipher_suite::TLS13_CHACHA20_POLY1305_SHA256;
const SHA384: SupportedCipherSuite = cipher_suite::TLS13_AES_256_GCM_SHA384;
const HYBRID: &dyn SupportedKxGroup = kx_group::X25519MLKEM768;
const MODES: [PskKeyExchangeMode; 2] = [PskKeyExchangeMode::PskKe, PskKeyExchangeMode::PskDheKe];

fn provider(
    suites: &[SupportedCipherSuite],
    groups: &[&'static dyn SupportedKxGroup],
) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider {
        cipher_suites: suites.to_vec(),
        kx_groups: groups.to_vec(),
        ..default_provider()
    })
}

fn hash_of(suite: SupportedCipherSuite) -> HashAlgorithm {
    suite.tls13().unwrap().common.hash_provider.algorithm()
}

fn psk(identity: &str, secret: u8, suite: SupportedCipherSuite) -> Arc<ExternalPsk> {
    let secret = Zeroizing::new(vec![secret; 32]);
    Arc::new(ExternalPsk::new(identity, secret, hash_of(suite)).unwrap())
}

/// Knows some PSKs, and counts how often it was asked.
struct Known {
    psks: Vec<Arc<ExternalPsk>>,
    asked: AtomicUsize,
}

impl Known {
    fn new(psks: Vec<Arc<ExternalPsk>>) -> Arc<Self> {
        Arc::new(Self { psks, asked: AtomicUsize::new(0) })
    }
}

impl fmt::Debug for Known {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Known")
    }
}

impl ResolvesExternalPsk for Known {
    fn resolve(&self, offer: ExternalPskOffer<'_>) -> Option<Arc<ExternalPsk>> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        offer
            .identities()
            .find_map(|offered| self.psks.iter().find(|psk| psk.identity() == offered))
            .cloned()
    }
}

fn groups_for(mode: PskKeyExchangeMode) -> &'static [&'static dyn SupportedKxGroup] {
    match mode {
        PskKeyExchangeMode::PskKe => &[],
        PskKeyExchangeMode::PskDheKe => &[HYBRID],
    }
}

fn client_config(
    suites: &[SupportedCipherSuite],
    psks: Vec<Arc<ExternalPsk>>,
    mode: PskKeyExchangeMode,
) -> ClientConfig {
    ClientConfig::builder_with_provider(provider(suites, groups_for(mode)))
        .with_external_psks(psks, mode)
        .unwrap()
}

fn server_config(
    suites: &[SupportedCipherSuite],
    resolver: Arc<Known>,
    mode: PskKeyExchangeMode,
) -> ServerConfig {
    ServerConfig::builder_with_provider(provider(suites, groups_for(mode)))
        .with_external_psk_resolver(resolver, mode)
        .unwrap()
}

fn client(config: ClientConfig) -> ClientConnection {
    ClientConnection::new(Arc::new(config), "example.com".try_into().unwrap()).unwrap()
}

fn server(config: ServerConfig) -> ServerConnection {
    ServerConnection::new(Arc::new(config)).unwrap()
}

/// Moves what one end wrote to the other.
macro_rules! pass {
    ($from:expr => $to:expr) => {{
        let mut bytes = Vec::new();
        while $from.wants_write() {
            $from.write_tls(&mut bytes).unwrap();
        }
        feed!($to, &bytes)
    }};
}

macro_rules! feed {
    ($to:expr, $bytes:expr) => {{
        let mut bytes: &[u8] = $bytes;
        let mut result = Ok(());
        while !bytes.is_empty() && result.is_ok() {
            $to.read_tls(&mut bytes).unwrap();
            result = $to.process_new_packets().map(|_| ());
        }
        result
    }};
}

/// Whoever fails first, `Ok` if nobody does.
fn handshake(client: &mut ClientConnection, server: &mut ServerConnection) -> Result<(), Error> {
    for _ in 0..4 {
        pass!(client => server)?;
        pass!(server => client)?;
    }
    assert!(!client.is_handshaking() && !server.is_handshaking());
    Ok(())
}

/// What the last alert in a flight says.
fn alert_in(flight: &[u8]) -> Option<AlertDescription> {
    match flight {
        [.., 21, 3, 3, 0, 2, 2, alert] => Some(AlertDescription::from(*alert)),
        _ => None,
    }
}

fn written(conn: &mut rustls_axon::Connection) -> Vec<u8> {
    let mut bytes = Vec::new();
    while conn.wants_write() {
        conn.write_tls(&mut bytes).unwrap();
    }
    bytes
}

/// The error of a client, and its alert, on a ServerHello made from the extensions given.
fn client_on_server_hello(
    client: ClientConnection,
    suite: u16,
    random: [u8; 32],
    extensions: &[(u16, &[u8])],
) -> (Error, Option<AlertDescription>) {
    let mut client = rustls_axon::Connection::from(client);
    let client_hello = written(&mut client);
    // record header 5, handshake header 4, version 2, random 32, then the session ID
    let session_id = &client_hello[43..44 + usize::from(client_hello[43])];

    let mut body = vec![3, 3];
    body.extend(random);
    body.extend(session_id);
    body.extend(suite.to_be_bytes());
    body.push(0);
    let mut list = Vec::new();
    for (kind, data) in extensions {
        list.extend(kind.to_be_bytes());
        list.extend((data.len() as u16).to_be_bytes());
        list.extend(*data);
    }
    body.extend((list.len() as u16).to_be_bytes());
    body.extend(list);
    let mut record = vec![22, 3, 3];
    record.extend((body.len() as u16 + 4).to_be_bytes());
    record.extend([2, 0]);
    record.extend((body.len() as u16).to_be_bytes());
    record.extend(body);

    let error = feed!(client, &record).unwrap_err();
    let flight = written(&mut client);
    (error, alert_in(&flight))
}

const TLS13: (u16, &[u8]) = (43, &[3, 4]);
const FIRST_PSK: (u16, &[u8]) = (41, &[0, 0]);
const HELLO_RETRY_REQUEST: [u8; 32] = [
    0xcf, 0x21, 0xad, 0x74, 0xe5, 0x9a, 0x61, 0x11, 0xbe, 0x1d, 0x8c, 0x02, 0x1e, 0x65, 0xb8, 0x91,
    0xc2, 0xa2, 0x11, 0x16, 0x7a, 0xbb, 0x8c, 0x5e, 0x07, 0x9e, 0x09, 0xe2, 0xc8, 0xa8, 0x33, 0x9c,
];

#[test]
fn client_refuses_hostile_server_hellos() {
    use AlertDescription::{
        HandshakeFailure, IllegalParameter, MissingExtension, UnsupportedExtension,
    };

    let x25519_share: Vec<u8> = [&[0, 29, 0, 32][..], &[9; 32]].concat();
    let client = |mode| client(client_config(&[SHA256, SHA384], vec![psk("a", 1, SHA256)], mode));
    let [psk_ke, psk_dhe_ke] = MODES;

    for (mode, suite, extensions, alert) in [
        // no PSK selected, so a certificate would follow
        (psk_ke, 0x1303, &[TLS13][..], HandshakeFailure),
        (psk_dhe_ke, 0x1303, &[TLS13, (51, &x25519_share)], HandshakeFailure),
        // one that was not offered
        (psk_ke, 0x1303, &[TLS13, (41, &[0, 1])], IllegalParameter),
        (psk_ke, 0x1303, &[TLS13, (41, &[0xff, 0xff])], IllegalParameter),
        // a suite that was not offered, as its hash is not the PSK's
        (psk_ke, 0x1302, &[TLS13, FIRST_PSK], HandshakeFailure),
        // a key share where there must be none
        (psk_ke, 0x1303, &[TLS13, FIRST_PSK, (51, &x25519_share)], UnsupportedExtension),
        // none, or of another group, where there must be one
        (psk_dhe_ke, 0x1303, &[TLS13, FIRST_PSK], MissingExtension),
        (psk_dhe_ke, 0x1303, &[TLS13, FIRST_PSK, (51, &x25519_share)], IllegalParameter),
        // early data acknowledged where it cannot be
        (psk_ke, 0x1303, &[TLS13, FIRST_PSK, (42, &[])], UnsupportedExtension),
        // TLS 1.2
        (psk_ke, 0x1303, &[], AlertDescription::ProtocolVersion),
    ] {
        let (error, sent) = client_on_server_hello(client(mode), suite, [7; 32], extensions);
        assert_eq!(sent, Some(alert), "{mode:?} {suite:x} {extensions:?}: {error}");
    }

    // two hashes offered, and the PSK of one selected with the suite of the other
    let both = vec![psk("a", 1, SHA256), psk("b", 2, SHA384)];
    let client = rustls_axon_client(client_config(&[SHA256, SHA384], both, psk_ke));
    let (error, sent) = client_on_server_hello(client, 0x1302, [7; 32], &[TLS13, FIRST_PSK]);
    assert_eq!(error, PeerMisbehaved::SelectedExternalPskWithIncompatibleCipherSuite.into());
    assert_eq!(sent, Some(IllegalParameter));
}

fn rustls_axon_client(config: ClientConfig) -> ClientConnection {
    client(config)
}

#[test]
fn client_refuses_hello_retry_request_without_cause() {
    let [psk_ke, psk_dhe_ke] = MODES;
    for (mode, extensions) in [
        (psk_ke, &[TLS13, (51, &[0x11, 0xec])][..]),
        (psk_ke, &[TLS13, (44, &[0, 1, 7])]),
        (psk_ke, &[TLS13]),
        (psk_dhe_ke, &[TLS13, (51, &[0x11, 0xec])]),
        (psk_dhe_ke, &[TLS13, (51, &[0, 29])]),
    ] {
        let client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let (error, alert) =
            client_on_server_hello(client, 0x1303, HELLO_RETRY_REQUEST, extensions);
        assert_eq!(alert, Some(AlertDescription::IllegalParameter), "{mode:?}: {error}");
    }
}

/// Every change of one byte of the ClientHello, and every truncation, is noticed by the time that
/// anybody would send data.
#[test]
fn server_refuses_every_changed_client_hello() {
    let mut hello = Vec::new();
    let mut first = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], MODES[0]));
    first.write_tls(&mut hello).unwrap();

    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let server = || server(server_config(&[SHA256], resolver.clone(), MODES[0]));
    assert!(feed!(server(), &hello).is_ok());
    // the record header is not authenticated
    for at in 5..hello.len() {
        let mut changed = hello.clone();
        changed[at] ^= 0x01;
        let mut server = server();
        let refused = feed!(server, &changed).is_err();
        assert!(refused || server.wants_read() && !server.wants_write(), "byte {at}");

        let mut truncated = hello[..at].to_vec();
        let len = (at - 5) as u16;
        truncated[3..5].copy_from_slice(&len.to_be_bytes());
        let mut server = self::server(server_config(&[SHA256], resolver.clone(), MODES[0]));
        let _ = feed!(server, &truncated);
        assert!(server.is_handshaking() && server.external_psk().is_none());
    }
}

#[test]
fn server_refuses_with_the_right_alert() {
    let [psk_ke, psk_dhe_ke] = MODES;
    let offer = |identity, secret, mode| {
        client(client_config(&[SHA256], vec![psk(identity, secret, SHA256)], mode))
    };
    let certificates = |group: &'static dyn SupportedKxGroup| {
        let roots = rustls_axon::RootCertStore::empty();
        let config = ClientConfig::builder_with_provider(provider(&[SHA256], &[group]))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        client(config)
    };

    for (client, mode, error, alert) in [
        (
            offer("a", 2, psk_ke),
            psk_ke,
            Error::from(PeerMisbehaved::IncorrectBinder),
            AlertDescription::DecryptError,
        ),
        (
            offer("b", 1, psk_ke),
            psk_ke,
            PeerIncompatible::UnknownExternalPskIdentity.into(),
            AlertDescription::UnknownPSKIdentity,
        ),
        (
            offer("a", 1, psk_ke),
            psk_dhe_ke,
            PeerIncompatible::NoPskKeyExchangeModesInCommon.into(),
            AlertDescription::HandshakeFailure,
        ),
        (
            offer("a", 1, psk_dhe_ke),
            psk_ke,
            PeerIncompatible::NoPskKeyExchangeModesInCommon.into(),
            AlertDescription::HandshakeFailure,
        ),
        (
            certificates(HYBRID),
            psk_dhe_ke,
            PeerIncompatible::ExternalPskRequired.into(),
            AlertDescription::MissingExtension,
        ),
        (
            certificates(kx_group::X25519),
            psk_ke,
            PeerIncompatible::ExternalPskRequired.into(),
            AlertDescription::MissingExtension,
        ),
    ] {
        let mut client = client;
        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut server = server(server_config(&[SHA256], resolver, mode));
        assert_eq!(pass!(client => server), Err(error));
        assert_eq!(pass!(server => client), Err(Error::AlertReceived(alert)));
    }
}

#[test]
fn configs_that_cannot_work_are_refused() {
    let secret = || Zeroizing::new(vec![1; 32]);
    assert!(ExternalPsk::new("", secret(), HashAlgorithm::SHA256).is_err());
    assert!(ExternalPsk::new(vec![b'a'; 65_530], secret(), HashAlgorithm::SHA256).is_err());
    assert!(ExternalPsk::new("a", secret(), HashAlgorithm::SHA512).is_err());
    assert!(ExternalPsk::new("a", Zeroizing::new(vec![1; 15]), HashAlgorithm::SHA256).is_err());

    let build = |suites: &[_], groups: &[_], psks, mode| {
        ClientConfig::builder_with_provider(provider(suites, groups)).with_external_psks(psks, mode)
    };
    let [psk_ke, psk_dhe_ke] = MODES;
    let one = || vec![psk("a", 1, SHA256)];
    assert!(build(&[SHA256], &[], vec![], psk_ke).is_err(), "no PSK");
    assert!(build(&[], &[], one(), psk_ke).is_err(), "no suite");
    assert!(build(&[SHA256], &[], one(), psk_dhe_ke).is_err(), "no group");

    // only with an external PSK may the list of groups be empty
    assert!(ClientConfig::builder_with_provider(provider(&[SHA256], &[]))
        .with_safe_default_protocol_versions()
        .is_err());

    // a suite for the PSK is looked for when a connection is made, as a source may have any PSK
    let config = build(&[SHA384], &[], one(), psk_ke).unwrap();
    let name = "example.com".try_into().unwrap();
    assert!(ClientConnection::new(Arc::new(config), name).is_err());
}

#[derive(Debug)]
struct NoLogging;

impl KeyLog for NoLogging {
    fn will_log(&self, _label: &str) -> bool {
        panic!("the key log must not be asked");
    }

    fn log(&self, _label: &str, _client_random: &[u8], _secret: &[u8]) {
        panic!("nothing must be logged");
    }
}

/// Whatever the public fields of the configs are set to afterwards.
#[test]
fn nothing_is_kept_or_logged_or_sent_early() {
    for mode in MODES {
        let mut client_config = client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode);
        client_config.key_log = Arc::new(NoLogging);
        client_config.resumption = Resumption::in_memory_sessions(8);
        client_config.enable_early_data = true;
        let client_config = Arc::new(client_config);

        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut server_config = server_config(&[SHA256], resolver.clone(), mode);
        server_config.key_log = Arc::new(NoLogging);
        server_config.session_storage = ServerSessionMemoryCache::new(8);
        server_config.send_tls13_tickets = 4;
        server_config.max_early_data_size = 1_000;
        server_config.send_half_rtt_data = true;
        let server_config = Arc::new(server_config);

        for connection in 1..=2 {
            let name = "example.com".try_into().unwrap();
            let mut client = ClientConnection::new(client_config.clone(), name).unwrap();
            let mut server = ServerConnection::new(server_config.clone()).unwrap();
            assert!(client.early_data().is_none());

            pass!(client => server).unwrap();
            assert!(server.external_psk().is_none(), "the client's Finished is still to come");
            assert!(client.external_psk().is_none());
            pass!(server => client).unwrap();
            assert!(client.external_psk().is_some());
            assert!(server.external_psk().is_none());
            pass!(client => server).unwrap();
            assert!(server.external_psk().is_some());
            assert!(!server.wants_write(), "no tickets");

            assert_eq!(client.tls13_tickets_received(), 0);
            assert_eq!(client.handshake_kind(), Some(HandshakeKind::Full));
            assert_eq!(server.handshake_kind(), Some(HandshakeKind::Full));
            assert_eq!(resolver.asked.load(Ordering::Relaxed), connection, "asked every time");
        }
    }
}

#[test]
fn handshakes_work() {
    use std::io::{Read, Write};

    for mode in MODES {
        for suite in [SHA256, SHA384] {
            let mut client = client(client_config(&[suite], vec![psk("a", 1, suite)], mode));
            let resolver = Known::new(vec![psk("a", 1, suite)]);
            let mut server = server(server_config(&[suite], resolver, mode));
            handshake(&mut client, &mut server).unwrap();

            for used in [client.external_psk().unwrap(), server.external_psk().unwrap()] {
                assert_eq!(used.identity(), b"a");
                assert_eq!(used.mode(), mode);
            }
            let group = client.negotiated_key_exchange_group().map(|group| group.name());
            let expected =
                (mode == PskKeyExchangeMode::PskDheKe).then_some(NamedGroup::X25519MLKEM768);
            assert_eq!(group, expected);
            assert_eq!(client.peer_certificates(), None);

            let exported = client.export_keying_material([0; 32], b"label", None).unwrap();
            assert_eq!(server.export_keying_material([0; 32], b"label", None), Ok(exported));

            let mut received = [0; 4];
            client.writer().write_all(b"ping").unwrap();
            pass!(client => server).unwrap();
            server.reader().read_exact(&mut received).unwrap();
            assert_eq!(&received, b"ping");
            server.writer().write_all(b"pong").unwrap();
            pass!(server => client).unwrap();
            client.reader().read_exact(&mut received).unwrap();
            assert_eq!(&received, b"pong");
        }
    }
}

#[test]
fn server_picks_from_an_ordered_offer() {
    let offered = vec![psk("a", 1, SHA256), psk("b", 2, SHA384), psk("c", 3, SHA256)];
    for (known, suite) in [("b", SHA384), ("c", SHA256)] {
        let secret = known.as_bytes()[0] - b'a' + 1;
        let mut client = client(client_config(&[SHA256, SHA384], offered.clone(), MODES[0]));
        let resolver = Known::new(vec![psk(known, secret, suite)]);
        let mut server = server(server_config(&[SHA384, SHA256], resolver, MODES[0]));
        handshake(&mut client, &mut server).unwrap();
        assert_eq!(client.external_psk().unwrap().identity(), known.as_bytes());
        assert_eq!(client.negotiated_cipher_suite(), Some(suite));
    }
}

/// The binders are made anew over the second ClientHello, without PSKs of another hash.
#[test]
fn hello_retry_request_works() {
    let mode = PskKeyExchangeMode::PskDheKe;
    let psks = vec![psk("a", 1, SHA256), psk("b", 2, SHA384)];
    let client_config = ClientConfig::builder_with_provider(provider(
        &[SHA256, SHA384],
        &[kx_group::X25519, kx_group::SECP256R1],
    ))
    .with_external_psks(psks, mode)
    .unwrap();
    for (known, secret, suite) in [("a", 1, SHA256), ("b", 2, SHA384)] {
        let resolver = Known::new(vec![psk(known, secret, suite)]);
        let server_config =
            ServerConfig::builder_with_provider(provider(&[suite], &[kx_group::SECP256R1]))
                .with_external_psk_resolver(resolver, mode)
                .unwrap();
        let (mut client, mut server) = (client(client_config.clone()), server(server_config));
        handshake(&mut client, &mut server).unwrap();
        for kind in [client.handshake_kind(), server.handshake_kind()] {
            assert_eq!(kind, Some(HandshakeKind::FullWithHelloRetryRequest));
        }
        assert_eq!(client.external_psk().unwrap().identity(), known.as_bytes());
    }
}
