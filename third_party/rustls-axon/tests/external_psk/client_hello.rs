//! What a server makes of a ClientHello.

use std::sync::Arc;

use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::crypto::SupportedKxGroup;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::server::Acceptor;
use rustls_axon::{
    AlertDescription, ClientConfig, Error, InvalidMessage, PeerIncompatible, PeerMisbehaved,
    ServerConnection,
};

use crate::common::*;
use crate::peer::{
    digest, list16, list8, message, plaintext, records, ClientHello, Offer, Peer, Role, HANDSHAKE,
};
use crate::resumption::stock_server;

const SECRET: [u8; 32] = [1; 32];

fn offer() -> ClientHello {
    ClientHello::new(vec![Offer::new("a", &SECRET)])
}

/// An offer of `a` in psk_dhe_ke, with the group X25519.
fn offer_with_share() -> ClientHello {
    let share = kx_group::X25519.start().unwrap();
    offer().in_psk_dhe_ke(29, share.pub_key())
}

/// What a server that knows `a` makes of it in a mode: its flight, or its alert and error.
fn answer(mode: PskKeyExchangeMode, hello: &[u8]) -> Result<Vec<u8>, (u8, Error)> {
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    // in psk_ke, too: it could send a share, and must not
    let mut server = server(server_config_over(&[SHA256], &[kx_group::X25519], resolver, mode));
    let result = feed(&mut server, &records(HANDSHAKE, hello));
    let flight = written(&mut server);
    assert!(server.is_handshaking() && server.external_psk().is_none());
    match result {
        Ok(()) => Ok(flight),
        Err(error) => {
            let [21, 3, 3, 0, 2, 2, alert] = flight[..] else {
                panic!("one alert, and nothing before it: {flight:x?}");
            };
            Err((alert, error))
        }
    }
}

fn alert(mode: PskKeyExchangeMode, hello: &ClientHello) -> Option<u8> {
    answer(mode, &hello.encode()).err().map(|(alert, _)| alert)
}

#[test]
fn server_refuses_malformed_offers() {
    let [psk_ke, psk_dhe_ke] = MODES;
    let two = || vec![Offer::new("a", &SECRET), Offer::new("b", &[2; 32])];
    let last_is_not_psk = {
        let mut hello = offer();
        let encoded = hello.encode();
        // `pre_shared_key` as it was made, and then a `cookie`
        hello.extensions.push((41, encoded[encoded.len() - 44..].to_vec()));
        hello.extensions.push((44, list16(b"c")));
        ClientHello { offers: vec![], ..hello }
    };
    let twice = {
        let encoded = offer().encode();
        let mut hello = offer();
        hello.extensions.push((41, encoded[encoded.len() - 44..].to_vec()));
        hello
    };

    for (what, mode, hello, expected) in [
        (
            "no offer",
            psk_ke,
            ClientHello { offers: vec![], ..offer() }.with(13, &list16(&[4, 3])),
            109,
        ),
        // RFC 8446 9.2: nothing to authenticate with at all
        ("no offer", psk_ke, ClientHello { offers: vec![], ..offer() }, 109),
        ("no offer", psk_dhe_ke, ClientHello { offers: vec![], ..offer_with_share() }, 109),
        ("no modes", psk_ke, offer().without(45), 109),
        ("no modes", psk_dhe_ke, offer_with_share().without(45), 109),
        ("an empty list of modes", psk_ke, offer().with(45, &[0]), 50),
        ("no mode that exists", psk_ke, offer().with(45, &[2, 7, 0xff]), 40),
        ("the other mode", psk_ke, offer_with_share(), 40),
        ("the other mode", psk_dhe_ke, offer(), 40),
        ("pre_shared_key is not last", psk_ke, last_is_not_psk, 47),
        ("pre_shared_key twice", psk_ke, twice, 47),
        (
            "a binder too few",
            psk_ke,
            ClientHello { offers: two(), binders: Some(vec![vec![9; 32]]), ..offer() },
            47,
        ),
        (
            "a binder too many",
            psk_ke,
            ClientHello { binders: Some(vec![vec![9; 32]; 2]), ..offer() },
            47,
        ),
        ("no binders", psk_ke, ClientHello { binders: Some(vec![]), ..offer() }, 50),
        ("an empty binder", psk_ke, ClientHello { binders: Some(vec![vec![]]), ..offer() }, 50),
        ("no identities", psk_ke, no_identities(), 50),
        ("an empty identity", psk_ke, ClientHello::new(vec![Offer::new("", &SECRET)]), 50),
        ("no TLS 1.3", psk_ke, offer().with(43, &[2, 3, 3]), 70),
        ("no supported_versions", psk_ke, offer().without(43), 70),
        ("no suite in common", psk_ke, ClientHello { suites: vec![0x1301, 0xc02b], ..offer() }, 40),
        ("a suite of another hash", psk_ke, ClientHello { suites: vec![0x1302], ..offer() }, 40),
        ("compression", psk_ke, ClientHello { compression: vec![0, 1], ..offer() }, 47),
        ("compression alone", psk_ke, ClientHello { compression: vec![1], ..offer() }, 47),
        ("no share and no groups", psk_dhe_ke, offer().with(45, &[1, 1]), 109),
        ("a share without groups", psk_dhe_ke, offer_with_share().without(10), 109),
        ("a share without groups", psk_ke, offer_with_share().with(45, &[1, 0]).without(10), 109),
        // as GnuTLS with `-GROUP-ALL`
        ("an empty list of shares without groups", psk_ke, offer().with(51, &[0, 0]), 109),
        ("groups without a share", psk_dhe_ke, offer_with_share().without(51), 109),
        ("groups without a share", psk_ke, offer_with_share().with(45, &[1, 0]).without(51), 109),
        ("no group in common", psk_dhe_ke, offer().in_psk_dhe_ke(30, &[9; 56]), 40),
        ("a share of the wrong length", psk_dhe_ke, offer().in_psk_dhe_ke(29, &[9; 31]), 47),
        ("a share that gives zeros", psk_dhe_ke, offer().in_psk_dhe_ke(29, &[0; 32]), 47),
        (
            "a share of a group that is not listed",
            psk_dhe_ke,
            offer_with_share().with(10, &list16(&[0, 23])),
            40,
        ),
        (
            "two shares of one group",
            psk_dhe_ke,
            {
                let share = [&[0, 29][..], &list16(&[9; 32])].concat();
                offer_with_share().with(51, &list16(&share.repeat(2)))
            },
            47,
        ),
    ] {
        let answered = answer(mode, &hello.encode());
        let got = answered.as_ref().err().map(|(alert, _)| *alert);
        assert_eq!(got, Some(expected), "{what} in {mode:?}: {answered:?}");
    }
}

