//! The key schedule of RFC 8446 section 7 and RFC 9001 section 5, from a QKD key on.

use std::fmt;

use axon_tls::{Cipher, PskKex};
use hmac::{Hmac, KeyInit, Mac};
use sha2::{Digest, Sha256, Sha384};

/// A secret of a connection.
#[derive(Clone)]
pub struct Secret {
    /// The name in RFC 8446 and RFC 9001.
    pub name: String,
    /// The bytes of the secret.
    pub bytes: Vec<u8>,
}

impl Secret {
    /// Names a secret.
    pub fn new(name: impl Into<String>, bytes: &[u8]) -> Self {
        Self { name: name.into(), bytes: bytes.to_vec() }
    }
}

/// The source of a connection's secrets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mode {
    /// A pre-shared key.
    Psk(PskKex),
    /// A key exchange alone.
    Hybrid,
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Psk(kex) => kex.fmt(f),
            Self::Hybrid => f.write_str("hybrid"),
        }
    }
}

/// The data that the two ends of a connection share before it begins.
#[derive(Clone, Copy)]
pub struct Terms<'a> {
    /// The cipher suite.
    pub cipher: Cipher,
    /// The key exchange.
    pub mode: Mode,
    /// The QKD key, which `Mode::Hybrid` does not use.
    pub key: &'a [u8],
    /// The key's name.
    pub key_id: &'a str,
    /// The SAE that dials.
    pub client: &'a str,
    /// The SAE that is dialled.
    pub server: &'a str,
}

#[derive(Clone, Copy)]
struct Hash(Cipher);

impl Hash {
    fn len(self) -> usize {
        if self.0 == Cipher::Aes256Gcm { 48 } else { 32 }
    }

    fn digest(self, data: &[u8]) -> Vec<u8> {
        match self.0 {
            Cipher::Aes256Gcm => Sha384::digest(data).to_vec(),
            Cipher::ChaCha20Poly1305 => Sha256::digest(data).to_vec(),
        }
    }

    fn hmac(self, key: &[u8], data: &[u8]) -> Vec<u8> {
        match self.0 {
            Cipher::Aes256Gcm => {
                let mac = Hmac::<Sha384>::new_from_slice(key).unwrap();
                mac.chain_update(data).finalize().into_bytes().to_vec()
            }
            Cipher::ChaCha20Poly1305 => {
                let mac = Hmac::<Sha256>::new_from_slice(key).unwrap();
                mac.chain_update(data).finalize().into_bytes().to_vec()
            }
        }
    }

    /// Computes HKDF-Expand-Label for at most one block.
    fn expand(self, secret: &[u8], label: &str, context: &[u8], len: usize) -> Vec<u8> {
        let mut info = vec![0, len as u8, label.len() as u8 + 6];
        info.extend(b"tls13 ");
        info.extend(label.as_bytes());
        info.push(context.len() as u8);
        info.extend(context);
        info.push(1);
        self.hmac(secret, &info)[..len].to_vec()
    }

    fn derive(self, secret: &[u8], label: &str, messages: &[u8]) -> Vec<u8> {
        self.expand(secret, label, &self.digest(messages), self.len())
    }
}

/// Every secret of one connection.
pub struct Schedule {
    hash: Hash,
    used_up: Vec<Secret>,
    in_use: Vec<Secret>,
    exporter: Vec<u8>,
}

