//! Over QUIC: datagrams between two of quinn's endpoints without sockets, until both ends have
//! completed the handshake and the client knows that the server has.

use std::sync::Arc;

use axon_tls::identity::Auth;
use axon_tls::{Cipher, PskKex};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ClientConfig, ServerConfig};
use quinn_proto::Side;
use rustls::crypto::aws_lc_rs::cipher_suite::TLS13_AES_128_GCM_SHA256;

use super::{ALPN, Deriving, Traffic, psk};
use crate::pair::Pair;

type Handshake = Box<dyn FnMut() -> Traffic>;

fn handshakes(
    server: ServerConfig,
    mut client: impl FnMut() -> ClientConfig + 'static,
) -> Handshake {
    let mut pair = Pair::new(server);
    Box::new(move || {
        let mut traffic = Traffic::default();
        pair.dial(client());
        pair.run(|from, datagram| match from {
            Side::Client => traffic.to_server += datagram.len(),
            Side::Server => traffic.to_client += datagram.len(),
        });
        assert!(pair.is_up());
        pair.hang_up();
        traffic
    })
}

/// As quinn itself has it.
pub(super) fn stock(
    client: Arc<rustls::ClientConfig>,
    server: Arc<rustls::ServerConfig>,
) -> Handshake {
    let initial = TLS13_AES_128_GCM_SHA256.tls13().and_then(|suite| suite.quic_suite()).unwrap();
    let client =
        ClientConfig::new(Arc::new(QuicClientConfig::with_initial(client, initial).unwrap()));
    let server = QuicServerConfig::with_initial(server, initial).unwrap();
    handshakes(ServerConfig::with_crypto(Arc::new(server)), move || client.clone())
}

pub(super) fn hybrid([client, server]: [Auth; 2], cipher: Cipher) -> Handshake {
    let client = axon_tls::quic::hybrid_client(&client, cipher, ALPN).unwrap();
    let server = axon_tls::quic::hybrid_server(&server, cipher, ALPN).unwrap();
    handshakes(server, move || client.clone())
}

pub(super) fn qkd(cipher: Cipher, kex: PskKex) -> Handshake {
    let resolver = Arc::new(Deriving(cipher));
    let server = axon_tls::quic::qkd_server(resolver, cipher, kex, ALPN).unwrap();
    handshakes(server, move || axon_tls::quic::qkd_client(psk(cipher), kex, ALPN).unwrap())
}
