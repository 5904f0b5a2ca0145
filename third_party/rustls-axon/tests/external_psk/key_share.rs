//! Key shares: which a client sends.
//!
//! Every one of these has more than one group to go wrong with.

use std::sync::Arc;

use rustls_axon::client::{ClientSessionMemoryCache, ClientSessionStore, Resumption};
use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::NamedGroup;

use crate::common::*;
use crate::peer::plaintext;
use crate::server_hello::parts;

const MODE: PskKeyExchangeMode = PskKeyExchangeMode::PskDheKe;

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
