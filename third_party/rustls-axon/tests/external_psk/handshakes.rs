//! Handshakes that work.

use std::io::{Read, Write};
use std::sync::Arc;

use rustls_axon::crypto::aws_lc_rs::kx_group;
use rustls_axon::external_psk::PskKeyExchangeMode;
use rustls_axon::server::Acceptor;
use rustls_axon::{ClientConfig, HandshakeKind, NamedGroup, ServerConfig};

use crate::common::*;

#[test]
fn handshakes_work() {
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
            pass(&mut client, &mut server).unwrap();
            server.reader().read_exact(&mut received).unwrap();
            assert_eq!(&received, b"ping");
            server.writer().write_all(b"pong").unwrap();
            pass(&mut server, &mut client).unwrap();
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

/// What cannot be negotiated any more is not offered again (RFC 8446, 4.1.4).
#[test]
fn second_client_hello_offers_no_psk_of_another_hash() {
    let mode = PskKeyExchangeMode::PskDheKe;
    let psks = vec![psk("the first", 1, SHA256), psk("the second", 2, SHA384)];
    let client_config = ClientConfig::builder_with_provider(provider(
        &[SHA256, SHA384],
        &[kx_group::X25519, kx_group::SECP256R1],
    ))
    .with_external_psks(psks, mode)
    .unwrap();
    let offered = |bytes: &[u8]| {
        let is_in = |identity: &[u8]| bytes.windows(identity.len()).any(|part| part == identity);
        [is_in(b"the first"), is_in(b"the second")]
    };
    for (known, secret, suite, again) in
        [("the first", 1, SHA256, [true, false]), ("the second", 2, SHA384, [false, true])]
    {
        let resolver = Known::new(vec![psk(known, secret, suite)]);
        let server_config =
            ServerConfig::builder_with_provider(provider(&[suite], &[kx_group::SECP256R1]))
                .with_external_psk_resolver(resolver, mode)
                .unwrap();
        let (mut client, mut server) = (client(client_config.clone()), server(server_config));
        let first = written(&mut client);
        assert_eq!(offered(&first), [true, true]);
        feed(&mut server, &first).unwrap();
        feed(&mut client, &written(&mut server)).unwrap();
        let second = written(&mut client);
        assert_eq!(offered(&second), again, "with {known}");
        feed(&mut server, &second).unwrap();
        handshake(&mut client, &mut server).unwrap();
    }
}

/// A server that looks at the ClientHello before it has a config.
#[test]
fn an_acceptor_works() {
    for mode in MODES {
        let mut client = client(client_config(&[SHA256], vec![psk("a", 1, SHA256)], mode));
        let mut acceptor = Acceptor::default();
        acceptor.read_tls(&mut &written(&mut client)[..]).unwrap();
        let accepted = acceptor.accept().unwrap().unwrap();
        assert_eq!(accepted.client_hello().server_name(), Some("example.com"));
        let config = server_config(&[SHA256], Known::new(vec![psk("a", 1, SHA256)]), mode);
        let Ok(mut server) = accepted.into_connection(Arc::new(config)) else {
            panic!("refused");
        };
        pass(&mut server, &mut client).unwrap();
        pass(&mut client, &mut server).unwrap();
        assert_eq!(server.external_psk().unwrap().identity(), b"a");
    }
}
