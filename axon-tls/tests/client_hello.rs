//! What is on the wire: the hellos of every mode, taken from records and packets and parsed here.
#![cfg(feature = "quic")]

mod common;

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, UdpSocket};
use std::sync::Arc;

use aws_lc_rs::aead::{AES_128_GCM, Aad, LessSafeKey, Nonce, UnboundKey};
use aws_lc_rs::hkdf::{HKDF_SHA256, KeyType, Prk, Salt};
use axon_tls::identity::{Auth, SigningKey};
use axon_tls::quic::{ALPN, hybrid_client, qkd_client};
use axon_tls::{Cipher, PskKex, hybrid, qkd};
use common::{OneKey, psk};

const SUPPORTED_GROUPS: u16 = 10;
const SIGNATURE_ALGORITHMS: u16 = 13;
const APPLICATION_LAYER_PROTOCOL_NEGOTIATION: u16 = 16;
const CLIENT_CERTIFICATE_TYPE: u16 = 19;
const SERVER_CERTIFICATE_TYPE: u16 = 20;
const SESSION_TICKET: u16 = 35;
const PRE_SHARED_KEY: u16 = 41;
const EARLY_DATA: u16 = 42;
const SUPPORTED_VERSIONS: u16 = 43;
const PSK_KEY_EXCHANGE_MODES: u16 = 45;
const KEY_SHARE: u16 = 51;
const QUIC_TRANSPORT_PARAMETERS: u16 = 57;
const SERVER_NAME: u16 = 0;

const X25519MLKEM768: [u8; 2] = [0x11, 0xec];
/// 1,184 bytes of ML-KEM-768 and 32 of X25519.
const SHARE_LEN: usize = 1_216;

#[test]
fn psk_ke() {
    for cipher in Cipher::ALL {
        for hello in qkd_hellos(cipher, PskKex::PskKe) {
            hello.is_tls13_with(cipher);
            hello.offers_psk(cipher, 0);
            hello.lacks(SUPPORTED_GROUPS);
            hello.lacks(KEY_SHARE);
        }
    }
}

#[test]
fn psk_dhe_ke() {
    for cipher in Cipher::ALL {
        for hello in qkd_hellos(cipher, PskKex::PskDheKe) {
            hello.is_tls13_with(cipher);
            hello.offers_psk(cipher, 1);
            hello.has_one_group();
        }
    }
}

#[test]
fn hybrid_mode() {
    let auth = Auth::None(SigningKey::generate().unwrap());
    for cipher in Cipher::ALL {
        let tcp = hybrid::client_config(&auth, cipher, ALPN).unwrap();
        let conn = rustls::ClientConnection::new(Arc::new(tcp), "axon".try_into().unwrap());
        let mut record = Vec::new();
        conn.unwrap().write_tls(&mut record).unwrap();

        let quic = over_quic(hybrid_client(&auth, cipher, ALPN).unwrap());
        for hello in [ClientHello::in_record(&record), quic] {
            hello.is_tls13_with(cipher);
            hello.has_one_group();
            hello.lacks(PRE_SHARED_KEY);
            assert!(hello.extensions.contains_key(&SIGNATURE_ALGORITHMS));
            // raw public keys alone, RFC 7250
            assert_eq!(hello.extensions[&CLIENT_CERTIFICATE_TYPE], [1, 2]);
            assert_eq!(hello.extensions[&SERVER_CERTIFICATE_TYPE], [1, 2]);
        }
    }
}

