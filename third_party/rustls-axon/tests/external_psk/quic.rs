//! Over QUIC, which has records and keys of its own: the messages, as they are.

use std::sync::Arc;

use rustls_axon::client::Resumption;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::quic::{ClientConnection, ConnectionCommon, KeyChange, ServerConnection, Version};
use rustls_axon::server::ServerSessionMemoryCache;
use rustls_axon::SideData;

use crate::common::*;
use crate::peer::{ext, list16, list8, message, server_hello, ClientHello, Offer, Peer, Role};

const SECRET: [u8; 32] = [1; 32];
const MODE: PskKeyExchangeMode = PskKeyExchangeMode::PskKe;
const TRANSPORT_PARAMETERS: u16 = 57;

/// All that an end has to say, at whatever level, and how often its keys changed.
fn said<D: SideData>(from: &mut ConnectionCommon<D>) -> (Vec<u8>, usize) {
    let (mut messages, mut changes) = (Vec::new(), 0);
    loop {
        let before = messages.len();
        let change: Option<KeyChange> = from.write_hs(&mut messages);
        changes += usize::from(change.is_some());
        if change.is_none() && messages.len() == before {
            return (messages, changes);
        }
    }
}

fn new_client() -> ClientConnection {
    let mut config = client_config(&[SHA256], vec![psk("a", 1, SHA256)], MODE);
    config.resumption = Resumption::in_memory_sessions(8);
    config.enable_early_data = true;
    let name = "example.com".try_into().unwrap();
    ClientConnection::new(Arc::new(config), Version::V1, name, b"client's".to_vec()).unwrap()
}

fn new_server() -> ServerConnection {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let mut config = server_config(&[SHA256], resolver, MODE);
    config.session_storage = ServerSessionMemoryCache::new(8);
    config.send_tls13_tickets = 4;
    config.max_early_data_size = 0xffff_ffff;
    config.send_half_rtt_data = true;
    ServerConnection::new(Arc::new(config), Version::V1, b"server's".to_vec()).unwrap()
}

fn alert<D: SideData>(conn: &ConnectionCommon<D>) -> Option<u8> {
    conn.alert().map(u8::from)
}

fn after_server_hello() -> (ClientConnection, Peer) {
    let mut client = new_client();
    assert!(client.zero_rtt_keys().is_none());
    let (hello, _) = said(&mut client);
    let answer = server_hello(&hello, 0x1303, [7; 32], &[ext(43, &[3, 4]), ext(41, &[0, 0])]);
    client.read_hs(&answer).unwrap();
    let transcript = [hello, answer].concat();
    (client, Peer::new(Role::Server, Some(&SECRET), None, transcript))
}

fn encrypted_extensions(extensions: &[(u16, &[u8])]) -> Vec<u8> {
    let encode = |(kind, data): &(u16, &[u8])| [&kind.to_be_bytes()[..], &list16(data)].concat();
    list16(&extensions.iter().flat_map(encode).collect::<Vec<_>>())
}

fn connected_client() -> (ClientConnection, Peer) {
    let (mut client, mut server) = after_server_hello();
    let body = encrypted_extensions(&[(TRANSPORT_PARAMETERS, b"server's")]);
    client.read_hs(&server.add(8, &body)).unwrap();
    let verify_data = server.verify_data();
    client.read_hs(&server.add(20, &verify_data)).unwrap();
    let (finished, _) = said(&mut client);
    assert_eq!(finished, message(20, &server.verify_data_of(Role::Client)));
    assert_eq!(client.external_psk().unwrap().identity(), b"a");
    assert_eq!(client.quic_transport_parameters(), Some(&b"server's"[..]));
    (client, server)
}

#[test]
fn client_refuses_a_hostile_flight() {
    let parameters: (u16, &[u8]) = (TRANSPORT_PARAMETERS, b"server's");
    let certificate = vec![0, 0, 0, 9, 0, 0, 4, 0x30, 2, 5, 0, 0, 0];
    let request = [&[0][..], &list16(&[0, 13, 0, 4, 0, 2, 8, 7])].concat();
    for (what, extensions, kind, body, expected) in [
        ("no transport parameters", &[][..], 20, vec![], 109),
        ("early data", &[parameters, (42, &[])], 20, vec![], 110),
        ("ALPN", &[parameters, (16, &[0, 3, 2, b'h', b'3'])], 20, vec![], 110),
        ("Certificate", &[parameters], 11, certificate, 10),
        ("CertificateRequest", &[parameters], 13, request, 10),
        ("KeyUpdate", &[parameters], 24, vec![1], 10),
        ("a wrong Finished", &[parameters], 20, vec![7; 32], 51),
    ] {
        let (mut client, mut server) = after_server_hello();
        let flight =
            [server.add(8, &encrypted_extensions(extensions)), server.add(kind, &body)].concat();
        let error = client.read_hs(&flight).unwrap_err();
        assert_eq!(alert(&client), Some(expected), "{what}: {error}");
        assert!(client.is_handshaking() && client.external_psk().is_none(), "{what}");
    }
}

