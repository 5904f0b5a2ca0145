//! Keys of QUIC in memory: updates, Retry packets, and handshakes that somebody meddles with.
#![cfg(all(feature = "hybrid", feature = "quic"))]

mod common;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{ALPN, hybrid_client, hybrid_server, qkd_client, qkd_server};
use axon_tls::{Cipher, KeyExchange, PskKex, qkd, quic};
use common::hello::APPLICATION_LAYER_PROTOCOL_NEGOTIATION;
use common::meddle::{Meddler, meddle};
use common::pair::{End, Pair};
use common::wire::{Kind, Reader, packets};
use common::{OneKey, psk};
use quinn::{ClientConfig, ServerConfig};
use quinn_proto::transport_parameters::TransportParameters;
use quinn_proto::{Dir, Side, TransportErrorCode};
use rustls_axon::quic::{ClientConnection, Version};

const NO_APPLICATION_PROTOCOL: u8 = 120;

/// Returns client and server in every mode with every cipher.
fn modes() -> Vec<(ClientConfig, ServerConfig, KeyExchange)> {
    let auth = Auth::None(SigningKey::generate().unwrap());
    let mut modes = Vec::new();
    for cipher in Cipher::ALL {
        for (kex, exchange) in
            [(PskKex::PskKe, KeyExchange::PskKe), (PskKex::PskDheKe, KeyExchange::PskDheKe)]
        {
            let client = qkd_client(psk(1, cipher), kex, ALPN).unwrap();
            let server = qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
            modes.push((client, server, exchange));
        }
        let client = hybrid_client(&auth, cipher, ALPN).unwrap();
        let server = hybrid_server(&auth, cipher, ALPN).unwrap();
        modes.push((client, server, KeyExchange::X25519MlKem768));
    }
    modes
}

#[derive(Default)]
struct Counting {
    updates: usize,
}

impl Meddler for Counting {
    fn next_keys(&mut self) {
        self.updates += 1;
    }
}

/// Exchanges data in each direction, over new streams.
fn exchange(pair: &mut Pair) {
    let say = |end: &mut End| {
        let stream = end.conn().streams().open(Dir::Uni).unwrap();
        end.conn().send_stream(stream).write(b"still there?").unwrap();
        end.conn().send_stream(stream).finish().unwrap();
    };
    let hear = |end: &mut End| {
        let stream = end.conn().streams().accept(Dir::Uni).expect("it has come");
        let mut receive = end.conn().recv_stream(stream);
        let mut chunks = receive.read(true).unwrap();
        let chunk = chunks.next(100).unwrap().unwrap();
        assert_eq!(chunk.bytes, &b"still there?"[..]);
        let _ = chunks.finalize();
    };
    say(&mut pair.client);
    say(&mut pair.server);
    pair.run(|_, _| {});
    hear(&mut pair.client);
    hear(&mut pair.server);
}

#[test]
fn keys_are_updated_again_and_again_from_either_end() {
    for (client, mut server, _) in modes() {
        let counting = Arc::new(Mutex::new(Counting::default()));
        meddle(&mut server, Arc::clone(&counting));
        let mut pair = Pair::new(server);
        pair.dial(client);
        pair.run(|_, _| {});
        assert!(pair.is_up());
        exchange(&mut pair);
        let before = counting.lock().unwrap().updates;

        for update in 1..=6 {
            // the keys before the last ones are kept for a moment, and another update waits for it
            pair.pass(Duration::from_millis(50));
            pair.run(|_, _| {});
            pair.pass(Duration::from_secs(10));
            let end = if update % 2 == 0 { &mut pair.client } else { &mut pair.server };
            end.conn().force_key_update();
            exchange(&mut pair);
            assert_eq!(
                counting.lock().unwrap().updates,
                before + update,
                "the server too has new keys"
            );
        }
        assert!(pair.is_up());
    }
}

/// Data under keys that the receiver does not have yet, or no more, is as good as noise.
#[test]
fn changed_packets_are_dropped_and_the_connection_goes_on() {
    for (client, server, _) in modes() {
        let mut pair = Pair::new(server);
        pair.dial(client);
        pair.run(|_, _| {});
        assert!(pair.is_up());
        pair.client.conn().ping();
        pair.run(|_, datagram| {
            let last = datagram.len() - 1;
            datagram[last] ^= 1;
        });
        assert!(pair.is_up());
        exchange(&mut pair);
    }
}

#[test]
fn a_changed_retry_is_not_followed() {
    for (client, server, _) in modes() {
        // where a bit is changed in the Retry, if anywhere
        let follows = |change: Option<usize>| {
            let mut pair = Pair::new(server.clone());
            pair.server.retries = true;
            pair.dial(client.clone());
            let (mut retry_len, mut followed) = (0, false);
            pair.run(|from, datagram| {
                if from == Side::Server && packets(datagram)[0].kind == Kind::Retry {
                    retry_len = datagram.len();
                    if let Some(at) = change {
                        datagram[at] ^= 1;
                    }
                } else if from == Side::Client {
                    followed |= packets(datagram)
                        .iter()
                        .any(|packet| packet.kind == Kind::Initial && !packet.token.is_empty());
                }
            });
            assert_eq!(pair.is_up(), followed);
            (followed, retry_len)
        };
        let (followed, len) = follows(None);
        assert!(followed && len > 50);
        for at in 0..len {
            assert!(!follows(Some(at)).0, "byte {at} of {len}");
        }
    }
}