/// A `pre_shared_key` with a binder, and no identity that it could be for.
fn no_identities() -> ClientHello {
    let offer = [list16(&[]), list16(&list8(&[9; 32]))].concat();
    ClientHello { offers: vec![], ..offer_with_share() }.with(41, &offer)
}

#[test]
fn server_refuses_wrong_binders() {
    let [psk_ke, _] = MODES;
    let of = |offers| ClientHello::new(offers);
    let a = || Offer::new("a", &SECRET);
    let b = || Offer::new("b", &[2; 32]);
    let binder = |secret: &[u8], label| {
        // over a ClientHello that is another: anything but what it has to be over
        crate::peer::Early::new(Some(secret)).binder(label, &digest(b"")).to_vec()
    };

    for (what, hello, expected) in [
        ("another secret", of(vec![Offer::new("a", &[2; 32])]), 51),
        ("no secret", of(vec![Offer::new("a", &[])]), 51),
        ("the label of resumption", of(vec![Offer { label: "res binder", ..a() }]), 51),
        ("the label of imported PSKs", of(vec![Offer { label: "imp binder", ..a() }]), 51),
        (
            "over something else",
            ClientHello { binders: Some(vec![binder(&SECRET, "ext binder")]), ..offer() },
            51,
        ),
        ("zeros", ClientHello { binders: Some(vec![vec![0; 32]]), ..offer() }, 51),
        (
            "of another hash's length",
            ClientHello { binders: Some(vec![vec![9; 48]]), ..offer() },
            51,
        ),
        (
            "shorter than binders are",
            ClientHello { binders: Some(vec![vec![9; 31]]), ..offer() },
            51,
        ),
        ("as long as can be", ClientHello { binders: Some(vec![vec![9; 255]]), ..offer() }, 51),
        // the server knows `a`: who has another PSK cannot use its name
        ("names swapped", of(vec![Offer::new("b", &SECRET), Offer::new("a", &[2; 32])]), 51),
        ("an unknown name", of(vec![b()]), 115),
        ("the known name, in capitals", of(vec![Offer::new("A", &SECRET)]), 115),
        ("the known name, longer", of(vec![Offer::new("a\0", &SECRET)]), 115),
    ] {
        assert_eq!(alert(psk_ke, &hello), Some(expected), "{what}");
    }

    // binders of PSKs that are not selected are not looked at
    for hello in [of(vec![a(), b()]), of(vec![b(), a()])] {
        let index = hello.offers.iter().position(|offer| offer.identity == b"a").unwrap();
        assert!(selects(&hello, index));
    }
}

