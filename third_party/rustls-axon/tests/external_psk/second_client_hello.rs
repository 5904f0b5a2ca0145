//! A server that asked for another share, against a client that knows the PSK.
//!
//! The server supports X25519 and P-256, and asks for X25519: a share of P-256 is one that it could
//! use, and must not.

use std::sync::Arc;

use rustls_axon::crypto::aws_lc_rs::{cipher_suite, kx_group};
use rustls_axon::crypto::{ActiveKeyExchange, SupportedKxGroup};
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::{Error, PeerMisbehaved, ServerConfig, ServerConnection};

use crate::common::*;
use crate::peer::{
    digest, list16, list8, message, plaintext, records, ClientHello, Offer, Peer, Role, HANDSHAKE,
};
use crate::resumption::Unchecked;

const SECRET: [u8; 32] = [1; 32];
const X25519: u16 = 29;
const P256: u16 = 23;
const P384: u16 = 24;

const GROUPS: [&dyn SupportedKxGroup; 2] = [kx_group::X25519, kx_group::SECP256R1];

pub(crate) fn shares(list: &[(u16, &[u8])]) -> Vec<u8> {
    let encode =
        |(group, share): &(u16, &[u8])| [&group.to_be_bytes(), &list16(share)[..]].concat();
    list16(&list.iter().flat_map(encode).collect::<Vec<_>>())
}

pub(crate) fn groups(list: &[u16]) -> Vec<u8> {
    list16(&list.iter().flat_map(|group| group.to_be_bytes()).collect::<Vec<_>>())
}

fn x25519() -> Box<dyn ActiveKeyExchange> {
    kx_group::X25519.start().unwrap()
}

fn p256() -> Vec<u8> {
    kx_group::SECP256R1.start().unwrap().pub_key().to_vec()
}

/// A ClientHello that prefers P-384, which the server has not, and then X25519.
fn hello(offers: Vec<Offer>, share: &[u8]) -> ClientHello {
    ClientHello { suites: vec![0x1303, 0x1301], ..ClientHello::new(offers) }
        .in_psk_dhe_ke(X25519, share)
        .with(10, &groups(&[P384, X25519, P256]))
        .with(16, &list16(&list8(b"axon")))
        .with(0xfafa, b"grease")
}

/// The first one: its share is of P-384, so another one has to be asked for.
fn first_hello(offers: Vec<Offer>) -> ClientHello {
    hello(offers, &[]).with(51, &shares(&[(P384, &[4; 97])]))
}

fn external() -> Vec<Offer> {
    vec![Offer::new("unknown", &[9; 32]), Offer::new("a", &SECRET), Offer::new("b", &[2; 32])]
}

fn external_server() -> ServerConfig {
    let resolver = Known::new(vec![psk("a", 1, SHA256), psk("b", 2, SHA256), psk("c", 3, SHA256)]);
    let suites = [SHA256, cipher_suite::TLS13_AES_128_GCM_SHA256];
    let mut config = server_config_over(&suites, &GROUPS, resolver, PskKeyExchangeMode::PskDheKe);
    config.alpn_protocols = vec![b"axon".to_vec(), b"other".to_vec()];
    config
}

/// A server as rustls has it, with certificates.
fn stock_server() -> ServerConfig {
    ServerConfig::builder_with_provider(provider(&[SHA256], &GROUPS))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Unchecked::new())
}

/// A server that was given `first` and asked for X25519, and the transcript up to there.
fn retried(config: ServerConfig, first: &ClientHello) -> (ServerConnection, Vec<u8>) {
    let mut server = ServerConnection::new(Arc::new(config)).unwrap();
    let first = first.encode();
    feed(&mut server, &records(HANDSHAKE, &first)).unwrap();
    let retry = plaintext(&written(&mut server));
    assert_eq!(&retry[6..10], [0xcf, 0x21, 0xad, 0x74], "a HelloRetryRequest");
    let asked = [0, 51, 0, 2, 0, X25519 as u8];
    assert!(retry.windows(6).any(|window| window == asked), "for X25519");
    (server, [message(254, &digest(&first)), retry].concat())
}

