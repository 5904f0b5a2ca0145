//! A client against a server that knows the PSK, and goes on as it likes after the ServerHello.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;

use rustls_axon::client::{
    ClientSessionStore, Resumption, Tls12ClientSessionValue, Tls13ClientSessionValue,
};
use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::pki_types::ServerName;
use rustls_axon::{ClientConnection, Error, NamedGroup, PeerMisbehaved};

use crate::common::*;
use crate::peer::{
    ext, list16, list8, message, plaintext, records, server_hello, Made, Peer, Role,
    APPLICATION_DATA, HANDSHAKE,
};

const SECRET: [u8; 32] = [1; 32];

fn psk_ke() -> Vec<(u16, Vec<u8>)> {
    vec![ext(43, &[3, 4]), ext(41, &[0, 0])]
}

/// A client that has something to say, and a server that answered its ClientHello.
fn after_server_hello() -> (ClientConnection, Peer) {
    let mut client =
        client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], PskKeyExchangeMode::PskKe));
    client.writer().write_all(b"only for who knows the key").unwrap();
    let (server, flight) = Peer::answer(&written(&mut client), &SECRET, None, &psk_ke());
    feed(&mut client, &flight).unwrap();
    (client, server)
}

fn connected(mut client: ClientConnection, mut server: Peer) -> (ClientConnection, Peer) {
    let flight = server.finish_flight();
    feed(&mut client, &flight).unwrap();
    assert!(!client.is_handshaking());
    // Finished, and what was waiting for it
    let flight = written(&mut client);
    let before_data = flight.len() - (5 + 26 + 1 + 16);
    assert!(server.expect_finished(&flight[..before_data]).is_empty());
    let data = server.read.open_all(&flight[before_data..]);
    assert_eq!(data, [(APPLICATION_DATA, b"only for who knows the key".to_vec())]);
    (client, server)
}

/// A Certificate with one entry, which is not one.
fn certificate() -> Vec<u8> {
    let entry = [&[0, 0, 4][..], &[0x30, 2, 5, 0], &[0, 0]].concat();
    [&[0][..], &[0, 0, entry.len() as u8], &entry].concat()
}

/// A CertificateRequest for Ed25519.
fn certificate_request() -> Vec<u8> {
    [&[0][..], &list16(&[0, 13, 0, 4, 0, 2, 8, 7])].concat()
}

fn new_session_ticket(ticket: &[u8]) -> Vec<u8> {
    // `early_data`, and one that does not exist
    let extensions = [0, 42, 0, 4, 0xff, 0xff, 0xff, 0xff, 0xfa, 0xfa, 0, 1, 7];
    [&[0, 0, 0x1c, 0x20, 1, 2, 3, 4][..], &list8(b"nonce"), &list16(ticket), &list16(&extensions)]
        .concat()
}

/// Everything but EncryptedExtensions, and then everything but Finished.
#[test]
fn client_refuses_all_but_the_expected_message() {
    let unexpected: &[(&str, u8, Vec<u8>)] = &[
        ("HelloRequest", 0, vec![]),
        ("ClientHello", 1, plaintext(&other_client_hello())[4..].to_vec()),
        ("NewSessionTicket", 4, new_session_ticket(b"ticket")),
        ("EndOfEarlyData", 5, vec![]),
        ("Certificate", 11, certificate()),
        ("CertificateRequest", 13, certificate_request()),
        ("CertificateVerify", 15, vec![8, 7, 0, 1, 0]),
        ("KeyUpdate", 24, vec![1]),
        ("CompressedCertificate", 25, vec![0, 1, 0, 0, 9, 0, 0, 1, 0]),
        ("a message that does not exist", 99, vec![1, 2, 3]),
    ];

    for after_encrypted_extensions in [false, true] {
        for (what, kind, body) in unexpected {
            let (mut client, mut server) = after_server_hello();
            let mut flight = Vec::new();
            if after_encrypted_extensions {
                flight.extend(server.say(8, &[0, 0]));
            }
            flight.extend(server.say(*kind, body));
            // as if nothing were wrong
            flight.extend(server.finish());
            refused(client_error(&mut client, &flight), client, server, 10, what);
        }
    }

    let (mut client, mut server) = after_server_hello();
    let flight = server.finish();
    refused(client_error(&mut client, &flight), client, server, 10, "no EncryptedExtensions");

    let (mut client, mut server) = after_server_hello();
    let flight = [server.say(8, &[0, 0]), server.say(8, &[0, 0])].concat();
    refused(client_error(&mut client, &flight), client, server, 10, "EncryptedExtensions twice");
}

