//! Records and handshake messages, in the clear and under ChaCha20-Poly1305.

use aws_lc_rs::aead::{Aad, LessSafeKey, Nonce, UnboundKey, CHACHA20_POLY1305};

use super::schedule::{expand_label, Secret};

pub(crate) const CHANGE_CIPHER_SPEC: u8 = 20;
pub(crate) const HANDSHAKE: u8 = 22;
pub(crate) const APPLICATION_DATA: u8 = 23;

/// A handshake message.
pub(crate) fn message(kind: u8, body: &[u8]) -> Vec<u8> {
    let len = u32::try_from(body.len()).unwrap().to_be_bytes();
    [&[kind], &len[1..], body].concat()
}

/// Records in the clear, as many as `content` takes.
pub(crate) fn records(kind: u8, content: &[u8]) -> Vec<u8> {
    content.chunks(16_384).flat_map(|part| record(kind, part)).collect()
}

fn record(kind: u8, content: &[u8]) -> Vec<u8> {
    let len = u16::try_from(content.len()).unwrap().to_be_bytes();
    [&[kind, 3, 3], &len[..], content].concat()
}

/// Splits a flight into records: type and content.
fn split(mut flight: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let mut all = Vec::new();
    while let [kind, _, _, high, low, rest @ ..] = flight {
        let (content, after) = rest.split_at(usize::from(u16::from_be_bytes([*high, *low])));
        all.push((*kind, content.to_vec()));
        flight = after;
    }
    assert!(flight.is_empty(), "half a record");
    all
}

/// The handshake messages that a flight has in the clear.
pub(crate) fn plaintext(flight: &[u8]) -> Vec<u8> {
    let handshake = |(kind, content)| (kind == HANDSHAKE).then_some(content);
    split(flight).into_iter().filter_map(handshake).flatten().collect()
}

/// The keys of one direction.
pub(crate) struct Protection {
    secret: Secret,
    key: LessSafeKey,
    iv: [u8; 12],
    sequence: u64,
}

impl Protection {
    pub(crate) fn new(traffic_secret: &Secret) -> Self {
        let key = expand_label(traffic_secret, "key", b"", 32);
        Self {
            secret: *traffic_secret,
            key: LessSafeKey::new(UnboundKey::new(&CHACHA20_POLY1305, &key).unwrap()),
            iv: expand_label(traffic_secret, "iv", b"", 12).try_into().unwrap(),
            sequence: 0,
        }
    }

    /// The keys after a KeyUpdate.
    pub(crate) fn update(&mut self) {
        let next = expand_label(&self.secret, "traffic upd", b"", 32);
        *self = Self::new(&next.try_into().unwrap());
    }

    fn nonce(&mut self) -> Nonce {
        let mut nonce = self.iv;
        for (byte, counter) in nonce[4..].iter_mut().zip(self.sequence.to_be_bytes()) {
            *byte ^= counter;
        }
        self.sequence += 1;
        Nonce::assume_unique_for_key(nonce)
    }

    /// One record with `content` of a type in it.
    pub(crate) fn seal(&mut self, kind: u8, content: &[u8]) -> Vec<u8> {
        let mut inner = [content, &[kind]].concat();
        let len = u16::try_from(inner.len() + 16).unwrap().to_be_bytes();
        let header = [APPLICATION_DATA, 3, 3, len[0], len[1]];
        let nonce = self.nonce();
        self.key.seal_in_place_append_tag(nonce, Aad::from(header), &mut inner).unwrap();
        record(APPLICATION_DATA, &inner)
    }

    /// Opens what is sealed in a flight; what is in the clear is left out if it is a hello or a
    /// ChangeCipherSpec, and given as it is otherwise.
    pub(crate) fn open_all(&mut self, flight: &[u8]) -> Vec<(u8, Vec<u8>)> {
        let mut all = Vec::new();
        for (kind, mut content) in split(flight) {
            match kind {
                APPLICATION_DATA => all.push(self.open(&mut content)),
                CHANGE_CIPHER_SPEC | HANDSHAKE => {}
                _ => all.push((kind, content)),
            }
        }
        all
    }

    fn open(&mut self, content: &mut [u8]) -> (u8, Vec<u8>) {
        let len = u16::try_from(content.len()).unwrap().to_be_bytes();
        let header = [APPLICATION_DATA, 3, 3, len[0], len[1]];
        let nonce = self.nonce();
        let inner = self.key.open_in_place(nonce, Aad::from(header), content).expect("their keys");
        let end = inner.iter().rposition(|byte| *byte != 0).expect("a content type");
        (inner[end], inner[..end].to_vec())
    }
}
