//! Tests that nothing is sent before the peer is known: neither a client's early data nor a server's data before the
//! client's Finished, even if the application or the peer asks for it.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::net::{Ipv4Addr, SocketAddr};

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server};
use axon_tls::{Cipher, PskKex};
use common::pair::Pair;
use common::pki::Authority;
use common::wire::{Kind, packets};
use common::{OneKey, psk, stock};
use quinn::{ClientConfig, Endpoint, ServerConfig};
use quinn_proto::{Dir, Side};

/// Returns whether the client could send early data on its first and on its second connection.
async fn early_data(client: ClientConfig, server: ServerConfig) -> [bool; 2] {
    let localhost = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let server = Endpoint::server(server, localhost).unwrap();
    let addr = server.local_addr().unwrap();
    let serving = tokio::spawn(async move {
        for _ in 0..2 {
            let conn = server.accept().await.unwrap().await.unwrap();
            let (mut send, mut receive) = conn.accept_bi().await.unwrap();
            assert_eq!(receive.read_to_end(10).await.unwrap(), b"ping");
            send.write_all(b"pong").await.unwrap();
            send.finish().unwrap();
            conn.closed().await;
        }
    });

    let endpoint = Endpoint::client(localhost).unwrap();
    let mut early = [false; 2];
    for early in &mut early {
        let conn = match endpoint.connect_with(client.clone(), addr, "axon").unwrap().into_0rtt() {
            Ok((conn, accepted)) => {
                *early = true;
                accepted.await;
                conn
            }
            Err(connecting) => connecting.await.unwrap(),
        };
        let (mut send, mut receive) = conn.open_bi().await.unwrap();
        send.write_all(b"ping").await.unwrap();
        send.finish().unwrap();
        // tickets come before the answer does
        assert_eq!(receive.read_to_end(10).await.unwrap(), b"pong");
        conn.close(0u32.into(), b"done");
    }
    endpoint.wait_idle().await;
    serving.await.unwrap();
    early
}

#[tokio::test]
async fn a_client_has_no_early_data_in_any_mode() {
    let cipher = Cipher::default();
    for kex in PskKex::ALL {
        let client = qkd_client(psk(1, cipher), kex, ALPN).unwrap();
        let server = qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
        assert_eq!(early_data(client, server).await, [false, false]);
    }
    let auth = Auth::None(SigningKey::generate().unwrap());
    let client = hybrid_client(&auth, cipher, ALPN).unwrap();
    let server = hybrid_server(&auth, cipher, ALPN).unwrap();
    assert_eq!(early_data(client, server).await, [false, false]);
}

/// With strangers that would: between two of them there is early data on the second connection.
#[tokio::test]
async fn neither_end_has_early_data_with_a_peer_that_wants_it() {
    let cipher = Cipher::default();
    let ca = Authority::new();
    let auth = ca.member(1, "axon", &ca, None);
    let (client, server) = (stock::client(&ca, ALPN, true), stock::server(&ca, ALPN, true));
    assert_eq!(early_data(client.clone(), server.clone()).await, [false, true]);

    // a new one, so that it has no ticket yet
    let client = stock::client(&ca, ALPN, true);
    let ours = hybrid_server(&auth, cipher, ALPN).unwrap();
    assert_eq!(early_data(client, ours).await, [false, false]);
    let ours = hybrid_client(&auth, cipher, ALPN).unwrap();
    assert_eq!(early_data(ours, server).await, [false, false]);
}

/// A client that has a ticket from elsewhere, and offers it with early data to our server: refused or
/// ignored, and the data with it.
#[tokio::test]
async fn early_data_on_a_ticket_from_elsewhere_is_not_accepted() {
    let ca = Authority::new();
    let client = stock::client(&ca, ALPN, true);
    assert_eq!(early_data(client.clone(), stock::server(&ca, ALPN, true)).await, [false, true]);

    let auth = ca.member(1, "axon", &ca, None);
    let server = hybrid_server(&auth, Cipher::default(), ALPN).unwrap();
    let localhost = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let server = Endpoint::server(server, localhost).unwrap();
    let addr = server.local_addr().unwrap();
    let serving = tokio::spawn(async move {
        let conn = server.accept().await.unwrap().await?;
        let mut receive = conn.accept_uni().await?;
        Ok::<_, quinn::ConnectionError>((receive.is_0rtt(), receive.read_to_end(10).await.unwrap()))
    });
    let endpoint = Endpoint::client(localhost).unwrap();
    let connecting = endpoint.connect_with(client, addr, "axon").unwrap();
    let (conn, accepted) = connecting.into_0rtt().expect("it has a ticket for the name");
    let mut early = conn.open_uni().await.unwrap();
    early.write_all(b"early").await.unwrap();
    early.finish().unwrap();
    assert!(!accepted.await);
    let mut send = conn.open_uni().await.unwrap();
    send.write_all(b"late").await.unwrap();
    send.finish().unwrap();
    let (is_early, data) = serving.await.unwrap().unwrap();
    assert!(!is_early);
    assert_eq!(data, b"late");
}

/// Returns whether a server with data to send from the start sends it before it has the client's Finished.
fn speaks_early(client: ClientConfig, server: ServerConfig) -> bool {
    let mut pair = Pair::new(server);
    pair.dial(client);
    assert!(pair.step(|_, _| {}), "the ClientHello");
    let server = pair.server.conn();
    let stream = server.streams().open(Dir::Uni).expect("the client allows it");
    server.send_stream(stream).write(b"before it is known who listens").unwrap();
    server.send_stream(stream).finish().unwrap();

    let (mut finished, mut early, mut late) = (false, false, false);
    pair.run(|from, datagram| {
        for packet in packets(datagram) {
            match (from, packet.kind) {
                // the first thing that a client says under these keys is its last flight
                (Side::Client, Kind::Handshake) => finished = true,
                (Side::Server, Kind::OneRtt) if !finished => early = true,
                (Side::Server, Kind::OneRtt) => late = true,
                (_, Kind::ZeroRtt) => panic!("early data"),
                _ => {}
            }
        }
    });
    assert!(pair.is_up());
    assert!(early || late, "the server has said it in the end");
    early
}

#[test]
fn a_server_says_nothing_before_the_client_has_finished() {
    let cipher = Cipher::default();
    let ca = Authority::new();
    assert!(
        speaks_early(stock::client(&ca, ALPN, false), stock::server(&ca, ALPN, false)),
        "or this test shows nothing"
    );
    let auth = Auth::None(SigningKey::generate().unwrap());
    let client = hybrid_client(&auth, cipher, ALPN).unwrap();
    assert!(!speaks_early(client, hybrid_server(&auth, cipher, ALPN).unwrap()));
    for kex in PskKex::ALL {
        let client = qkd_client(psk(1, cipher), kex, ALPN).unwrap();
        let server = qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
        assert!(!speaks_early(client, server));
    }
}
