//! Parses the packets of handshakes by RFC 9000 and RFC 9001, and collects the content of CRYPTO frames.

use std::collections::BTreeMap;

use axon_tests::schedule::Schedule;
use axon_tls::Cipher;
use rustls::{
    Side,
    crypto::{
        aws_lc_rs::cipher_suite::{
            TLS13_AES_128_GCM_SHA256, TLS13_AES_256_GCM_SHA384, TLS13_CHACHA20_POLY1305_SHA256,
        },
        cipher::{AeadKey, Iv},
    },
    quic::{DirectionalKeys, HeaderProtectionKey, PacketKey, Suite, Version},
};

/// The kind of a packet with a long header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Initial,
    Handshake,
}

/// A packet as it was on the wire.
pub(super) struct Packet<'a> {
    pub(super) kind: Kind,
    /// The connection ID of its receiver.
    pub(super) destination: &'a [u8],
    bytes: &'a [u8],
    /// The position of the packet number.
    number_at: usize,
}

/// Reads bytes from the front.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(taken)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take(1).map(|byte| byte[0])
    }

    /// Reads a variable-length integer (RFC 9000, section 16).
    fn integer(&mut self) -> Option<usize> {
        let first = self.byte()?;
        let more = self.take((1 << (first >> 6)) - 1)?;
        Some(more.iter().fold(usize::from(first & 0x3f), |all, byte| all << 8 | usize::from(*byte)))
    }

    fn prefixed(&mut self) -> Option<&'a [u8]> {
        let length = self.byte()?;
        self.take(length.into())
    }
}

/// Returns the packets of a datagram that carry a part of a handshake.
pub(super) fn packets(datagram: &[u8]) -> Vec<Packet<'_>> {
    let mut found = Vec::new();
    let mut rest = datagram;
    while let Some((packet, length)) = packet(rest) {
        found.extend(packet);
        rest = &rest[length..];
    }
    found
}

/// Returns the first packet of these bytes, if it is of use, and its length. Returns `None` at a short header, at
/// padding, and at packets that extend to the end of the datagram.
fn packet(bytes: &[u8]) -> Option<(Option<Packet<'_>>, usize)> {
    let mut from = Bytes(bytes);
    let first = from.byte()?;
    // The bit beside that of the long header is random where both ends allow it (RFC 9287).
    if first & 0x80 == 0 || from.take(4)? != [0, 0, 0, 1] {
        return None;
    }
    let (destination, _) = (from.prefixed()?, from.prefixed()?);
    let kind = match first >> 4 & 3 {
        0 => {
            let token = from.integer()?;
            from.take(token)?;
            Some(Kind::Initial)
        }
        2 => Some(Kind::Handshake),
        // 0-RTT.
        1 => None,
        // Retry.
        _ => return None,
    };
    let length = from.integer()?;
    let number_at = bytes.len() - from.0.len();
    from.take(length)?;
    let whole = number_at + length;
    let bytes = &bytes[..whole];
    Some((kind.map(|kind| Packet { kind, destination, bytes, number_at }), whole))
}

/// The keys that open the packets of one end.
pub(super) struct Opens {
    packet: Box<dyn PacketKey>,
    header: Box<dyn HeaderProtectionKey>,
}

impl From<DirectionalKeys> for Opens {
    fn from(keys: DirectionalKeys) -> Self {
        Self { packet: keys.packet, header: keys.header }
    }
}

impl Opens {
    /// Returns the keys for Initial packets of client and server, which are public (RFC 9001, section 5.2).
    pub(super) fn initial(destination: &[u8]) -> [Self; 2] {
        let suite = TLS13_AES_128_GCM_SHA256.tls13().and_then(|suite| suite.quic_suite()).unwrap();
        let keys = suite.keys(destination, Side::Client, Version::V1);
        [keys.local.into(), keys.remote.into()]
    }

    /// Returns the keys for packets under this traffic secret.
    pub(super) fn with(cipher: Cipher, secret: &[u8]) -> Self {
        let suite = match cipher {
            Cipher::ChaCha20Poly1305 => TLS13_CHACHA20_POLY1305_SHA256,
            Cipher::Aes256Gcm => TLS13_AES_256_GCM_SHA384,
        };
        let Suite { quic, .. } = suite.tls13().and_then(|suite| suite.quic_suite()).unwrap();
        let (key, iv, header) = Schedule::packet_keys(cipher, secret);
        Self {
            packet: quic.packet_key(AeadKey::from(key), Iv::from(iv)),
            header: quic.header_protection_key(AeadKey::from(header)),
        }
    }

