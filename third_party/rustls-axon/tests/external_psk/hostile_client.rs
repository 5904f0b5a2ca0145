//! A server against a client that knows the PSK, and goes on as it likes after the ClientHello.

use std::io::{Read, Write};
use std::sync::atomic::Ordering;
use std::sync::Arc;

use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::server::ServerSessionMemoryCache;
use rustls_axon::{Error, PeerMisbehaved, ServerConnection};

use crate::common::*;
use crate::peer::{
    digest, list16, list8, message, plaintext, records, ClientHello, Early, Made, Offer, Peer,
    Protection, Role, APPLICATION_DATA, HANDSHAKE,
};

const SECRET: [u8; 32] = [1; 32];

fn offer() -> ClientHello {
    ClientHello::new(vec![Offer::new("a", &SECRET)])
}

/// A server whose public fields ask for all that it must not do, and that has something to say.
fn server_to(hello: &[u8]) -> (ServerConnection, Peer) {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let mut config = server_config(&[SHA256], resolver, PskKeyExchangeMode::PskKe);
    config.session_storage = ServerSessionMemoryCache::new(8);
    config.send_tls13_tickets = 4;
    config.max_early_data_size = 1_000;
    config.send_half_rtt_data = true;
    let mut server = server(config);
    server.writer().write_all(b"only for who knows the key").unwrap();

    feed(&mut server, &records(HANDSHAKE, hello)).unwrap();
    let flight = written(&mut server);
    let transcript = [hello, &plaintext(&flight)].concat();
    let mut client = Peer::new(Role::Client, Some(&SECRET), None, transcript);
    // which is all there is: half-RTT data would not open
    assert_eq!(client.expect_finished(&flight), message(8, &[0, 0]));
    (server, client)
}

fn after_server_finished() -> (ServerConnection, Peer) {
    server_to(&offer().encode())
}

fn connected() -> (ServerConnection, Peer) {
    let (mut server, mut client) = after_server_finished();
    feed(&mut server, &client.finish()).unwrap();
    assert!(!server.is_handshaking());
    // and no tickets
    let said = client.read.open_all(&written(&mut server));
    assert_eq!(said, [(APPLICATION_DATA, b"only for who knows the key".to_vec())]);
    (server, client)
}

/// The server gave up, said so, let nothing out, and has no PSK to spend.
fn refused(mut server: ServerConnection, mut client: Peer, flight: &[u8], alert: u8, what: &str) {
    let error = feed(&mut server, flight).unwrap_err();
    assert!(server.is_handshaking() && server.external_psk().is_none(), "{what}");
    let said = client.read.open_all(&written(&mut server));
    assert_eq!(said, [(21, vec![2, alert])], "{what}: {error}");
    assert!(server.process_new_packets().is_err(), "{what}: it stays that way");
}

/// Messages that make no difference between a handshake and later.
fn never_expected() -> Vec<(&'static str, u8, Vec<u8>)> {
    vec![
        ("ClientHello", 1, offer().encode()[4..].to_vec()),
        ("ServerHello", 2, [&[3, 3][..], &[7; 32], &[0, 0x13, 3, 0, 0, 0]].concat()),
        (
            "NewSessionTicket",
            4,
            [&[0; 8][..], &list8(b"n"), &list16(b"ticket"), &list16(&[])].concat(),
        ),
        ("EndOfEarlyData", 5, vec![]),
        ("EncryptedExtensions", 8, vec![0, 0]),
        ("Certificate", 11, vec![0, 0, 0, 0]),
        ("CertificateRequest", 13, [&[0][..], &list16(&[0, 13, 0, 4, 0, 2, 8, 7])].concat()),
        ("CertificateVerify", 15, vec![8, 7, 0, 1, 0]),
        ("a message that does not exist", 99, vec![1, 2, 3]),
    ]
}

#[test]
fn server_refuses_all_but_finished() {
    let mut cases = never_expected();
    cases.push(("KeyUpdate", 24, vec![1]));
    for (what, kind, body) in cases {
        let (server, mut client) = after_server_finished();
        let flight = [client.say(kind, &body), client.finish()].concat();
        refused(server, client, &flight, 10, what);
    }
}