impl Schedule {
    /// Computes the secrets. `transcript` is ClientHello to the client's Finished, and `shared` the result of the key
    /// exchange. If there was a key exchange and `shared` is `None`, the schedule ends where its result is needed.
    ///
    /// # Panics
    /// The transcript is not complete.
    pub fn new(terms: Terms<'_>, transcript: &[u8], shared: Option<&[u8]>) -> Self {
        let mut schedule = Self::empty(terms.cipher);
        let (hash, len) = (schedule.hash, schedule.hash.len());
        let Some(handshake) = schedule.until_handshake_secret(terms, shared) else {
            return schedule;
        };
        let [server_hello, server_finished, client_finished] =
            flights(transcript).expect("the transcript is complete");
        let traffic = schedule.handshake_traffic_secrets(&handshake, server_hello);
        for (name, secret) in ["client", "server"].into_iter().zip(traffic) {
            let finished = hash.expand(&secret, "finished", b"", len);
            schedule.step(format!("{name}'s finished key"), finished);
            for label in ["quic key", "quic hp"] {
                let key = hash.expand(&secret, label, b"", 32);
                schedule.step(format!("{name}'s handshake {label}"), key);
            }
        }
        let derived =
            schedule.step("second derived secret", hash.derive(&handshake, "derived", b""));
        let master = schedule.step("master secret", hash.hmac(&derived, &vec![0; len]));

        for (name, label) in [("client", "c ap traffic"), ("server", "s ap traffic")] {
            let mut secret = hash.derive(&master, label, server_finished);
            let header = hash.expand(&secret, "quic hp", b"", 32);
            schedule.later(format!("{name}'s quic hp"), header);
            for update in 0..4 {
                let traffic = format!("{name} traffic secret {update}");
                // The keys of 0 and 1 are derived when the handshake is complete. An end that has
                // not seen the update of the keys yet needs 2, and one that has needs 3.
                if update < 2 {
                    schedule.step(traffic, secret.clone());
                } else {
                    schedule.later(traffic, secret.clone());
                }
                let key = hash.expand(&secret, "quic key", b"", 32);
                schedule.later(format!("{name}'s quic key {update}"), key);
                secret = hash.expand(&secret, "quic ku", b"", len);
            }
        }
        schedule.exporter = hash.derive(&master, "exp master", server_finished);
        schedule.later("exporter secret", schedule.exporter.clone());
        let resumption = hash.derive(&master, "res master", client_finished);
        schedule.step("resumption secret", resumption);
        schedule
    }

    /// Returns the traffic secrets of the handshake, the client's and the server's, from ClientHello and ServerHello.
    pub fn of_handshake(terms: Terms<'_>, hellos: &[u8], shared: Option<&[u8]>) -> [Vec<u8>; 2] {
        let mut schedule = Self::empty(terms.cipher);
        let handshake = schedule.until_handshake_secret(terms, shared);
        schedule.handshake_traffic_secrets(&handshake.expect("all inputs are known"), hellos)
    }

    /// Returns the key of QUIC's packets, its IV, and the key of their headers, from a traffic secret.
    pub fn packet_keys(cipher: Cipher, secret: &[u8]) -> ([u8; 32], [u8; 12], [u8; 32]) {
        let expand = |label, len| Hash(cipher).expand(secret, label, b"", len);
        let [key, iv, header] = [("quic key", 32), ("quic iv", 12), ("quic hp", 32)]
            .map(|(label, len)| expand(label, len));
        let fits = "as long as asked for";
        (key.try_into().expect(fits), iv.try_into().expect(fits), header.try_into().expect(fits))
    }

    fn empty(cipher: Cipher) -> Self {
        Self { hash: Hash(cipher), used_up: vec![], in_use: vec![], exporter: vec![] }
    }

    /// Returns the handshake secret. Returns `None` if it depends on a key exchange whose result is not known.
    fn until_handshake_secret(
        &mut self,
        terms: Terms<'_>,
        shared: Option<&[u8]>,
    ) -> Option<Vec<u8>> {
        let (hash, len) = (self.hash, self.hash.len());
        let zeros = vec![0; len];
        let derived = match terms.mode {
            Mode::Psk(_) => {
                let psk = self.pre_shared_key(terms);
                let early = self.step("early secret", hash.hmac(&zeros, &psk));
                let binder = self.step("binder key", hash.derive(&early, "ext binder", b""));
                self.step("binder's finished key", hash.expand(&binder, "finished", b"", len));
                self.step("derived secret", hash.derive(&early, "derived", b""))
            }
            // These are the same for every connection.
            Mode::Hybrid => hash.derive(&hash.hmac(&zeros, &zeros), "derived", b""),
        };
        let exchanged = match (terms.mode, shared) {
            (Mode::Psk(PskKex::PskKe), None) => zeros,
            (Mode::Psk(PskKex::PskKe), Some(_)) => unreachable!("nothing is exchanged"),
            (_, shared) => self.step("shared secret", shared?.to_vec()),
        };
        Some(self.step("handshake secret", hash.hmac(&derived, &exchanged)))
    }

    fn handshake_traffic_secrets(&mut self, handshake: &[u8], hellos: &[u8]) -> [Vec<u8>; 2] {
        [("client", "c hs traffic"), ("server", "s hs traffic")].map(|(name, label)| {
            let secret = self.hash.derive(handshake, label, hellos);
            self.step(format!("{name} handshake traffic secret"), secret)
        })
    }