fn other_client_hello() -> Vec<u8> {
    let mut other =
        client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], PskKeyExchangeMode::PskKe));
    written(&mut other)
}

fn client_error(client: &mut ClientConnection, flight: &[u8]) -> Error {
    feed(client, flight).unwrap_err()
}

/// The client gave up, said so, and let nothing out.
fn refused(error: Error, mut client: ClientConnection, mut server: Peer, alert: u8, what: &str) {
    assert!(client.is_handshaking() && client.external_psk().is_none(), "{what}");
    let said = server.read.open_all(&written(&mut client));
    assert_eq!(said, [(21, vec![2, alert])], "{what}: {error}");
    assert!(client.process_new_packets().is_err(), "{what}: it stays that way");
}

#[test]
fn client_refuses_application_data_before_finished() {
    for after_encrypted_extensions in [false, true] {
        let (mut client, mut server) = after_server_hello();
        let mut flight = Vec::new();
        if after_encrypted_extensions {
            flight.extend(server.say(8, &[0, 0]));
        }
        flight.extend(server.write.seal(APPLICATION_DATA, b"too early"));
        refused(client_error(&mut client, &flight), client, server, 10, "early data");
    }
}

/// None of these was offered.
#[test]
fn client_refuses_encrypted_extensions_it_did_not_ask_for() {
    for (what, extension) in [
        ("early_data", ext(42, &[])),
        ("key_share", ext(51, &[0, 29, 0, 1, 9])),
        ("client_certificate_type", ext(19, &[0])),
        ("server_certificate_type", ext(20, &[0])),
        ("ALPN", ext(16, &list16(&list8(b"h2")))),
        ("cookie", ext(44, &list16(b"c"))),
        ("an extension that does not exist", ext(0xfafa, &[])),
    ] {
        let (mut client, mut server) = after_server_hello();
        let encoded = [&extension.0.to_be_bytes()[..], &list16(&extension.1)].concat();
        let flight = server.say(8, &list16(&encoded));
        refused(client_error(&mut client, &flight), client, server, 110, what);
    }
}

#[test]
fn client_refuses_a_wrong_finished() {
    let wrong: &[(&str, Made<'_>)] = &[
        ("one bit", &|server| {
            let mut verify_data = server.verify_data();
            verify_data[31] ^= 1;
            verify_data.to_vec()
        }),
        ("the client's own", &|server| server.verify_data_of(Role::Client).to_vec()),
        ("short", &|server| server.verify_data()[..31].to_vec()),
        ("long", &|server| [&server.verify_data()[..], &[0]].concat()),
        ("empty", &|_| Vec::new()),
    ];
    for (what, verify_data) in wrong {
        let (mut client, mut server) = after_server_hello();
        let mut flight = server.say(8, &[0, 0]);
        flight.extend(server.say(20, &verify_data(&server)));
        refused(client_error(&mut client, &flight), client, server, 51, what);
    }
}

/// The ServerHello is all that can be said without the key.
#[test]
fn client_refuses_a_server_without_the_key() {
    for secret in [&[2; 32][..], &[1; 16], &[0; 32]] {
        let mut client =
            client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], PskKeyExchangeMode::PskKe));
        let hello = written(&mut client);
        let (mut server, mut flight) = Peer::answer(&hello, secret, None, &psk_ke());
        flight.extend(server.finish_flight());
        assert_eq!(feed(&mut client, &flight), Err(Error::DecryptError));

        // with the right key, only to read the alert
        let (mut server, _) = Peer::answer(&hello, &SECRET, None, &psk_ke());
        assert_eq!(server.alert_in(&written(&mut client)), Some(20));
    }
}

