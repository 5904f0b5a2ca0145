//! Key shares: which a client sends, which a server takes, and what it answers with.
//!
//! Every one of these has more than one group to go wrong with.

use std::sync::Arc;

use rustls_axon::client::{ClientSessionMemoryCache, ClientSessionStore, Resumption};
use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::crypto::{ActiveKeyExchange, SupportedKxGroup};
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::NamedGroup;

use crate::common::*;
use crate::peer::{plaintext, records, ClientHello, Offer, Peer, Role, HANDSHAKE};
use crate::second_client_hello::{groups, shares};
use crate::server_hello::parts;

const MODE: PskKeyExchangeMode = PskKeyExchangeMode::PskDheKe;
const SECRET: [u8; 32] = [1; 32];
const X25519: u16 = 29;
const P256: u16 = 23;

fn group(id: u16) -> &'static dyn SupportedKxGroup {
    match id {
        X25519 => kx_group::X25519,
        P256 => kx_group::SECP256R1,
        _ => panic!("no group {id}"),
    }
}

/// The groups that a ClientHello lists, and those that it has shares of.
fn listed_and_shared(hello: &[u8]) -> (Vec<u16>, Vec<u16>) {
    let (_, extensions) = parts(hello);
    // without the length of the list
    let list = |wanted: u16| {
        let (_, data) = extensions.iter().find(|(kind, _)| *kind == wanted).unwrap();
        data[2..].to_vec()
    };
    let number = |bytes: &[u8]| u16::from_be_bytes([bytes[0], bytes[1]]);
    let listed = list(10).chunks(2).map(number).collect();
    let (entries, mut shared) = (list(51), Vec::new());
    let mut rest = &entries[..];
    while !rest.is_empty() {
        shared.push(number(rest));
        rest = &rest[4 + usize::from(number(&rest[2..]))..];
    }
    (listed, shared)
}

/// RFC 8446 4.2.8: shares are of listed groups, in their order, and made independently. With one
/// share that holds: rustls adds the X25519 part of a hybrid one, and would begin with what it
/// learned of a server.
#[test]
fn client_sends_one_share_of_its_first_group() {
    let (hybrid, x25519, p256) = (HYBRID, kx_group::X25519, kx_group::SECP256R1);
    for (offered, hint) in [
        ([hybrid, p256, x25519], None),
        ([x25519, p256, hybrid], None),
        ([x25519, p256, hybrid], Some(NamedGroup::X25519MLKEM768)),
        ([p256, x25519, hybrid], Some(NamedGroup::X25519)),
    ] {
        let psks = vec![psk("a", 1, SHA256)];
        let mut config = client_config_over(&[SHA256], &offered, psks, MODE);
        if let Some(hint) = hint {
            let store = Arc::new(ClientSessionMemoryCache::new(8));
            store.set_kx_hint("example.com".try_into().unwrap(), hint);
            config.resumption = Resumption::store(store);
        }
        let mut client = client(config);
        let (listed, shared) = listed_and_shared(&plaintext(&written(&mut client)));
        assert_eq!(listed, offered.map(|group| u16::from(group.name())));
        assert_eq!(shared, listed[..1], "{offered:?}, {hint:?}");
    }
}

/// Whatever group of the client's a server has alone, and wherever the client lists it: at once, or
/// after a HelloRetryRequest that is answered with one share.
#[test]
fn every_group_that_is_offered_can_be_selected() {
    let (hybrid, x25519, p256) = (HYBRID, kx_group::X25519, kx_group::SECP256R1);
    for offered in [[hybrid, x25519, p256], [x25519, p256, hybrid], [p256, hybrid, x25519]] {
        for selected in offered {
            let psks = vec![psk("a", 1, SHA256)];
            let client_config = client_config_over(&[SHA256], &offered, psks.clone(), MODE);
            let server_config = server_config_over(&[SHA256], &[selected], Known::new(psks), MODE);
            let (mut client, mut server) = (client(client_config), server(server_config));
            handshake(&mut client, &mut server)
                .unwrap_or_else(|err| panic!("{selected:?} of {offered:?}: {err}"));
            for used in
                [client.negotiated_key_exchange_group(), server.negotiated_key_exchange_group()]
            {
                assert_eq!(used.unwrap().name(), selected.name());
            }
        }
    }
}

fn hello(listed: &[u16], shared: &[(u16, &[u8])]) -> ClientHello {
    ClientHello::new(vec![Offer::new("a", &SECRET)])
        .with(45, &[1, 1])
        .with(10, &groups(listed))
        .with(51, &shares(shared))
}

