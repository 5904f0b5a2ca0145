//! ClientHello and ServerHello (RFC 8446 section 4.1), and what is expected of them.

use std::collections::BTreeMap;

use axon_tls::{Cipher, PskKex};

use super::pair::Pair;
use super::psk;
use super::wire::{CryptoStream, InitialKeys, Kind, Reader, packets};

pub(crate) const SERVER_NAME: u16 = 0;
pub(crate) const SUPPORTED_GROUPS: u16 = 10;
pub(crate) const SIGNATURE_ALGORITHMS: u16 = 13;
pub(crate) const APPLICATION_LAYER_PROTOCOL_NEGOTIATION: u16 = 16;
pub(crate) const CLIENT_CERTIFICATE_TYPE: u16 = 19;
pub(crate) const SERVER_CERTIFICATE_TYPE: u16 = 20;
pub(crate) const SESSION_TICKET: u16 = 35;
pub(crate) const PRE_SHARED_KEY: u16 = 41;
pub(crate) const EARLY_DATA: u16 = 42;
pub(crate) const SUPPORTED_VERSIONS: u16 = 43;
pub(crate) const PSK_KEY_EXCHANGE_MODES: u16 = 45;
pub(crate) const KEY_SHARE: u16 = 51;
pub(crate) const QUIC_TRANSPORT_PARAMETERS: u16 = 57;

const X25519MLKEM768: [u8; 2] = [0x11, 0xec];
/// 1,184 bytes of ML-KEM-768 and 32 of X25519.
const CLIENT_SHARE_LEN: usize = 1_216;
/// 1,088 bytes of ML-KEM-768 and 32 of X25519.
const SERVER_SHARE_LEN: usize = 1_120;

/// Returns the one message in a record.
pub(crate) fn in_record(record: &[u8]) -> &[u8] {
    let mut record = Reader(record);
    assert_eq!(record.take(1), [22], "a handshake record");
    record.take(2);
    record.vector(2)
}

fn extensions(list: &[u8]) -> (Vec<u16>, BTreeMap<u16, Vec<u8>>) {
    let mut list = Reader(list);
    let (mut order, mut extensions) = (Vec::new(), BTreeMap::new());
    while !list.0.is_empty() {
        let kind = list.number(2) as u16;
        order.push(kind);
        assert!(extensions.insert(kind, list.vector(2).to_vec()).is_none(), "{kind} twice");
    }
    (order, extensions)
}

fn suite(cipher: Cipher) -> [u8; 2] {
    match cipher {
        Cipher::Aes256Gcm => [0x13, 0x02],
        Cipher::ChaCha20Poly1305 => [0x13, 0x03],
    }
}

pub(crate) struct ClientHello {
    pub(crate) suites: Vec<u8>,
    order: Vec<u16>,
    pub(crate) extensions: BTreeMap<u16, Vec<u8>>,
}

impl ClientHello {
    /// Makes a client dial a server that never gets the packets, and reads the ClientHello from the Initial packets:
    /// with a group share it takes more than one.
    pub(crate) fn over_quic(client: quinn::ClientConfig, server: quinn::ServerConfig) -> Self {
        let mut pair = Pair::new(server);
        let mut crypto = CryptoStream::default();
        pair.dial(client);
        pair.run(|_, datagram| {
            for packet in packets(datagram) {
                assert_eq!(packet.kind, Kind::Initial, "a client begins with nothing else");
                crypto.take_from(&InitialKeys::client(packet.dst_cid).open(&packet));
            }
            datagram.clear();
        });
        Self::parse(&crypto.bytes())
    }

    pub(crate) fn parse(message: &[u8]) -> Self {
        let mut message = Reader(message);
        assert_eq!(message.take(1), [1], "a ClientHello");
        let mut hello = Reader(message.vector(3));
        assert!(message.0.is_empty());

        assert_eq!(hello.take(2), [3, 3]);
        hello.take(32);
        hello.vector(1);
        let suites = hello.vector(2).to_vec();
        assert_eq!(hello.vector(1), [0]);
        let (order, extensions) = extensions(hello.vector(2));
        assert!(hello.0.is_empty());
        Self { suites, order, extensions }
    }

    #[track_caller]
    pub(crate) fn lacks(&self, extension: u16) {
        assert!(!self.extensions.contains_key(&extension), "extension {extension}");
    }

    #[track_caller]
    pub(crate) fn is_tls13_with(&self, cipher: Cipher) {
        assert_eq!(self.suites, suite(cipher), "exactly the configured suite");
        assert_eq!(self.extensions[&SUPPORTED_VERSIONS], [2, 3, 4], "TLS 1.3 alone");
        assert_eq!(self.extensions[&APPLICATION_LAYER_PROTOCOL_NEGOTIATION], b"\x00\x07\x06axon/1");
        for extension in [SERVER_NAME, SESSION_TICKET, EARLY_DATA] {
            self.lacks(extension);
        }
    }

    #[track_caller]
    pub(crate) fn offers_psk(&self, cipher: Cipher, mode: u8) {
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
    pub(crate) fn has_one_group(&self) {
        assert_eq!(self.extensions[&SUPPORTED_GROUPS], [0, 2, 0x11, 0xec]);
        let mut shares = Reader(&self.extensions[&KEY_SHARE]);
        let mut shares = Reader(shares.vector(2));
        assert_eq!(shares.take(2), X25519MLKEM768);
        assert_eq!(shares.vector(2).len(), CLIENT_SHARE_LEN);
        assert!(shares.0.is_empty(), "no X25519 share beside it");
    }
}

/// Exactly the extensions of the mode, and not a HelloRetryRequest, whose random is a fixed one.
/// Without `kex` it is that of the hybrid mode.
#[track_caller]
pub(crate) fn is_server_hello(message: &[u8], cipher: Cipher, kex: Option<PskKex>) {
    let mut message = Reader(message);
    assert_eq!(message.take(1), [2], "a ServerHello");
    let mut hello = Reader(message.vector(3));
    assert!(message.0.is_empty(), "one message alone");
    assert_eq!(hello.take(2), [3, 3]);
    assert_ne!(hello.take(32)[..4], [0xcf, 0x21, 0xad, 0x74], "a HelloRetryRequest");
    hello.vector(1);
    assert_eq!(hello.take(2), suite(cipher));
    assert_eq!(hello.take(1), [0]);
    let (_, mut extensions) = extensions(hello.vector(2));
    assert!(hello.0.is_empty());

    assert_eq!(extensions.remove(&SUPPORTED_VERSIONS).unwrap(), [3, 4]);
    if kex.is_some() {
        assert_eq!(extensions.remove(&PRE_SHARED_KEY).unwrap(), [0, 0], "the first identity");
    }
    if kex != Some(PskKex::PskKe) {
        let share = extensions.remove(&KEY_SHARE).unwrap();
        let mut share = Reader(&share);
        assert_eq!(share.take(2), X25519MLKEM768);
        assert_eq!(share.vector(2).len(), SERVER_SHARE_LEN);
        assert!(share.0.is_empty());
    }
    assert!(extensions.is_empty(), "and nothing else: {extensions:?}");
}