#[test]
fn both_ends_report_the_key_exchange_only_after_the_handshake() {
    for (client, server, exchange) in modes() {
        let mut pair = Pair::new(server);
        let said = |end: &mut End| {
            let data = end.conn().crypto_session().handshake_data()?;
            Some(quic::from_handshake_data(data).unwrap().key_exchange)
        };
        pair.dial(client);
        assert_eq!(said(&mut pair.client), None);
        pair.step(|_, _| {});
        assert_eq!([said(&mut pair.client), said(&mut pair.server)], [None, None]);
        pair.run(|_, _| {});
        assert_eq!([said(&mut pair.client), said(&mut pair.server)], [Some(exchange); 2]);
    }
}

/// Changes one byte in the data of the client or the server.
struct OneByte {
    of_client: bool,
    at: usize,
    said: usize,
}

impl OneByte {
    fn pass(&mut self, bytes: &mut [u8]) {
        if let Some(byte) = self.at.checked_sub(self.said).and_then(|at| bytes.get_mut(at)) {
            *byte ^= 0x01;
        }
        self.said += bytes.len();
    }
}

impl Meddler for OneByte {
    fn read(&mut self, bytes: &mut Vec<u8>) {
        if self.of_client {
            self.pass(bytes);
        }
    }

    fn written(&mut self, bytes: &mut Vec<u8>) {
        if !self.of_client {
            self.pass(bytes);
        }
    }
}

/// An attacker with the keys of the packets, as anybody has those of Initial ones, changes a byte of
/// the handshake: the end that reads it does not complete.
#[test]
fn no_byte_of_a_handshake_can_be_changed() {
    for (client, server, exchange) in modes() {
        for of_client in [true, false] {
            // in steps that go through keys and signatures of thousands of bytes in some strides
            let mut at = 0;
            loop {
                let mut server = server.clone();
                let meddler = Arc::new(Mutex::new(OneByte { of_client, at, said: 0 }));
                meddle(&mut server, Arc::clone(&meddler));
                let mut pair = Pair::new(server);
                pair.dial(client.clone());
                pair.run(|_, _| {});
                if at >= meddler.lock().unwrap().said {
                    assert!(at > 100 && pair.is_up(), "nothing was changed");
                    break;
                }
                let reader = if of_client { &pair.server } else { &pair.client };
                assert!(!reader.connected, "{exchange}, byte {at}, of the client: {of_client}");
                at += if exchange == KeyExchange::PskKe { 1 } else { 61 };
            }
        }
    }
}

/// A client on the right key that says nothing about ALPN.
#[test]
fn a_client_without_alpn_is_refused() {
    let cipher = Cipher::default();
    for kex in PskKex::ALL {
        let config = qkd::client_config(psk(1, cipher), kex, b"").unwrap();
        let name = "axon".try_into().unwrap();
        let mut client =
            ClientConnection::new(Arc::new(config), Version::V1, name, vec![]).unwrap();
        let mut hello = Vec::new();
        client.write_hs(&mut hello);

        let server = qkd_server(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
        let params = TransportParameters::read(Side::Server, &mut &[][..]).unwrap();
        let mut session = server.crypto.start_session(1, &params);
        let refused = session.read_handshake(&hello).unwrap_err();
        assert_eq!(refused.code, TransportErrorCode::crypto(NO_APPLICATION_PROTOCOL));
        assert!(session.handshake_data().is_none());
    }
}

/// Leaves ALPN out of the server's EncryptedExtensions.
struct WithoutAlpn;

impl Meddler for WithoutAlpn {
    fn written(&mut self, bytes: &mut Vec<u8>) {
        let mut messages = Reader(bytes);
        if messages.take(1) != [8] {
            return;
        }
        let mut extensions = Reader(messages.vector(3));
        let mut extensions = Reader(extensions.vector(2));
        let mut kept = Vec::new();
        while !extensions.0.is_empty() {
            let start = extensions.0;
            let kind = extensions.number(2) as u16;
            let len = 4 + extensions.vector(2).len();
            if kind != APPLICATION_LAYER_PROTOCOL_NEGOTIATION {
                kept.extend_from_slice(&start[..len]);
            }
        }
        let len = u16::try_from(kept.len()).unwrap();
        let message = [&[8, 0], &(len + 2).to_be_bytes()[..], &len.to_be_bytes(), &kept].concat();
        *bytes = [&message, messages.0].concat();
    }
}

/// Refused for that and at once, not for the Finished that does not fit any more.
#[test]
fn a_server_that_says_nothing_about_alpn_is_refused() {
    for (client, mut server, _) in modes() {
        meddle(&mut server, Arc::new(Mutex::new(WithoutAlpn)));
        let mut pair = Pair::new(server);
        pair.dial(client);
        pair.run(|_, _| {});
        let refused = pair.client.lost.as_ref().expect("the client gives up");
        assert_eq!(quic::tls_alert(refused), Some(NO_APPLICATION_PROTOCOL), "{refused}");
        assert!(!pair.client.connected && !pair.server.connected);
    }
}