/// The group of the share in the answer is one that the client listed and has a share of, and the
/// keys are those of both shares.
#[test]
fn server_answers_with_a_share_of_the_group_that_it_selected() {
    type Groups = &'static [u16];
    let cases: [(Groups, Groups, Groups, u16); 6] = [
        // with shares of both the order of the server counts
        (&[X25519, P256], &[P256, X25519], &[P256, X25519], X25519),
        (&[P256, X25519], &[X25519, P256], &[X25519, P256], P256),
        // a share that is there counts more
        (&[P256, X25519], &[P256, X25519], &[X25519], X25519),
        (&[X25519, P256], &[X25519, P256], &[P256], P256),
        // and one of a group that is not listed does not count
        (&[P256, X25519], &[X25519], &[P256, X25519], X25519),
        (&[X25519, P256], &[P256], &[X25519, P256], P256),
    ];
    for (of_server, listed, shared, selected) in cases {
        let what = format!("{of_server:?}, {listed:?}, {shared:?}");
        let ours: Vec<(u16, Box<dyn ActiveKeyExchange>)> =
            shared.iter().map(|id| (*id, group(*id).start().unwrap())).collect();
        let entries: Vec<(u16, &[u8])> = ours.iter().map(|(id, kx)| (*id, kx.pub_key())).collect();
        let hello = hello(listed, &entries).encode();

        let of_server: Vec<_> = of_server.iter().map(|id| group(*id)).collect();
        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let mut server = server(server_config_over(&[SHA256], &of_server, resolver, MODE));
        feed(&mut server, &records(HANDSHAKE, &hello)).unwrap();
        let flight = written(&mut server);
        let server_hello = plaintext(&flight);
        assert_ne!(&server_hello[6..10], [0xcf, 0x21, 0xad, 0x74], "a HelloRetryRequest: {what}");

        let len: u8 = if selected == X25519 { 32 } else { 65 };
        let head = [0, 51, 0, len + 4, 0, selected as u8, 0, len];
        let at = server_hello.windows(8).position(|window| window == head).expect(&what) + 8;
        let (_, ours) = ours.into_iter().find(|(id, _)| *id == selected).unwrap();
        let exchanged = ours.complete(&server_hello[at..][..usize::from(len)]).unwrap();

        let transcript = [hello, server_hello].concat();
        let mut client =
            Peer::new(Role::Client, Some(&SECRET), Some(exchanged.secret_bytes()), transcript);
        client.expect_finished(&flight);
        feed(&mut server, &client.finish()).unwrap();
        let used = server.negotiated_key_exchange_group().unwrap().name();
        assert_eq!(u16::from(used), selected, "{what}");
    }
}

/// RFC 8446 4.2.8.2: a share of P-256 is a point of the curve, uncompressed; X25519 has 32 bytes.
#[test]
fn server_refuses_shares_that_are_none() {
    let right = group(P256).start().unwrap().pub_key().to_vec();
    let changed = |at: usize, to: u8| {
        let mut share = right.clone();
        share[at] = to;
        share
    };
    let compressed = [&[2 + (right[64] & 1)][..], &right[1..33]].concat();
    for (what, id, share) in [
        ("not on the curve", P256, changed(64, right[64] ^ 1)),
        ("compressed", P256, compressed),
        ("hybrid in form", P256, changed(0, 6 + (right[64] & 1))),
        ("the point at infinity", P256, vec![0]),
        ("short", P256, right[..64].to_vec()),
        ("long", P256, [&right[..], &[0]].concat()),
        ("short", X25519, vec![9; 31]),
        ("long", X25519, vec![9; 33]),
        ("gives zeros", X25519, vec![0; 32]),
    ] {
        let resolver = Known::new(vec![psk("a", 1, SHA256)]);
        let both = [group(X25519), group(P256)];
        let mut server = server(server_config_over(&[SHA256], &both, resolver, MODE));
        let hello = hello(&[id], &[(id, &share)]).encode();
        let refused = feed(&mut server, &records(HANDSHAKE, &hello));
        assert!(refused.is_err(), "{what}, {id}");
        assert_eq!(written(&mut server), [21, 3, 3, 0, 2, 2, 47], "{what}, {id}: {refused:?}");
    }
    // it is the share that was wrong
    let resolver = Known::new(vec![psk("a", 1, SHA256)]);
    let mut server = server(server_config_over(&[SHA256], &[group(P256)], resolver, MODE));
    let hello = hello(&[P256], &[(P256, &right)]).encode();
    feed(&mut server, &records(HANDSHAKE, &hello)).unwrap();
}