#[test]
fn client_takes_tickets_but_keeps_none_and_nothing_else() {
    let ticket = [&[0; 8][..], &list8(b"n"), &list16(b"ticket"), &list16(&[])].concat();
    let (mut client, mut server) = connected_client();
    client.read_hs(&server.add(4, &ticket)).unwrap();
    assert_eq!(client.tls13_tickets_received(), 1);
    assert!(client.zero_rtt_keys().is_none());

    for (kind, body) in [
        (24, vec![1]),
        (13, [&[0][..], &list16(&[0, 13, 0, 4, 0, 2, 8, 7])].concat()),
        (20, vec![0; 32]),
        (99, vec![]),
    ] {
        let (mut client, mut server) = connected_client();
        assert!(client.read_hs(&server.add(kind, &body)).is_err());
        assert_eq!(alert(&client), Some(10), "{kind}");
    }
}

fn offer() -> ClientHello {
    ClientHello::new(vec![Offer::new("a", &SECRET)]).with(TRANSPORT_PARAMETERS, b"client's")
}

#[test]
fn server_refuses_hostile_client_hellos() {
    let other = ClientHello::new(vec![Offer::new("b", &SECRET)]);
    let wrong = ClientHello::new(vec![Offer::new("a", &[2; 32])]);
    let resumed = ClientHello::new(vec![Offer { label: "res binder", ..Offer::new("a", &SECRET) }]);
    let bare = || ClientHello { offers: vec![], ..offer() }.with(13, &list16(&[4, 3]));
    for (what, hello, expected) in [
        ("no transport parameters", offer().without(TRANSPORT_PARAMETERS), 109),
        ("no PSK", bare(), 109),
        ("no modes", offer().without(45), 109),
        ("TLS 1.2", offer().with(43, &[2, 3, 3]), 70),
        ("an unknown PSK", other.with(TRANSPORT_PARAMETERS, b"client's"), 115),
        ("another secret", wrong.with(TRANSPORT_PARAMETERS, b"client's"), 51),
        ("a binder of resumption", resumed.with(TRANSPORT_PARAMETERS, b"client's"), 51),
    ] {
        let mut server = new_server();
        let error = server.read_hs(&hello.encode()).unwrap_err();
        assert_eq!(alert(&server), Some(expected), "{what}: {error}");
        assert!(server.external_psk().is_none());
    }
}

/// 0-RTT is neither keyed nor acknowledged, and there is nothing to say before the client's
/// Finished but the handshake.
#[test]
fn server_goes_on_with_finished_alone() {
    let answered = |hello: ClientHello| {
        let hello = hello.encode();
        let mut server = new_server();
        server.read_hs(&hello).unwrap();
        assert!(server.zero_rtt_keys().is_none());
        let (flight, changes) = said(&mut server);
        assert_eq!(changes, 2, "to the handshake's keys, and to those for data");
        // header 4, version 2, random 32, session ID 33, suite 2, compression 1, then extensions
        let end = 76 + usize::from(u16::from_be_bytes([flight[74], flight[75]]));
        let (server_hello, rest) = flight.split_at(end);
        let transcript = [&hello, server_hello].concat();
        let mut client = Peer::new(Role::Client, Some(&SECRET), None, transcript);
        let extensions = encrypted_extensions(&[(TRANSPORT_PARAMETERS, b"server's")]);
        let expected = client.add(8, &extensions);
        let verify_data = client.verify_data_of(Role::Server);
        assert_eq!(rest, [expected, client.add(20, &verify_data)].concat());
        (server, client)
    };

    for hello in [offer(), offer().with(42, &[])] {
        let (mut server, mut client) = answered(hello);
        let verify_data = client.verify_data();
        server.read_hs(&client.add(20, &verify_data)).unwrap();
        assert_eq!(server.external_psk().unwrap().identity(), b"a");
        assert_eq!(said(&mut server), (vec![], 0), "no tickets");
        assert!(server.read_hs(&client.add(24, &[1])).is_err(), "and no KeyUpdate");
        assert_eq!(alert(&server), Some(10));
    }

    for (kind, body, expected) in [
        (5, vec![], 10),
        (11, vec![0, 0, 0, 0], 10),
        (24, vec![1], 10),
        (20, vec![7; 32], 51),
        (20, vec![], 51),
    ] {
        let (mut server, mut client) = answered(offer());
        let error = server.read_hs(&client.add(kind, &body)).unwrap_err();
        assert_eq!(alert(&server), Some(expected), "{kind}: {error}");
        assert!(server.external_psk().is_none());
    }
}
