//! Over TCP: TLS records through buffers.

use std::sync::Arc;

use axon_tls::identity::Auth;
use axon_tls::{Cipher, PskKex};

use super::{ALPN, Deriving, Traffic, psk};

type Handshake = Box<dyn FnMut() -> Traffic>;

/// The two rustls have the same interface in different types.
macro_rules! handshake {
    ($name:ident, $tls:ident) => {
        fn $name(client: Arc<$tls::ClientConfig>, server: Arc<$tls::ServerConfig>) -> Traffic {
            let name = "axon".try_into().unwrap();
            let mut client = $tls::ClientConnection::new(client, name).unwrap();
            let mut server = $tls::ServerConnection::new(server).unwrap();
            let mut traffic = Traffic::default();
            let mut records = Vec::new();
            while client.is_handshaking() || server.is_handshaking() {
                while client.wants_write() {
                    traffic.to_server += client.write_tls(&mut records).unwrap();
                }
                let mut unread = &records[..];
                while !unread.is_empty() {
                    server.read_tls(&mut unread).unwrap();
                    server.process_new_packets().unwrap();
                }
                records.clear();
                while server.wants_write() {
                    traffic.to_client += server.write_tls(&mut records).unwrap();
                }
                let mut unread = &records[..];
                while !unread.is_empty() {
                    client.read_tls(&mut unread).unwrap();
                    client.process_new_packets().unwrap();
                }
                records.clear();
            }
            traffic
        }
    };
}

handshake!(on_rustls, rustls);
handshake!(on_rustls_axon, rustls_axon);

pub(super) fn stock(
    client: Arc<rustls::ClientConfig>,
    server: Arc<rustls::ServerConfig>,
) -> Handshake {
    Box::new(move || on_rustls(Arc::clone(&client), Arc::clone(&server)))
}

pub(super) fn hybrid([client, server]: [Auth; 2], cipher: Cipher) -> Handshake {
    let client = Arc::new(axon_tls::hybrid::client_config(&client, cipher, ALPN).unwrap());
    let server = Arc::new(axon_tls::hybrid::server_config(&server, cipher, ALPN).unwrap());
    stock(client, server)
}

pub(super) fn qkd(cipher: Cipher, kex: PskKex) -> Handshake {
    let resolver = Arc::new(Deriving(cipher));
    let server = axon_tls::qkd::server_config(resolver, cipher, kex, ALPN).unwrap();
    let server = Arc::new(server);
    Box::new(move || {
        let client = axon_tls::qkd::client_config(psk(cipher), kex, ALPN).unwrap();
        on_rustls_axon(Arc::new(client), Arc::clone(&server))
    })
}