    /// Returns the PSK that `derive_psk()` derives from a QKD key.
    pub fn psk(terms: Terms<'_>) -> Vec<u8> {
        Self::empty(terms.cipher).pre_shared_key(terms)
    }

    /// Computes the PSK as the documentation of `derive_psk()` specifies it.
    fn pre_shared_key(&mut self, terms: Terms<'_>) -> Vec<u8> {
        let (sha256, len) = (Hash(Cipher::ChaCha20Poly1305), self.hash.len());
        let prk = sha256.hmac(b"AXON-QKD-TLS13-EXTERNAL-PSK-v1", terms.key);
        let mut info = Vec::new();
        let name = if len == 48 { "SHA384" } else { "SHA256" };
        for part in [terms.key_id, terms.client, terms.server, name] {
            info.extend((part.len() as u16).to_be_bytes());
            info.extend(part.as_bytes());
        }
        let first = sha256.hmac(&prk, &[&info[..], &[1]].concat());
        let second = sha256.hmac(&prk, &[&first[..], &info, &[2]].concat());
        let psk = [first, second].concat()[..len].to_vec();
        self.step("QKD key", terms.key.to_vec());
        self.step("PRK of the QKD key", prk);
        self.later("pre-shared key", psk.clone());
        psk
    }

    fn step(&mut self, name: impl Into<String>, secret: Vec<u8>) -> Vec<u8> {
        self.used_up.push(Secret::new(name, &secret));
        secret
    }

    fn later(&mut self, name: impl Into<String>, secret: Vec<u8>) {
        self.in_use.push(Secret::new(name, &secret));
    }

    /// Returns the secrets that an established connection has no use for.
    pub fn used_up(&self) -> &[Secret] {
        &self.used_up
    }

    /// Returns the secrets that an established connection still uses.
    pub fn in_use(&self) -> &[Secret] {
        &self.in_use
    }

    /// Returns the exporter's output for this label without a context, after the secret from which it is expanded;
    /// `None` where the schedule ends earlier.
    pub fn export(&self, label: &str) -> Option<[Vec<u8>; 2]> {
        if self.exporter.is_empty() {
            return None;
        }
        let of_label = self.hash.derive(&self.exporter, label, b"");
        let exported = self.hash.expand(&of_label, "exporter", &self.hash.digest(b""), 32);
        Some([of_label, exported])
    }

    /// Returns every secret.
    pub fn all(&self) -> Vec<Secret> {
        [self.used_up(), self.in_use()].concat()
    }
}

/// Returns the transcript up to ServerHello, up to the server's Finished, and up to the client's; `None` while it is
/// incomplete.
pub fn flights(transcript: &[u8]) -> Option<[&[u8]; 3]> {
    let mut ends = Vec::new();
    let mut at = 0;
    while let [kind, high, middle, low, ..] = *transcript.get(at..)? {
        at += 4 + usize::from(high) * 65_536 + usize::from(middle) * 256 + usize::from(low);
        ends.push((kind, at));
    }
    let finished: Vec<usize> =
        ends.iter().filter(|(kind, _)| *kind == 20).map(|(_, end)| *end).collect();
    let [of_server, of_client] = finished[..] else { return None };
    let kinds: Vec<u8> = ends.iter().map(|(kind, _)| *kind).collect();
    assert_eq!((&kinds[..3], kinds.last()), (&[1, 2, 8][..], Some(&20)), "{kinds:?}");
    Some([ends[1].1, of_server, of_client].map(|end| &transcript[..end]))
}

/// Compares the key schedule with RFC 8448, section 3. Without this test the searches would prove nothing.
#[test]
fn the_key_schedule_is_that_of_rfc_8448() {
    let hash = Hash(Cipher::ChaCha20Poly1305);
    let early = hash.hmac(&[0; 32], &[0; 32]);
    let derived = hash.derive(&early, "derived", b"");
    assert_eq!(early, unhex("33ad0a1c607ec03b09e6cd9893680ce210adf300aa1f2660e1b22e10f170f92a"));
    assert_eq!(derived, unhex("6f2615a108c702c5678f54fc9dbab69716c076189c48250cebeac3576c3611ba"));
}

#[cfg(test)]
fn unhex(text: &str) -> Vec<u8> {
    let byte = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
    (0..text.len()).step_by(2).map(byte).collect()
}
