//! Tests the ServerHello on the wire in every mode, over TCP and QUIC.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::sync::Arc;

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server};
use axon_tls::{Cipher, PskKex, hybrid, qkd};
use common::hello::{in_record, is_server_hello};
use common::pair::Pair;
use common::wire::{CryptoStream, InitialKeys, Kind, packets};
use common::{OneKey, psk};
use quinn_proto::Side;

/// Returns a server's answer to a client, up to the end of the first record.
macro_rules! over_tcp {
    ($tls:ident, $client:expr, $server:expr) => {{
        let name = "axon".try_into().unwrap();
        let mut client = $tls::ClientConnection::new(Arc::new($client), name).unwrap();
        let mut server = $tls::ServerConnection::new(Arc::new($server)).unwrap();
        let (mut hello, mut answer) = (Vec::new(), Vec::new());
        client.write_tls(&mut hello).unwrap();
        server.read_tls(&mut &hello[..]).unwrap();
        server.process_new_packets().unwrap();
        server.write_tls(&mut answer).unwrap();
        in_record(&answer).to_vec()
    }};
}

#[test]
fn qkd_modes() {
    for cipher in Cipher::ALL {
        for kex in PskKex::ALL {
            let key = || OneKey::new(psk(1, cipher));
            let client = qkd::client_config(psk(1, cipher), kex, ALPN).unwrap();
            let server = qkd::server_config(key(), cipher, kex, ALPN).unwrap();
            is_server_hello(&over_tcp!(rustls_axon, client, server), cipher, Some(kex));

            let client = qkd_client(psk(1, cipher), kex, ALPN).unwrap();
            let server = qkd_server(key(), cipher, kex, ALPN).unwrap();
            is_server_hello(&over_quic(client, server), cipher, Some(kex));
        }
    }
}

#[test]
fn hybrid_mode() {
    let auth = Auth::None(SigningKey::generate().unwrap());
    for cipher in Cipher::ALL {
        let client = hybrid::client_config(&auth, cipher, ALPN).unwrap();
        let server = hybrid::server_config(&auth, cipher, ALPN).unwrap();
        is_server_hello(&over_tcp!(rustls, client, server), cipher, None);

        let client = hybrid_client(&auth, cipher, ALPN).unwrap();
        let server = hybrid_server(&auth, cipher, ALPN).unwrap();
        is_server_hello(&over_quic(client, server), cipher, None);
    }
}

/// Returns the data of the CRYPTO frames in the server's Initial packets, from a handshake that completes.
fn over_quic(client: quinn::ClientConfig, server: quinn::ServerConfig) -> Vec<u8> {
    let mut pair = Pair::new(server);
    let (mut keys, mut crypto) = (None, CryptoStream::default());
    pair.dial(client);
    pair.run(|from, datagram| {
        for packet in packets(datagram).iter().filter(|packet| packet.kind == Kind::Initial) {
            match from {
                // the connection ID of the first one makes the keys of all
                Side::Client => {
                    let _ = keys.get_or_insert_with(|| InitialKeys::server(packet.dst_cid));
                }
                Side::Server => crypto.take_from(&keys.as_ref().unwrap().open(packet)),
            }
        }
    });
    assert!(pair.is_up());
    crypto.bytes()
}