/// It says one, and uses the other: both are known to it.
#[test]
fn client_refuses_another_psk_than_was_selected() {
    let psks = vec![psk("a", 1, SHA256), psk("b", 2, SHA256)];
    for (selected, secret, right) in [(0, 1, true), (0, 2, false), (1, 1, false), (1, 2, true)] {
        let mut client = client(client_config(&[SHA256], psks.clone(), PskKeyExchangeMode::PskKe));
        let extensions = [ext(43, &[3, 4]), ext(41, &[0, selected])];
        let (mut server, mut flight) =
            Peer::answer(&written(&mut client), &[secret; 32], None, &extensions);
        flight.extend(server.finish_flight());
        let result = feed(&mut client, &flight);
        assert_eq!(result.is_ok(), right, "{selected} {secret}");
        let used = client.external_psk().map(|psk| psk.identity().to_vec());
        assert_eq!(used, right.then(|| vec![b'a' + selected]));
    }
}

#[test]
fn client_refuses_plaintext_where_encryption_is_required() {
    for (kind, content) in
        [(HANDSHAKE, message(8, &[0, 0])), (APPLICATION_DATA, b"in the clear, and 16".to_vec())]
    {
        let (mut client, mut server) = after_server_hello();
        assert_eq!(feed(&mut client, &records(kind, &content)), Err(Error::DecryptError));
        assert_eq!(server.alert_in(&written(&mut client)), Some(20));
    }
}

/// Every byte of the flight counts, and so does each one that is missing.
#[test]
fn client_refuses_every_changed_or_shortened_flight() {
    let flight_len = {
        let (_, mut server) = after_server_hello();
        server.finish_flight().len()
    };

    for at in 0..flight_len {
        let (mut client, mut server) = after_server_hello();
        let flight = server.finish_flight();
        feed(&mut client, &flight[..at]).unwrap();
        assert!(client.is_handshaking() && client.external_psk().is_none(), "cut at {at}");

        // rustls makes the additional data of what a header should be: of the headers of the two
        // records as they were received only the length counts
        if [0, 1, 2, 28, 29, 30].contains(&at) {
            continue;
        }
        let (mut client, mut server) = after_server_hello();
        let mut flight = server.finish_flight();
        flight[at] ^= 1;
        // a changed length leaves a client that waits for more
        let failed = feed(&mut client, &flight).is_err();
        assert!(failed || client.is_handshaking(), "byte {at}");
        assert!(client.external_psk().is_none(), "byte {at}");
    }

    // messages that say their shorter length, under right tags
    for len in 0..32 {
        let (mut client, mut server) = after_server_hello();
        let mut flight = server.say(8, &[0, 0]);
        flight.extend(server.say(20, &server.verify_data()[..len]));
        refused(client_error(&mut client, &flight), client, server, 51, "a short Finished");
    }
    for body in [&[][..], &[0], &[0, 1], &[0, 3, 0, 10], &[0, 0, 0]] {
        let (mut client, mut server) = after_server_hello();
        let flight = server.say(8, body);
        refused(client_error(&mut client, &flight), client, server, 50, "EncryptedExtensions");
    }
}

/// RFC 8446 5.1: a record that holds the last message under old keys ends with it.
#[test]
fn client_refuses_messages_across_a_change_of_keys() {
    let mut client =
        client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], PskKeyExchangeMode::PskKe));
    let hello = server_hello(&plaintext(&written(&mut client)), 0x1303, [7; 32], &psk_ke());
    let record = records(HANDSHAKE, &[hello, message(8, &[0, 0])].concat());
    assert!(feed(&mut client, &record).is_err());
    assert_eq!(written(&mut client).last(), Some(&10));

    let (mut client, mut server) = after_server_hello();
    let _ = server.add(8, &[0, 0]);
    let verify_data = server.verify_data();
    let ticket = message(4, &new_session_ticket(b"under the keys of the handshake"));
    let content = [message(8, &[0, 0]), message(20, &verify_data), ticket].concat();
    let error = client_error(&mut client, &server.write.seal(HANDSHAKE, &content));
    assert!(client.external_psk().is_none() && client.tls13_tickets_received() == 0);
    assert_eq!(error, PeerMisbehaved::KeyEpochWithPendingFragment.into());
    // behind the client's Finished, and no data
    let said = server.read.open_all(&written(&mut client));
    let kinds: Vec<u8> = said.iter().map(|(kind, _)| *kind).collect();
    assert_eq!(kinds, [HANDSHAKE, 21]);
    assert_eq!(said[1].1, [2, 10]);
}

