//! Streams of tokio with OpenSSL at the other end, on a pre-shared key: data, and both kinds of end.
#![cfg(all(feature = "hybrid", feature = "tokio"))]

mod peers;

use std::sync::Arc;

use axon_tls::psk::{self, PskTable};
use axon_tls::stream::{TlsAcceptor, TlsConnector, TlsStream};
use axon_tls::{Cipher, PskKex};
use peers::psk::{is_on, openssl_psk, psk};
use peers::{Peer, dial, listen, openssls, port};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

async fn accepted(program: &str, cipher: Cipher) -> (TlsStream<TcpStream>, Peer) {
    let known = PskTable::new([psk(cipher, 0)]).unwrap();
    let config = psk::server_config(Arc::new(known), cipher, PskKex::PskKe, b"").unwrap();
    let (listener, addr) = listen();
    let addr = addr.to_string();
    let args = ["s_client", "-quiet", "-connect", &addr];
    let peer = openssl_psk(program, &args, cipher, PskKex::PskKe);
    let socket = listener.accept().unwrap().0;
    socket.set_nonblocking(true).unwrap();
    let acceptor = TlsAcceptor::from(Arc::new(config));
    (acceptor.accept(TcpStream::from_std(socket).unwrap()).await.unwrap(), peer)
}

async fn connected(program: &str, cipher: Cipher) -> (TlsStream<TcpStream>, Peer) {
    let config = psk::client_config(vec![psk(cipher, 0)], PskKex::PskKe, b"").unwrap();
    let port = port();
    let addr = format!("127.0.0.1:{port}");
    let args = ["s_server", "-quiet", "-nocert", "-accept", &addr];
    let peer = openssl_psk(program, &args, cipher, PskKex::PskKe);
    let socket = dial(port);
    socket.set_nonblocking(true).unwrap();
    let connector = TlsConnector::from(Arc::new(config));
    let name = "peer".try_into().unwrap();
    (connector.connect(name, TcpStream::from_std(socket).unwrap()).await.unwrap(), peer)
}

/// Exchanges a line each way. Then the test kills the peer's process, or this end closes.
async fn talk(mut stream: TlsStream<TcpStream>, mut peer: Peer, cipher: Cipher, kill: bool) {
    is_on(stream.negotiated(), cipher, PskKex::PskKe);
    stream.write_all(b"from axon\n").await.unwrap();
    stream.flush().await.unwrap();
    peer.expect("from axon");
    peer.say("from openssl");
    let mut received = [0; 13];
    stream.read_exact(&mut received).await.unwrap();
    assert_eq!(&received, b"from openssl\n");
    if kill {
        drop(peer);
        assert!(stream.read(&mut received).await.is_err(), "the end was not announced");
    } else {
        // OpenSSL answers a close_notify with its own
        stream.shutdown().await.unwrap();
        assert_eq!(stream.read(&mut received).await.unwrap(), 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn openssl_clients_and_servers_talk_to_streams() {
    for (program, _) in openssls() {
        for cipher in Cipher::ALL {
            for kill in [false, true] {
                let (stream, peer) = accepted(&program, cipher).await;
                talk(stream, peer, cipher, kill).await;
                let (stream, peer) = connected(&program, cipher).await;
                talk(stream, peer, cipher, kill).await;
            }
        }
    }
}