/// Whether the server answers with a handshake on the PSK at `index`, and nobody else's.
fn selects(hello: &ClientHello, index: usize) -> bool {
    let hello_bytes = hello.encode();
    let flight = answer(PskKeyExchangeMode::PskKe, &hello_bytes).unwrap();
    let server_hello = plaintext(&flight);
    let selected = [&[0, 41, 0, 2][..], &(index as u16).to_be_bytes()].concat();
    // `supported_versions` and the selection, and no share
    assert_eq!(server_hello.len(), 4 + 2 + 32 + 33 + 2 + 1 + 2 + 6 + 6);
    let transcript = [&hello_bytes[..], &server_hello].concat();
    let secret = &hello.offers[index].secret;
    let mut client = Peer::new(Role::Client, Some(secret), None, transcript);
    // the Finished is right, no extension was added, no certificate was sent
    assert_eq!(client.expect_finished(&flight), message(8, &[0, 0]));
    server_hello.windows(6).any(|window| window == selected)
}

#[test]
fn server_takes_unusual_offers_that_are_right() {
    let a = || Offer::new("a", &SECRET);
    for (what, hello) in [
        ("an age", ClientHello::new(vec![Offer { age: 0xffff_ffff, ..a() }])),
        ("both modes", offer().with(45, &[2, 1, 0])),
        ("modes that do not exist", offer().with(45, &[3, 0x0b, 0, 0xff])),
        ("a version that does not exist", offer().with(43, &[4, 0x7a, 0x7a, 3, 4])),
        ("extensions that do not exist", offer().with(0xfafa, b"grease")),
        ("types of certificates", offer().with(19, &[2, 2, 0]).with(20, &[2, 0, 2])),
        ("raw public keys alone", offer().with(19, &[1, 2]).with(20, &[1, 2])),
        ("OCSP, SCTs and compression", {
            let hello = offer().with(5, &[1, 0, 0, 0, 0]).with(18, &[]);
            hello.with(27, &[2, 0, 1]).with(28, &[0x40, 0])
        }),
        ("groups and a share that psk_ke does not use", offer_with_share().with(45, &[2, 0, 1])),
        ("no share for its groups yet", offer_with_share().with(45, &[1, 0]).with(51, &[0, 0])),
        ("early data", offer().with(42, &[])),
        ("twice the same", ClientHello::new(vec![a(), a()])),
    ] {
        assert!(selects(&hello, 0), "{what}");
    }
}

/// 64 KiB is what rustls lets a handshake message have: an identity, or many, can fill it.
#[test]
fn server_bears_long_and_many_identities() {
    let [psk_ke, _] = MODES;
    let longest = 65_000;
    let unknown = ClientHello::new(vec![Offer::new(vec![b'x'; longest], &SECRET)]);
    assert_eq!(alert(psk_ke, &unknown), Some(115));
    let beside =
        ClientHello::new(vec![Offer::new(vec![b'x'; longest], &SECRET), Offer::new("a", &SECRET)]);
    assert!(selects(&beside, 1));

    let many: Vec<Offer> = (0..1_500_u16)
        .map(|number| Offer::new(number.to_be_bytes().map(|b| b | 0x80), &[9]))
        .chain([Offer::new("a", &SECRET)])
        .collect();
    let binders = Some(vec![vec![9; 32]; many.len()]);
    let unbound = ClientHello { binders, ..ClientHello::new(many.clone()) };
    assert_eq!(alert(psk_ke, &unbound), Some(51));
    assert!(selects(&ClientHello::new(many.clone()), 1_500));
    assert_eq!(alert(psk_ke, &ClientHello::new(many[..1_500].to_vec())), Some(115));

    // an identity of 65,535 bytes: the list and the extension around it cannot say their length
    let mut wrapped = vec![0xff, 0xff, 0xff, 0xff];
    wrapped.extend(vec![b'x'; 60_000]);
    let lying = ClientHello { offers: vec![], ..offer_with_share() }.with(41, &wrapped);
    assert_eq!(alert(psk_ke, &lying), Some(50));
    // and a message beyond the limit is not even waited for
    let announced = records(HANDSHAKE, &[&[1, 1, 0, 0][..], &[0; 100]].concat());
    let mut server = server(server_config(&[SHA256], Known::new(vec![]), psk_ke));
    let error = InvalidMessage::HandshakePayloadTooLarge.into();
    assert_eq!(feed(&mut server, &announced), Err(error));
}

