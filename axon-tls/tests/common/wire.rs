//! Bytes as they go over the wire, read without the code under test.

use std::collections::BTreeMap;

use aws_lc_rs::aead::quic::{AES_128, HeaderProtectionKey};
use aws_lc_rs::aead::{AES_128_GCM, Aad, LessSafeKey, Nonce, UnboundKey};
use aws_lc_rs::hkdf::{HKDF_SHA256, KeyType, Prk, Salt};

/// Takes fields off the front; panics where there is less than asked for.
pub(crate) struct Reader<'a>(pub(crate) &'a [u8]);

impl<'a> Reader<'a> {
    pub(crate) fn take(&mut self, len: usize) -> &'a [u8] {
        let (taken, rest) = self.0.split_at(len);
        self.0 = rest;
        taken
    }

    pub(crate) fn number(&mut self, len: usize) -> usize {
        self.take(len).iter().fold(0, |number, byte| number << 8 | usize::from(*byte))
    }

    pub(crate) fn vector(&mut self, len_of_len: usize) -> &'a [u8] {
        let len = self.number(len_of_len);
        self.take(len)
    }

    pub(crate) fn varint(&mut self) -> usize {
        let len = 1 << (self.0[0] >> 6);
        self.number(len) & !(0b11 << (8 * len - 2))
    }
}

/// The type of a packet of QUIC version 1, from its first byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Initial,
    ZeroRtt,
    Handshake,
    Retry,
    OneRtt,
}

/// A packet, still protected.
pub(crate) struct Packet<'a> {
    pub(crate) kind: Kind,
    /// Empty for a short header, which does not say how long it is.
    pub(crate) dst_cid: &'a [u8],
    pub(crate) token: &'a [u8],
    pn_offset: usize,
    bytes: &'a [u8],
}

/// Returns the packets of a datagram (RFC 9000 section 12.2).
pub(crate) fn packets(mut datagram: &[u8]) -> Vec<Packet<'_>> {
    let mut packets = Vec::new();
    while let Some(first) = datagram.first() {
        let mut packet = Packet {
            // the second bit is anything between ends that agreed on it (RFC 9287)
            kind: match (first >> 7, first >> 4 & 3) {
                (0, _) => Kind::OneRtt,
                (_, 0) => Kind::Initial,
                (_, 1) => Kind::ZeroRtt,
                (_, 2) => Kind::Handshake,
                _ => Kind::Retry,
            },
            dst_cid: &[],
            token: &[],
            pn_offset: 0,
            bytes: datagram,
        };
        if packet.kind != Kind::OneRtt {
            let mut reader = Reader(&datagram[1..]);
            assert_eq!(reader.number(4), 1, "QUIC version 1");
            packet.dst_cid = reader.vector(1);
            reader.vector(1);
            if packet.kind == Kind::Initial {
                let len = reader.varint();
                packet.token = reader.take(len);
            }
            if packet.kind != Kind::Retry {
                let len = reader.varint();
                packet.pn_offset = datagram.len() - reader.0.len();
                packet.bytes = &datagram[..packet.pn_offset + len];
            }
        }
        datagram = &datagram[packet.bytes.len()..];
        packets.push(packet);
    }
    packets
}

/// The keys with which one end protects its Initial packets (RFC 9001 section 5.2).
pub(crate) struct InitialKeys {
    pub(crate) key: Vec<u8>,
    pub(crate) iv: Vec<u8>,
    pub(crate) hp: Vec<u8>,
}

impl InitialKeys {
    /// Derives the client's keys from the connection ID in its first packet.
    pub(crate) fn client(dst_cid: &[u8]) -> Self {
        Self::new(dst_cid, b"client in")
    }

    pub(crate) fn server(dst_cid: &[u8]) -> Self {
        Self::new(dst_cid, b"server in")
    }

    fn new(dst_cid: &[u8], end: &[u8]) -> Self {
        const SALT: [u8; 20] = [
            0x38, 0x76, 0x2c, 0xf7, 0xf5, 0x59, 0x34, 0xb3, 0x4d, 0x17, 0x9a, 0xe6, 0xa4, 0xc8,
            0x0c, 0xad, 0xcc, 0xbb, 0x7f, 0x0a,
        ];
        let initial = Salt::new(HKDF_SHA256, &SALT).extract(dst_cid);
        let secret = Prk::new_less_safe(HKDF_SHA256, &expand_label(&initial, end, 32));
        Self {
            key: expand_label(&secret, b"quic key", 16),
            iv: expand_label(&secret, b"quic iv", 12),
            hp: expand_label(&secret, b"quic hp", 16),
        }
    }

    /// Returns the frames in an Initial packet.
    pub(crate) fn open(&self, packet: &Packet<'_>) -> Vec<u8> {
        let (pn_offset, mut bytes) = (packet.pn_offset, packet.bytes.to_vec());
        let hp = HeaderProtectionKey::new(&AES_128, &self.hp).unwrap();
        let mask = hp.new_mask(&bytes[pn_offset + 4..pn_offset + 20]).unwrap();
        bytes[0] ^= mask[0] & 0x0f;
        let pn_len = usize::from(bytes[0] & 0x03) + 1;
        let mut nonce: [u8; 12] = self.iv.as_slice().try_into().unwrap();
        for at in 0..pn_len {
            bytes[pn_offset + at] ^= mask[1 + at];
            nonce[12 - pn_len + at] ^= bytes[pn_offset + at];
        }

        let (header, payload) = bytes.split_at_mut(pn_offset + pn_len);
        let key = LessSafeKey::new(UnboundKey::new(&AES_128_GCM, &self.key).unwrap());
        let nonce = Nonce::assume_unique_for_key(nonce);
        key.open_in_place(nonce, Aad::from(header), payload).unwrap().to_vec()
    }
}

/// Computes HKDF-Expand-Label of RFC 8446 section 7.1, with an empty context.
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

/// The data of CRYPTO frames, in pieces that may come in any order and more than once.
#[derive(Default)]
pub(crate) struct CryptoStream(BTreeMap<usize, Vec<u8>>);

impl CryptoStream {
    /// Takes the CRYPTO frames out of a packet of the handshake.
    pub(crate) fn take_from(&mut self, frames: &[u8]) {
        let mut frames = Reader(frames);
        while !frames.0.is_empty() {
            match frames.take(1)[0] {
                // PADDING and PING
                0 | 1 => {}
                // ACK: largest, delay, ranges, and the first range before the others
                2 => {
                    let [_, _, ranges, _] = std::array::from_fn(|_| frames.varint());
                    for _ in 0..2 * ranges {
                        frames.varint();
                    }
                }
                6 => {
                    let offset = frames.varint();
                    let len = frames.varint();
                    self.0.insert(offset, frames.take(len).to_vec());
                }
                kind => panic!("frame {kind} in a handshake"),
            }
        }
    }

    /// Returns the bytes up to the first gap.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut bytes: Vec<u8> = Vec::new();
        for (offset, piece) in &self.0 {
            if *offset <= bytes.len() && offset + piece.len() > bytes.len() {
                bytes.truncate(*offset);
                bytes.extend_from_slice(piece);
            }
        }
        bytes
    }
}