/// What the server answers to each mode over TCP.
#[test]
fn server_hellos() {
    let auth = Auth::None(SigningKey::generate().unwrap());
    for cipher in Cipher::ALL {
        for kex in PskKex::ALL {
            let client = qkd::client_config(psk(1, cipher), kex, ALPN).unwrap();
            let server =
                qkd::server_config(OneKey::new(psk(1, cipher)), cipher, kex, ALPN).unwrap();
            let mut client =
                rustls_axon::ClientConnection::new(Arc::new(client), "axon".try_into().unwrap())
                    .unwrap();
            let mut server = rustls_axon::ServerConnection::new(Arc::new(server)).unwrap();
            let (mut hello, mut answer) = (Vec::new(), Vec::new());
            client.write_tls(&mut hello).unwrap();
            server.read_tls(&mut &hello[..]).unwrap();
            server.process_new_packets().unwrap();
            server.write_tls(&mut answer).unwrap();
            is_server_hello(&answer, cipher, Some(kex));
        }

        let client = hybrid::client_config(&auth, cipher, ALPN).unwrap();
        let server = hybrid::server_config(&auth, cipher, ALPN).unwrap();
        let mut client =
            rustls::ClientConnection::new(Arc::new(client), "axon".try_into().unwrap()).unwrap();
        let mut server = rustls::ServerConnection::new(Arc::new(server)).unwrap();
        let (mut hello, mut answer) = (Vec::new(), Vec::new());
        client.write_tls(&mut hello).unwrap();
        server.read_tls(&mut &hello[..]).unwrap();
        server.process_new_packets().unwrap();
        server.write_tls(&mut answer).unwrap();
        is_server_hello(&answer, cipher, None);
    }
}

/// Exactly the extensions of the mode, and not a HelloRetryRequest, whose random is a fixed one.
fn is_server_hello(record: &[u8], cipher: Cipher, kex: Option<PskKex>) {
    let mut record = Reader(record);
    assert_eq!(record.take(3), [22, 3, 3]);
    let mut message = Reader(record.vector(2));
    assert_eq!(message.take(1), [2], "a ServerHello");
    let mut hello = Reader(message.vector(3));
    assert!(message.0.is_empty());
    assert_eq!(hello.take(2), [3, 3]);
    assert_ne!(hello.take(32)[..4], [0xcf, 0x21, 0xad, 0x74], "a HelloRetryRequest");
    hello.vector(1);
    assert_eq!(hello.take(2), [0x13, if cipher == Cipher::Aes256Gcm { 2 } else { 3 }]);
    assert_eq!(hello.take(1), [0]);
    let mut list = Reader(hello.vector(2));
    assert!(hello.0.is_empty());

    let mut extensions = BTreeMap::new();
    while !list.0.is_empty() {
        let kind = list.number(2) as u16;
        assert!(extensions.insert(kind, list.vector(2).to_vec()).is_none());
    }
    assert_eq!(extensions.remove(&SUPPORTED_VERSIONS).unwrap(), [3, 4]);
    if kex.is_some() {
        assert_eq!(extensions.remove(&PRE_SHARED_KEY).unwrap(), [0, 0], "the first identity");
    }
    if kex != Some(PskKex::PskKe) {
        let share = extensions.remove(&KEY_SHARE).unwrap();
        // 1,088 bytes of ML-KEM-768 and 32 of X25519
        assert_eq!(share[..4], [0x11, 0xec, 0x04, 0x60]);
        assert_eq!(share.len(), 4 + 1_120);
    }
    assert!(extensions.is_empty(), "and nothing else: {extensions:?}");
}

/// The ClientHello over TCP and the one over QUIC.
fn qkd_hellos(cipher: Cipher, kex: PskKex) -> [ClientHello; 2] {
    let tcp = qkd::client_config(psk(1, cipher), kex, ALPN).unwrap();
    let conn = rustls_axon::ClientConnection::new(Arc::new(tcp), "axon".try_into().unwrap());
    let mut record = Vec::new();
    conn.unwrap().write_tls(&mut record).unwrap();

    let quic = over_quic(qkd_client(psk(1, cipher), kex, ALPN).unwrap());
    assert!(quic.extensions.contains_key(&QUIC_TRANSPORT_PARAMETERS));
    [ClientHello::in_record(&record), quic]
}

struct ClientHello {
    suites: Vec<u8>,
    order: Vec<u16>,
    extensions: BTreeMap<u16, Vec<u8>>,
}

impl ClientHello {
    fn in_record(record: &[u8]) -> Self {
        let mut record = Reader(record);
        assert_eq!(record.take(1), [22], "a handshake record");
        record.take(2);
        let len = record.number(2);
        Self::parse(record.take(len))
    }