/// Who connects to itself, or is connected to itself (the Selfie attack).
#[test]
fn reflected_flights_are_refused() {
    for mode in MODES {
        // its own ClientHello is no answer to it
        let mut client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let hello = written(&mut client);
        assert!(feed(&mut client, &hello).is_err());
        assert_eq!(written(&mut client).last(), Some(&10));

        // keys whose names have the roles in them: a node that is both ends finds none
        let mut client = self::client(client_config(
            &[SHA256],
            vec![psk("client node, server other", 1, SHA256)],
            mode,
        ));
        let resolver = Known::new(vec![psk("client other, server node", 1, SHA256)]);
        let mut server = server(server_config(&[SHA256], resolver, mode));
        assert!(pass(&mut client, &mut server).is_err());
        assert_eq!(written(&mut server).last(), Some(&115));

        // and a server does not take its own flight for a client's
        let mut client = self::client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut server = self::server(server_config(&[SHA256], resolver, mode));
        pass(&mut client, &mut server).unwrap();
        let flight = written(&mut server);
        assert!(feed(&mut server, &flight).is_err());
        assert!(server.external_psk().is_none());
    }
}

/// Each prefix of a ClientHello, as a message that says its shorter length.
#[test]
fn server_refuses_every_shortened_client_hello() {
    let whole = offer().encode();
    for len in 0..whole.len() - 4 {
        let shortened = message(1, &whole[4..][..len]);
        let (alert, error) = answer(MODES[0], &shortened).unwrap_err();
        // without extensions it is a ClientHello of TLS 1.2
        let expected = if len == 2 + 32 + 33 + 4 + 2 { 70 } else { 50 };
        assert_eq!(alert, expected, "{len} of {}: {error}", whole.len() - 4);
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
    assert!(feed(&mut server(), &hello).is_ok());
    // the record header is not authenticated
    for at in 5..hello.len() {
        let mut changed = hello.clone();
        changed[at] ^= 0x01;
        let mut server = server();
        let refused = feed(&mut server, &changed).is_err();
        assert!(refused || server.wants_read() && !server.wants_write(), "byte {at}");

        let mut truncated = hello[..at].to_vec();
        let len = (at - 5) as u16;
        truncated[3..5].copy_from_slice(&len.to_be_bytes());
        let mut server = self::server(server_config(&[SHA256], resolver.clone(), MODES[0]));
        let _ = feed(&mut server, &truncated);
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
        assert_eq!(pass(&mut client, &mut server), Err(error));
        assert_eq!(pass(&mut server, &mut client), Err(Error::AlertReceived(alert)));
    }
}

/// RFC 8446 9.2: a ClientHello with neither `pre_shared_key` nor `signature_algorithms`. What is
/// missing depends on the config, which an acceptor has not yet.
#[test]
fn server_refuses_a_client_that_offers_no_authentication() {
    let hello = ClientHello { offers: vec![], ..offer_with_share() }.encode();
    let external = server_config(&[SHA256], Known::new(vec![psk("a", 1, SHA256)]), MODES[0]);
    for (config, error, alert) in [
        (Arc::new(external), PeerIncompatible::ExternalPskRequired, 109),
        // rustls's own answer
        (stock_server(), PeerIncompatible::SignatureAlgorithmsExtensionRequired, 40),
    ] {
        let error = Error::from(error);
        let sent = [21, 3, 3, 0, 2, 2, alert];
        let mut server = ServerConnection::new(config.clone()).unwrap();
        assert_eq!(feed(&mut server, &records(HANDSHAKE, &hello)), Err(error.clone()));
        assert_eq!(written(&mut server), sent);

        let mut acceptor = Acceptor::default();
        acceptor.read_tls(&mut &records(HANDSHAKE, &hello)[..]).unwrap();
        let accepted = acceptor.accept().unwrap().unwrap();
        let Err((refused, mut said)) = accepted.into_connection(config) else {
            panic!("accepted");
        };
        assert_eq!(refused, error);
        let mut flight = Vec::new();
        said.write_all(&mut flight).unwrap();
        assert_eq!(flight, sent);
    }
}