    /// Returns the keys for packets under a later traffic secret, after a key update: the key of their headers stays
    /// (RFC 9001, section 6).
    pub(super) fn updated(cipher: Cipher, first: &[u8], later: &[u8]) -> Self {
        let [first, later] = [first, later].map(|secret| Self::with(cipher, secret));
        Self { packet: later.packet, header: first.header }
    }

    /// Returns the frames of a packet; `None` if it is not a packet of that end.
    pub(super) fn open(&self, packet: &Packet<'_>) -> Option<Vec<u8>> {
        // A handshake has so few packets that their numbers are not truncated.
        let frames = self.open_at(packet.bytes, packet.number_at, 0);
        frames.map(|(_, frames)| frames)
    }

    /// Returns the number and the frames of a packet with a short header; `next` is the expected number. `None` if it
    /// is not a packet of that end.
    pub(super) fn open_short(&self, datagram: &[u8], next: u64) -> Option<(u64, Vec<u8>)> {
        self.open_at(datagram, 1 + CONNECTION_ID, next)
    }

    fn open_at(&self, packet: &[u8], number_at: usize, next: u64) -> Option<(u64, Vec<u8>)> {
        let mut bytes = packet.to_vec();
        let (head, rest) = bytes.split_at_mut_checked(number_at)?;
        let (number, sample) = rest.split_at_mut_checked(4)?;
        let sample = sample.get(..self.header.sample_len())?;
        self.header.decrypt_in_place(sample, &mut head[0], number).ok()?;
        let length = usize::from(head[0] & 3) + 1;
        let number = number[..length].iter().fold(0, |all, byte| all << 8 | u64::from(*byte));
        let number = whole_number(number, 1 << (8 * length), next);
        let (head, payload) = bytes.split_at_mut(number_at + length);
        let frames = self.packet.decrypt_in_place(number, head, payload).ok()?;
        Some((number, frames.to_vec()))
    }
}

/// Length of the connection IDs of daemons.
const CONNECTION_ID: usize = 8;

/// Returns the packet number nearest to `next` with this ending, of `window` different endings (RFC 9000, A.3).
fn whole_number(end: u64, window: u64, next: u64) -> u64 {
    let candidate = next & !(window - 1) | end;
    if candidate + window / 2 <= next {
        candidate + window
    } else if candidate > next + window / 2 && candidate >= window {
        candidate - window
    } else {
        candidate
    }
}

/// Bytes of a handshake of one end, in any order.
#[derive(Default)]
pub(super) struct Stream(BTreeMap<usize, Vec<u8>>);

impl Stream {
    /// Adds the content of a packet's CRYPTO frames.
    pub(super) fn add(&mut self, frames: &[u8]) {
        let mut from = Bytes(frames);
        while self.frame(&mut from).is_some() {}
    }

    /// Reads a frame; `None` at the end, and at one that no handshake has.
    fn frame(&mut self, from: &mut Bytes<'_>) -> Option<()> {
        match from.byte()? {
            // PADDING, PING.
            0 | 1 => {}
            // ACK, and with counts of ECN.
            kind @ (2 | 3) => {
                let (_, _, ranges, _) =
                    (from.integer()?, from.integer()?, from.integer()?, from.integer()?);
                let more = if kind == 3 { 3 } else { 0 };
                for _ in 0..2 * ranges + more {
                    from.integer()?;
                }
            }
            6 => {
                let (at, length) = (from.integer()?, from.integer()?);
                let bytes = from.take(length)?.to_vec();
                let known = self.0.entry(at).or_default();
                if known.len() < bytes.len() {
                    *known = bytes;
                }
            }
            _ => return None,
        }
        Some(())
    }

    /// Returns the bytes up to the first gap.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut whole = Vec::new();
        for (at, bytes) in &self.0 {
            if *at > whole.len() {
                break;
            }
            whole.extend_from_slice(bytes.get(whole.len() - at..).unwrap_or_default());
        }
        whole
    }
}