#[test]
fn client_refuses_malformed_tickets() {
    let ticket = new_session_ticket(b"ticket");
    for len in 0..ticket.len() {
        let (client, server) = after_server_hello();
        let (mut client, mut server) = connected(client, server);
        let error = client_error(&mut client, &server.say(4, &ticket[..len]));
        assert_eq!(server.alert_in(&written(&mut client)), Some(50), "{len}: {error}");
    }
}

/// Each prefix of a ServerHello, once as a record cut short and once as a message that says so.
#[test]
fn client_refuses_every_shortened_server_hello() {
    let make =
        || client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], PskKeyExchangeMode::PskKe));
    let len = {
        let hello = plaintext(&written(&mut make()));
        server_hello(&hello, 0x1303, [7; 32], &psk_ke()).len()
    };
    for at in 4..len {
        let mut client = make();
        let hello = server_hello(&plaintext(&written(&mut client)), 0x1303, [7; 32], &psk_ke());
        feed(&mut client, &records(HANDSHAKE, &hello[..at])).unwrap();
        assert!(client.is_handshaking() && !client.wants_write(), "cut at {at}");

        let mut client = make();
        let hello = server_hello(&plaintext(&written(&mut client)), 0x1303, [7; 32], &psk_ke());
        let shortened = records(HANDSHAKE, &message(2, &hello[4..at]));
        assert!(feed(&mut client, &shortened).is_err(), "cut at {at}");
        let alert = *written(&mut client).last().unwrap();
        // where the extensions would begin it is a whole ServerHello, of TLS 1.2
        let expected = if at == 4 + 2 + 32 + 33 + 2 + 1 { 70 } else { 50 };
        assert_eq!(alert, expected, "cut at {at}");
    }
}

#[test]
fn client_refuses_handshake_messages_after_the_handshake() {
    let cases: &[(&str, u8, Vec<u8>)] = &[
        ("HelloRequest", 0, vec![]),
        ("ClientHello", 1, plaintext(&other_client_hello())[4..].to_vec()),
        ("EncryptedExtensions", 8, vec![0, 0]),
        ("Certificate", 11, certificate()),
        ("CertificateRequest", 13, certificate_request()),
        ("CertificateVerify", 15, vec![8, 7, 0, 1, 0]),
        ("Finished", 20, vec![0; 32]),
        ("a message that does not exist", 99, vec![1, 2, 3]),
    ];
    for (what, kind, body) in cases {
        let (client, server) = after_server_hello();
        let (mut client, mut server) = connected(client, server);
        let error = client_error(&mut client, &server.say(*kind, body));
        assert_eq!(server.alert_in(&written(&mut client)), Some(10), "{what}: {error}");
    }
}

#[test]
fn client_follows_key_updates_but_not_a_flood() {
    let (client, server) = after_server_hello();
    let (mut client, mut server) = connected(client, server);
    feed(&mut client, &server.say(24, &[1])).unwrap();
    server.write.update();
    feed(&mut client, &server.write.seal(APPLICATION_DATA, b"under new keys")).unwrap();
    let mut received = [0; 14];
    client.reader().read_exact(&mut received).unwrap();
    assert_eq!(&received, b"under new keys");
    // the answer to an update that asks for one, and then data under the next keys
    client.writer().write_all(b"too").unwrap();
    let flight = written(&mut client);
    let update_len = 5 + 5 + 1 + 16;
    let update = server.read.open_all(&flight[..update_len]);
    assert_eq!(update, [(HANDSHAKE, message(24, &[0]))]);
    server.read.update();
    let data = server.read.open_all(&flight[update_len..]);
    assert_eq!(data, [(APPLICATION_DATA, b"too".to_vec())]);

    let mut flood = || {
        let update = server.say(24, &[1]);
        server.write.update();
        feed(&mut client, &update)
    };
    let error = (0..100).find_map(|_| flood().err());
    assert_eq!(error, Some(PeerMisbehaved::TooManyKeyUpdateRequests.into()));

    for (body, alert) in [(&[2][..], 47), (&[], 50), (&[0, 0], 50)] {
        let (client, server) = after_server_hello();
        let (mut client, mut server) = connected(client, server);
        let error = client_error(&mut client, &server.say(24, body));
        assert_eq!(server.alert_in(&written(&mut client)), Some(alert), "{body:?}: {error}");
    }
}