    fn parse(message: &[u8]) -> Self {
        let mut message = Reader(message);
        assert_eq!(message.take(1), [1], "a ClientHello");
        let len = message.number(3);
        let mut hello = Reader(message.take(len));
        assert!(message.0.is_empty());

        assert_eq!(hello.take(2), [3, 3]);
        hello.take(32);
        hello.vector(1);
        let suites = hello.vector(2).to_vec();
        assert_eq!(hello.vector(1), [0]);
        let mut list = Reader(hello.vector(2));
        assert!(hello.0.is_empty());

        let (mut order, mut extensions) = (Vec::new(), BTreeMap::new());
        while !list.0.is_empty() {
            let kind = list.number(2) as u16;
            order.push(kind);
            assert!(extensions.insert(kind, list.vector(2).to_vec()).is_none());
        }
        Self { suites, order, extensions }
    }

    #[track_caller]
    fn lacks(&self, extension: u16) {
        assert!(!self.extensions.contains_key(&extension), "extension {extension}");
    }

    #[track_caller]
    fn is_tls13_with(&self, cipher: Cipher) {
        let suite = match cipher {
            Cipher::Aes256Gcm => [0x13, 0x02],
            Cipher::ChaCha20Poly1305 => [0x13, 0x03],
        };
        assert_eq!(self.suites, suite, "exactly the configured suite");
        assert_eq!(self.extensions[&SUPPORTED_VERSIONS], [2, 3, 4], "TLS 1.3 alone");
        assert_eq!(self.extensions[&APPLICATION_LAYER_PROTOCOL_NEGOTIATION], b"\x00\x07\x06axon/1");
        for extension in [SERVER_NAME, SESSION_TICKET, EARLY_DATA] {
            self.lacks(extension);
        }
    }

    #[track_caller]
    fn offers_psk(&self, cipher: Cipher, mode: u8) {
        assert_eq!(self.extensions[&PSK_KEY_EXCHANGE_MODES], [1, mode]);
        for extension in [SIGNATURE_ALGORITHMS, CLIENT_CERTIFICATE_TYPE, SERVER_CERTIFICATE_TYPE] {
            self.lacks(extension);
        }
        assert_eq!(self.order.last(), Some(&PRE_SHARED_KEY), "pre_shared_key is the last");

        let mut offer = Reader(&self.extensions[&PRE_SHARED_KEY]);
        let mut identities = Reader(offer.vector(2));
        assert_eq!(identities.vector(2), psk(1, cipher).identity());
        assert_eq!(identities.take(4), [0; 4], "obfuscated ticket age");
        assert!(identities.0.is_empty(), "one identity");
        let mut binders = Reader(offer.vector(2));
        let len = if cipher == Cipher::Aes256Gcm { 48 } else { 32 };
        let binder = binders.vector(1);
        assert_eq!(binder.len(), len);
        assert_ne!(binder, vec![0; len]);
        assert!(binders.0.is_empty() && offer.0.is_empty());
    }

    #[track_caller]
    fn has_one_group(&self) {
        assert_eq!(self.extensions[&SUPPORTED_GROUPS], [0, 2, 0x11, 0xec]);
        let mut shares = Reader(&self.extensions[&KEY_SHARE]);
        let mut shares = Reader(shares.vector(2));
        assert_eq!(shares.take(2), X25519MLKEM768);
        assert_eq!(shares.vector(2).len(), SHARE_LEN);
        assert!(shares.0.is_empty(), "no X25519 share beside it");
    }
}

struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take(&mut self, len: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }

    fn number(&mut self, len: usize) -> usize {
        self.take(len).iter().fold(0, |number, byte| number << 8 | usize::from(*byte))
    }

    fn vector(&mut self, len_of_len: usize) -> &'a [u8] {
        let len = self.number(len_of_len);
        self.take(len)
    }

    fn varint(&mut self) -> usize {
        let len = 1 << (self.0[0] >> 6);
        self.number(len) & !(0b11 << (8 * len - 2))
    }
}