#[test]
fn server_refuses_a_wrong_finished() {
    let wrong: &[(&str, Made<'_>)] = &[
        ("one bit", &|client| {
            let mut verify_data = client.verify_data();
            verify_data[0] ^= 0x80;
            verify_data.to_vec()
        }),
        ("the server's own", &|client| client.verify_data_of(Role::Server).to_vec()),
        ("short", &|client| client.verify_data()[..31].to_vec()),
        ("long", &|client| [&client.verify_data()[..], &[0]].concat()),
        ("empty", &|_| Vec::new()),
    ];
    for (what, verify_data) in wrong {
        let (server, mut client) = after_server_finished();
        let flight = client.say(20, &verify_data(&client));
        refused(server, client, &flight, 51, what);
    }
}

#[test]
fn server_refuses_application_data_before_finished() {
    let (server, mut client) = after_server_finished();
    let flight = client.write.seal(APPLICATION_DATA, b"too early");
    refused(server, client, &flight, 10, "under handshake keys");

    let (server, mut client) = after_server_finished();
    // what would be the keys once Finished is said
    let _ = client.finish();
    let flight = client.write.seal(APPLICATION_DATA, b"too early");
    refused(server, client, &flight, 20, "under application keys");
}

#[test]
fn server_refuses_every_changed_or_shortened_flight() {
    let len = after_server_finished().1.finish().len();
    for at in 0..len {
        let (mut server, mut client) = after_server_finished();
        feed(&mut server, &client.finish()[..at]).unwrap();
        assert!(server.is_handshaking() && server.external_psk().is_none(), "cut at {at}");

        // rustls makes the additional data of what a header should be: of the header as it was
        // received only the length counts
        if at < 3 {
            continue;
        }
        let (mut server, mut client) = after_server_finished();
        let mut flight = client.finish();
        flight[at] ^= 1;
        let failed = feed(&mut server, &flight).is_err();
        assert!(failed || server.is_handshaking(), "byte {at}");
        assert!(server.external_psk().is_none(), "byte {at}");
        // whatever it was: not a byte of data
        let said = client.read.open_all(&written(&mut server));
        assert!(said.iter().all(|(kind, _)| *kind == 21), "byte {at}");
    }
}

#[test]
fn server_refuses_handshake_messages_after_the_handshake() {
    let mut cases = never_expected();
    cases.push(("Finished", 20, vec![0; 32]));
    for (what, kind, body) in cases {
        let (mut server, mut client) = connected();
        let error = feed(&mut server, &client.say(kind, &body)).unwrap_err();
        assert_eq!(client.alert_in(&written(&mut server)), Some(10), "{what}: {error}");
    }
}

#[test]
fn server_follows_key_updates_but_not_a_flood() {
    let (mut server, mut client) = connected();
    feed(&mut server, &client.say(24, &[1])).unwrap();
    client.write.update();
    feed(&mut server, &client.write.seal(APPLICATION_DATA, b"under new keys")).unwrap();
    let mut received = [0; 14];
    server.reader().read_exact(&mut received).unwrap();
    assert_eq!(&received, b"under new keys");

    let mut flood = || {
        let update = client.say(24, &[1]);
        client.write.update();
        feed(&mut server, &update)
    };
    let error = (0..100).find_map(|_| flood().err());
    assert_eq!(error, Some(PeerMisbehaved::TooManyKeyUpdateRequests.into()));

    for (body, alert) in [(&[2][..], 47), (&[], 50), (&[0, 0], 50)] {
        let (mut server, mut client) = connected();
        let error = feed(&mut server, &client.say(24, body)).unwrap_err();
        assert_eq!(client.alert_in(&written(&mut server)), Some(alert), "{body:?}: {error}");
    }
}

/// Not even the right Finished.
#[test]
fn server_refuses_plaintext_where_encryption_is_required() {
    for kind in [HANDSHAKE, APPLICATION_DATA] {
        let (server, client) = after_server_finished();
        let flight = records(kind, &message(20, &client.verify_data()));
        refused(server, client, &flight, 20, "in the clear");
    }
}

/// RFC 8446 5.1: a record that holds the last message under old keys ends with it.
#[test]
fn server_refuses_messages_across_a_change_of_keys() {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let mut server = server(server_config(&[SHA256], resolver.clone(), PskKeyExchangeMode::PskKe));
    let two = [offer().encode(), message(20, &[0; 32])].concat();
    assert!(feed(&mut server, &records(HANDSHAKE, &two)).is_err());
    assert_eq!(written(&mut server).last(), Some(&10));
    assert_eq!(resolver.asked.load(Ordering::Relaxed), 0, "nobody was asked for a PSK");

    let (server, mut client) = after_server_finished();
    let content = [message(20, &client.verify_data()), message(24, &[0])].concat();
    let flight = client.write.seal(HANDSHAKE, &content);
    refused(server, client, &flight, 10, "Finished and KeyUpdate");
}

/// 0-RTT data is neither acknowledged nor delivered: its records do not open, and are skipped, but
/// only so many.
#[test]
fn server_skips_early_data() {
    let hello = offer().with(42, &[]).encode();
    let early_keys = || Protection::new(&Early::new(Some(&SECRET)).traffic(&digest(&hello)));

    let (mut server, mut client) = server_to(&hello);
    let mut early = early_keys();
    feed(&mut server, &early.seal(APPLICATION_DATA, b"early")).unwrap();
    feed(&mut server, &early.seal(HANDSHAKE, &message(5, &[]))).unwrap();
    assert!(server.early_data().is_none());
    feed(&mut server, &client.finish()).unwrap();
    feed(&mut server, &client.write.seal(APPLICATION_DATA, b"later")).unwrap();
    let mut received = [0; 5];
    server.reader().read_exact(&mut received).unwrap();
    assert_eq!(&received, b"later");

    let (mut server, mut client) = server_to(&hello);
    let mut early = early_keys();
    let mut flood = || feed(&mut server, &early.seal(APPLICATION_DATA, &[0; 4_096]));
    let error = (0..10).find_map(|_| flood().err());
    assert_eq!(error, Some(Error::DecryptError));
    assert_eq!(client.alert_in(&written(&mut server)), Some(20));

    // who did not announce any has nothing skipped
    let (server, client) = after_server_finished();
    let early = early_keys().seal(APPLICATION_DATA, b"early");
    refused(server, client, &early, 20, "not announced");
}

/// With a HelloRetryRequest there are no keys yet to tell early data by: all records of application
/// data are skipped, up to the limit, until there is a second ClientHello.
#[test]
fn server_skips_early_data_before_a_second_client_hello() {
    let retried = || {
        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mode = PskKeyExchangeMode::PskDheKe;
        let config = server_config_over(&[SHA256], &[kx_group::X25519], resolver, mode);
        let mut server = server(config);
        let share = [&[0, 23][..], &list16(&[4; 65])].concat();
        let first = offer()
            .in_psk_dhe_ke(29, &[])
            .with(10, &list16(&[0, 23, 0, 29]))
            .with(51, &list16(&share))
            .with(42, &[])
            .encode();
        feed(&mut server, &records(HANDSHAKE, &first)).unwrap();
        let retry = plaintext(&written(&mut server));
        let early = Protection::new(&Early::new(Some(&SECRET)).traffic(&digest(&first)));
        (server, [message(254, &digest(&first)), retry].concat(), early)
    };

    let (mut server, before, mut early) = retried();
    feed(&mut server, &early.seal(APPLICATION_DATA, b"early")).unwrap();
    let ours = kx_group::X25519.start().unwrap();
    let second = offer().in_psk_dhe_ke(29, ours.pub_key()).with(10, &list16(&[0, 23, 0, 29]));
    let second = ClientHello { before, ..second }.encode();
    feed(&mut server, &records(HANDSHAKE, &second)).unwrap();
    assert!(server.wants_write() && server.early_data().is_none());
    let mut nothing = Vec::new();
    assert!(server.reader().read_to_end(&mut nothing).is_err(), "it would have to wait");

    let (mut server, _, mut early) = retried();
    let mut flood = || feed(&mut server, &early.seal(APPLICATION_DATA, &[0; 4_096]));
    assert!((0..10).any(|_| flood().is_err()));
    assert_eq!(written(&mut server).last(), Some(&10));
}

/// A look-up, a wrong Finished and a cut connection leave nothing that a caller would take for use.
#[test]
fn a_copied_client_hello_spends_nothing() {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let config = Arc::new(server_config(&[SHA256], resolver, PskKeyExchangeMode::PskKe));
    let hello = records(HANDSHAKE, &offer().encode());
    for _ in 0..3 {
        let mut server = ServerConnection::new(config.clone()).unwrap();
        feed(&mut server, &hello).unwrap();
        assert!(server.wants_write() && server.external_psk().is_none());
    }
}