/// Counts what it is asked to keep or give, and does neither.
#[derive(Debug, Default)]
struct Counting(AtomicUsize);

impl Counting {
    fn count(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

impl ClientSessionStore for Counting {
    fn set_kx_hint(&self, _: ServerName<'static>, _: NamedGroup) {
        self.count();
    }

    fn kx_hint(&self, _: &ServerName<'_>) -> Option<NamedGroup> {
        self.count();
        None
    }

    fn set_tls12_session(&self, _: ServerName<'static>, _: Tls12ClientSessionValue) {
        self.count();
    }

    fn tls12_session(&self, _: &ServerName<'_>) -> Option<Tls12ClientSessionValue> {
        self.count();
        None
    }

    fn remove_tls12_session(&self, _: &ServerName<'static>) {
        self.count();
    }

    fn insert_tls13_ticket(&self, _: ServerName<'static>, _: Tls13ClientSessionValue) {
        self.count();
    }

    fn take_tls13_ticket(&self, _: &ServerName<'static>) -> Option<Tls13ClientSessionValue> {
        self.count();
        None
    }
}

/// Tickets that are pushed go nowhere, and a store that somebody set is never asked.
#[test]
fn client_neither_keeps_nor_asks_for_tickets() {
    for mode in MODES {
        let store = Arc::new(Counting::default());
        let suites = &[SHA256];
        let mut config = match mode {
            PskKeyExchangeMode::PskKe => client_config(suites, vec![psk("a", 1, SHA256)], mode),
            PskKeyExchangeMode::PskDheKe => {
                client_config_over(suites, &[kx_group::X25519], vec![psk("a", 1, SHA256)], mode)
            }
        };
        config.resumption = Resumption::store(store.clone());
        config.enable_early_data = true;
        let config = Arc::new(config);

        for _ in 0..2 {
            let name = "example.com".try_into().unwrap();
            let mut client = ClientConnection::new(config.clone(), name).unwrap();
            let hello = written(&mut client);
            let mut extensions = psk_ke();
            let mut shared = None;
            if mode == PskKeyExchangeMode::PskDheKe {
                let theirs = x25519_share_of(&plaintext(&hello));
                let exchanged = kx_group::X25519.start_and_complete(&theirs).unwrap();
                let share = [&[0, 29][..], &list16(&exchanged.pub_key)].concat();
                extensions.push(ext(51, &share));
                shared = Some(exchanged.secret);
            }
            let shared = shared.as_ref().map(|secret| secret.secret_bytes());
            let (mut server, mut flight) = Peer::answer(&hello, &SECRET, shared, &extensions);
            flight.extend(server.finish_flight());
            feed(&mut client, &flight).unwrap();
            assert!(server.expect_finished(&written(&mut client)).is_empty());

            for ticket in [&b"one"[..], b"another", &[b'a'; 20_000]] {
                let ticket = message(4, &new_session_ticket(ticket));
                for part in ticket.chunks(16_384) {
                    feed(&mut client, &server.write.seal(HANDSHAKE, part)).unwrap();
                }
            }
            assert_eq!(client.tls13_tickets_received(), 3);
            feed(&mut client, &server.write.seal(APPLICATION_DATA, b"data")).unwrap();
            let mut received = [0; 4];
            client.reader().read_exact(&mut received).unwrap();
            assert_eq!(&received, b"data", "{mode:?}");
        }
        assert_eq!(store.0.load(Ordering::Relaxed), 0, "{mode:?}");
    }
}

/// The key share in a ClientHello that has one, of X25519.
fn x25519_share_of(client_hello: &[u8]) -> Vec<u8> {
    let head = [0, 51, 0, 38, 0, 36, 0, 29, 0, 32];
    let at = client_hello.windows(head.len()).position(|window| window == head).unwrap();
    client_hello[at + head.len()..][..32].to_vec()
}