/// Dials a socket that never answers, and reads the ClientHello out of the Initial packets.
fn over_quic(config: quinn::ClientConfig) -> ClientHello {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let addr = socket.local_addr().unwrap();
    let _dialling = runtime.block_on(async {
        let endpoint = quinn::Endpoint::client((Ipv4Addr::LOCALHOST, 0).into()).unwrap();
        let connecting = endpoint.connect_with(config, addr, "axon").unwrap();
        (endpoint, connecting)
    });

    // a group share makes the ClientHello longer than a packet; pieces may come in any order
    let mut crypto = BTreeMap::new();
    loop {
        let mut packet = [0; 2_048];
        let len = socket.recv(&mut packet).unwrap();
        read_initial(&packet[..len], &mut crypto);

        let mut stream: Vec<u8> = Vec::new();
        for (offset, data) in &crypto {
            if *offset <= stream.len() {
                stream.truncate(*offset);
                stream.extend_from_slice(data);
            }
        }
        if stream.len() >= 4 && stream.len() == 4 + Reader(&stream[1..]).number(3) {
            return ClientHello::parse(&stream);
        }
    }
}

/// Takes the CRYPTO frames out of a client's Initial packet (RFC 9001 section 5).
fn read_initial(datagram: &[u8], crypto: &mut BTreeMap<usize, Vec<u8>>) {
    let mut reader = Reader(datagram);
    assert_eq!(reader.take(1)[0] >> 4, 0b1100, "an Initial packet with a long header");
    assert_eq!(reader.number(4), 1, "QUIC version 1");
    let dst_cid = reader.vector(1);
    reader.vector(1);
    let token_len = reader.varint();
    reader.take(token_len);
    let len = reader.varint();
    let pn_offset = datagram.len() - reader.0.len();
    let mut packet = datagram[..pn_offset + len].to_vec();

    const INITIAL_SALT: [u8; 20] = [
        0x38, 0x76, 0x2c, 0xf7, 0xf5, 0x59, 0x34, 0xb3, 0x4d, 0x17, 0x9a, 0xe6, 0xa4, 0xc8, 0x0c,
        0xad, 0xcc, 0xbb, 0x7f, 0x0a,
    ];
    let initial = Salt::new(HKDF_SHA256, &INITIAL_SALT).extract(dst_cid);
    let client = Prk::new_less_safe(HKDF_SHA256, &expand_label(&initial, b"client in", 32));
    let key = expand_label(&client, b"quic key", 16);
    let iv = expand_label(&client, b"quic iv", 12);
    let hp = expand_label(&client, b"quic hp", 16);

    let hp = aws_lc_rs::aead::quic::HeaderProtectionKey::new(&aws_lc_rs::aead::quic::AES_128, &hp);
    let mask = hp.unwrap().new_mask(&packet[pn_offset + 4..pn_offset + 20]).unwrap();
    packet[0] ^= mask[0] & 0x0f;
    let pn_len = usize::from(packet[0] & 0x03) + 1;
    let mut nonce: [u8; 12] = iv.try_into().unwrap();
    for at in 0..pn_len {
        packet[pn_offset + at] ^= mask[1 + at];
        nonce[12 - pn_len + at] ^= packet[pn_offset + at];
    }

    let (header, payload) = packet.split_at_mut(pn_offset + pn_len);
    let key = LessSafeKey::new(UnboundKey::new(&AES_128_GCM, &key).unwrap());
    let nonce = Nonce::assume_unique_for_key(nonce);
    let frames = key.open_in_place(nonce, Aad::from(header), payload).unwrap();

    let mut frames = Reader(frames);
    while let Some(kind) = frames.0.first().copied() {
        frames.take(1);
        match kind {
            0 | 1 => {}
            6 => {
                let offset = frames.varint();
                let len = frames.varint();
                crypto.insert(offset, frames.take(len).to_vec());
            }
            kind => panic!("frame {kind} in a client's first flight"),
        }
    }
}

/// HKDF-Expand-Label of RFC 8446 section 7.1, with an empty context.
fn expand_label(secret: &Prk, label: &[u8], len: usize) -> Vec<u8> {
    struct Len(usize);
    impl KeyType for Len {
        fn len(&self) -> usize {
            self.0
        }
    }

    let info = [&[0, len as u8, 6 + label.len() as u8], &b"tls13 "[..], label, &[0]];
    let mut expanded = vec![0; len];
    secret.expand(&info, Len(len)).unwrap().fill(&mut expanded).unwrap();
    expanded
}