/// What the server says to a second ClientHello: nothing, or its alert and error.
fn refusal(
    config: ServerConfig,
    first: &ClientHello,
    second: impl FnOnce(ClientHello) -> ClientHello,
    honest: ClientHello,
) -> Option<(u8, Error)> {
    let (mut server, before) = retried(config, first);
    let second = second(ClientHello { before, ..honest });
    let error = feed(&mut server, &records(HANDSHAKE, &second.encode())).err()?;
    assert!(server.external_psk().is_none() && server.is_handshaking());
    let flight = written(&mut server);
    let [21, 3, 3, 0, 2, 2, alert] = flight[..] else {
        panic!("one alert, and nothing before it: {flight:x?}, {error}");
    };
    Some((alert, error))
}

type Second<'a> = &'a dyn Fn(ClientHello) -> ClientHello;

/// RFC 8446 4.2.8: one share, of the group that was asked for. All of these are of groups that the
/// server supports and the client listed.
#[test]
fn server_refuses_a_share_of_another_group_than_it_asked_for() {
    let p256 = p256();
    let ours = x25519();
    let wrong: &[(&str, Second<'_>)] = &[
        ("another group", &|hello| hello.with(51, &shares(&[(P256, &p256)]))),
        ("another group, preferred now", &|hello| {
            hello.with(10, &groups(&[P256, X25519])).with(51, &shares(&[(P256, &p256)]))
        }),
        ("two groups, the right one first", &|hello| {
            hello.with(51, &shares(&[(X25519, ours.pub_key()), (P256, &p256)]))
        }),
        ("two groups, the right one last", &|hello| {
            hello.with(51, &shares(&[(P256, &p256), (X25519, ours.pub_key())]))
        }),
        ("the right group and one of nobody", &|hello| {
            hello.with(51, &shares(&[(X25519, ours.pub_key()), (P384, &[4; 97])]))
        }),
        ("no share", &|hello| hello.with(51, &shares(&[]))),
        ("the share of before", &|hello| hello.with(51, &shares(&[(P384, &[4; 97])]))),
    ];
    for (what, second) in wrong {
        for stock in [false, true] {
            let (config, offers) = match stock {
                false => (external_server(), external()),
                true => (stock_server(), vec![]),
            };
            // signature_algorithms, for a server with certificates
            let with_13 = |hello: ClientHello| hello.with(13, &list16(&[4, 3]));
            let honest = with_13(hello(offers.clone(), ours.pub_key()));
            let answer = refusal(config, &with_13(first_hello(offers)), second, honest);
            let expected = PeerMisbehaved::RefusedToFollowHelloRetryRequest.into();
            assert_eq!(answer, Some((47, expected)), "{what}, without a PSK: {stock}");
        }
    }
}

/// RFC 8446 4.1.2 lists what a second ClientHello may change.
#[test]
fn server_refuses_a_second_client_hello_that_changes_more() {
    let ours = x25519();
    let honest = || hello(external(), ours.pub_key());
    let wrong: &[(&str, Second<'_>, u8)] = &[
        ("legacy_version", &|hello| ClientHello { legacy_version: 0x0302, ..hello }, 47),
        ("random", &|hello| ClientHello { random: [4; 32], ..hello }, 47),
        ("session ID", &|hello| ClientHello { session_id: vec![6; 32], ..hello }, 47),
        ("no session ID", &|hello| ClientHello { session_id: vec![], ..hello }, 47),
        ("a suite less", &|hello| ClientHello { suites: vec![0x1303], ..hello }, 47),
        ("another suite that would do", &|hello| ClientHello { suites: vec![0x1301], ..hello }, 47),
        ("suites swapped", &|hello| ClientHello { suites: vec![0x1301, 0x1303], ..hello }, 47),
        ("a group less", &|hello| hello.with(10, &groups(&[P384, X25519])), 47),
        (
            "without the group that was asked for",
            &|hello| hello.with(10, &groups(&[P384, P256])),
            47,
        ),
        ("another protocol", &|hello| hello.with(16, &list16(&list8(b"other"))), 47),
        ("no protocol", &|hello| hello.without(16), 47),
        ("an extension more", &|hello| hello.with(0xfafb, b""), 47),
        ("an unknown extension changed", &|hello| hello.with(0xfafa, b"greasE"), 47),
        ("an unknown extension left out", &|hello| hello.without(0xfafa), 47),
        ("a cookie that nobody gave", &|hello| hello.with(44, &list16(b"c")), 47),
        (
            "a server name",
            &|hello| hello.with(0, &list16(&[&[0][..], &list16(b"other")].concat())),
            47,
        ),
        ("modes", &|hello| hello.with(45, &[2, 1, 0]), 47),
        ("a mode that the server has not", &|hello| hello.with(45, &[1, 0]), 40),
        ("early data", &|hello| hello.with(42, &[]), 47),
        (
            "no PSK",
            &|hello| ClientHello { offers: vec![], ..hello }.with(13, &list16(&[4, 3])),
            109,
        ),
        ("no PSK and nothing instead", &|hello| ClientHello { offers: vec![], ..hello }, 109),
        (
            "another PSK",
            &|hello| ClientHello { offers: vec![Offer::new("c", &[3; 32])], ..hello },
            47,
        ),
        (
            "a PSK more",
            &|mut hello| {
                hello.offers.push(Offer::new("c", &[3; 32]));
                hello
            },
            47,
        ),
        (
            "PSKs swapped",
            &|mut hello| {
                hello.offers.reverse();
                hello
            },
            47,
        ),
        (
            "a PSK twice",
            &|mut hello| {
                hello.offers.push(Offer::new("b", &[2; 32]));
                hello
            },
            47,
        ),
        (
            "the binder of another secret",
            &|hello| ClientHello { offers: vec![Offer::new("a", &[2; 32])], ..hello },
            51,
        ),
        (
            "a binder over the second ClientHello alone",
            &|hello| ClientHello { before: vec![], ..hello },
            51,
        ),
    ];
    for (what, second, alert) in wrong {
        let answer = refusal(external_server(), &first_hello(external()), second, honest());
        let got = answer.as_ref().map(|(alert, _)| *alert);
        assert_eq!(got, Some(*alert), "{what}: {answer:?}");
    }

    // again the first one, as it was
    let again = refusal(
        external_server(),
        &first_hello(external()),
        |honest| ClientHello { before: honest.before, ..first_hello(external()) },
        honest(),
    );
    assert_eq!(again, Some((47, PeerMisbehaved::RefusedToFollowHelloRetryRequest.into())));
}

/// What a second ClientHello may change, and the whole handshake that follows.
#[test]
fn server_accepts_permitted_changes_in_a_second_client_hello() {
    let right: &[(&str, Second<'_>)] = &[
        ("the share alone", &|hello| hello),
        ("PSKs left out", &|mut hello| {
            hello.offers.retain(|offer| offer.identity == b"a");
            hello
        }),
        ("an age", &|mut hello| {
            hello.offers.iter_mut().for_each(|offer| offer.age = 7);
            hello
        }),
        ("padding", &|hello| hello.with(21, &[0; 40])),
    ];
    for (what, second) in right {
        // early data in the first is not repeated
        let first = first_hello(external()).with(42, &[]).with(21, &[0; 8]);
        let (mut server, before) = retried(external_server(), &first);
        let ours = x25519();
        let honest = ClientHello { before: before.clone(), ..hello(external(), ours.pub_key()) };
        let second = second(honest);
        let index = second.offers.iter().position(|offer| offer.identity == b"a").unwrap();
        let second = second.encode();
        feed(&mut server, &records(HANDSHAKE, &second))
            .unwrap_or_else(|err| panic!("{what}: {err}"));

        let flight = written(&mut server);
        let server_hello = plaintext(&flight);
        let selected = [0, 41, 0, 2, 0, index as u8];
        assert!(server_hello.windows(6).any(|window| window == selected), "{what}");
        let head = [0, 51, 0, 36, 0, 29, 0, 32];
        let at = server_hello.windows(8).position(|window| window == head).unwrap() + 8;
        let shared = ours.complete(&server_hello[at..at + 32]).unwrap();
        let transcript = [before, second, server_hello].concat();
        let mut client =
            Peer::new(Role::Client, Some(&SECRET), Some(shared.secret_bytes()), transcript);
        client.expect_finished(&flight);
        feed(&mut server, &client.finish()).unwrap();
        assert_eq!(server.external_psk().unwrap().identity(), b"a", "{what}");
    }
}

/// An honest client of a server with certificates still gets through.
#[test]
fn server_with_certificates_takes_the_share_it_asked_for() {
    let first = first_hello(vec![]).with(13, &list16(&[4, 3]));
    let (mut server, _) = retried(stock_server(), &first);
    let second = hello(vec![], x25519().pub_key()).with(13, &list16(&[4, 3]));
    feed(&mut server, &records(HANDSHAKE, &second.encode())).unwrap();
    assert_eq!(plaintext(&written(&mut server))[0], 2, "a ServerHello");
}
