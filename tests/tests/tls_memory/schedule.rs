//! The key schedule of RFC 8446 section 7 and RFC 9001 section 5, from a QKD key on.

use axon_tls::{Cipher, PskKex};
use hmac::{Hmac, KeyInit, Mac};
use sha2::{Digest, Sha256, Sha384};

use crate::child::{CLIENT_SAE, EXPORTER, KEY_ID, Mode, SERVER_SAE};

pub(crate) struct Secret {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
}

impl Secret {
    pub(crate) fn new(name: impl Into<String>, bytes: &[u8]) -> Self {
        Self { name: name.into(), bytes: bytes.to_vec() }
    }
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

    /// HKDF-Expand-Label for at most one block.
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
pub(crate) struct Schedule {
    hash: Hash,
    /// Secrets that an established connection has no use for.
    used_up: Vec<(String, Vec<u8>)>,
    /// Secrets that an established connection still uses.
    in_use: Vec<(String, Vec<u8>)>,
    /// What the exporter gives for [`EXPORTER`] without a context.
    exported: Vec<u8>,
}

impl Schedule {
    /// `transcript` is ClientHello to the client's Finished, and `shared` what the key exchange gave. Where there
    /// was one and that is not known, the schedule ends where it comes in.
    pub(crate) fn new(
        cipher: Cipher,
        mode: Mode,
        key: &[u8; 32],
        transcript: &[u8],
        shared: Option<&[u8]>,
    ) -> Self {
        let mut schedule =
            Self { hash: Hash(cipher), used_up: vec![], in_use: vec![], exported: vec![] };
        let (hash, len) = (schedule.hash, schedule.hash.len());
        let zeros = vec![0; len];

        let derived = match mode {
            Mode::Psk(_) => {
                let psk = schedule.pre_shared_key(key);
                let early = schedule.step("early secret", hash.hmac(&zeros, &psk));
                let binder = schedule.step("binder key", hash.derive(&early, "ext binder", b""));
                schedule.step("binder's finished key", hash.expand(&binder, "finished", b"", len));
                schedule.step("derived secret", hash.derive(&early, "derived", b""))
            }
            // These are the same for every connection.
            Mode::Hybrid => hash.derive(&hash.hmac(&zeros, &zeros), "derived", b""),
        };
        let exchanged = match (mode, shared) {
            (Mode::Psk(PskKex::PskKe), None) => zeros.clone(),
            (Mode::Psk(PskKex::PskKe), Some(_)) => unreachable!("nothing is exchanged"),
            (_, None) => return schedule,
            (_, Some(shared)) => schedule.step("shared secret", shared.to_vec()),
        };

        let [server_hello, server_finished, client_finished] = flights(transcript);
        let handshake = schedule.step("handshake secret", hash.hmac(&derived, &exchanged));
        for (name, label) in [("client", "c hs traffic"), ("server", "s hs traffic")] {
            let secret = hash.derive(&handshake, label, server_hello);
            schedule.step(format!("{name} handshake traffic secret"), secret.clone());
            let finished = hash.expand(&secret, "finished", b"", len);
            schedule.step(format!("{name}'s finished key"), finished);
            for label in ["quic key", "quic hp"] {
                let key = hash.expand(&secret, label, b"", 32);
                schedule.step(format!("{name}'s handshake {label}"), key);
            }
        }
        let derived =
            schedule.step("second derived secret", hash.derive(&handshake, "derived", b""));
        let master = schedule.step("master secret", hash.hmac(&derived, &zeros));

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
        let exporter = hash.derive(&master, "exp master", server_finished);
        let exported = hash.derive(&exporter, EXPORTER, b"");
        schedule.exported = hash.expand(&exported, "exporter", &hash.digest(b""), 32);
        schedule.later("exporter secret", exporter);
        schedule.step("secret of one exporter label", exported);
        let resumption = hash.derive(&master, "res master", client_finished);
        schedule.step("resumption secret", resumption);
        schedule
    }

    /// What `derive_psk()` makes of a QKD key.
    pub(crate) fn psk(cipher: Cipher, key: &[u8; 32]) -> Vec<u8> {
        let mut schedule =
            Self { hash: Hash(cipher), used_up: vec![], in_use: vec![], exported: vec![] };
        schedule.pre_shared_key(key)
    }

    /// The same, by the words of its documentation.
    fn pre_shared_key(&mut self, key: &[u8; 32]) -> Vec<u8> {
        let (sha256, len) = (Hash(Cipher::ChaCha20Poly1305), self.hash.len());
        let prk = sha256.hmac(b"AXON-QKD-TLS13-EXTERNAL-PSK-v1", key);
        let mut info = Vec::new();
        let name = if len == 48 { "SHA384" } else { "SHA256" };
        for part in [KEY_ID, CLIENT_SAE, SERVER_SAE, name] {
            info.extend((part.len() as u16).to_be_bytes());
            info.extend(part.as_bytes());
        }
        let first = sha256.hmac(&prk, &[&info[..], &[1]].concat());
        let second = sha256.hmac(&prk, &[&first[..], &info, &[2]].concat());
        let psk = [first, second].concat()[..len].to_vec();
        self.step("QKD key", key.to_vec());
        self.step("PRK of the QKD key", prk);
        self.later("pre-shared key", psk.clone());
        psk
    }

    fn step(&mut self, name: impl Into<String>, secret: Vec<u8>) -> Vec<u8> {
        self.used_up.push((name.into(), secret.clone()));
        secret
    }

    fn later(&mut self, name: impl Into<String>, secret: Vec<u8>) {
        self.in_use.push((name.into(), secret));
    }

    pub(crate) fn used_up(&self) -> Vec<Secret> {
        self.used_up.iter().map(|(name, bytes)| Secret::new(name, bytes)).collect()
    }

    /// What either end exports: it shows that the schedule is that of the connection.
    pub(crate) fn exported(&self) -> &[u8] {
        &self.exported
    }

    pub(crate) fn all(&self) -> Vec<Secret> {
        let all = self.used_up.iter().chain(&self.in_use);
        all.map(|(name, bytes)| Secret::new(name, bytes)).collect()
    }
}

/// The transcript up to ServerHello, up to the server's Finished, and up to the client's.
fn flights(transcript: &[u8]) -> [&[u8]; 3] {
    let mut ends = Vec::new();
    let mut at = 0;
    while let [kind, high, middle, low, ..] = transcript[at..] {
        at += 4 + usize::from(high) * 65_536 + usize::from(middle) * 256 + usize::from(low);
        ends.push((kind, at));
    }
    let kinds: Vec<u8> = ends.iter().map(|(kind, _)| *kind).collect();
    assert_eq!((kinds[..3].to_vec(), kinds.last()), (vec![1, 2, 8], Some(&20)), "{kinds:?}");
    let finished: Vec<usize> =
        ends.iter().filter(|(kind, _)| *kind == 20).map(|(_, end)| *end).collect();
    assert_eq!(finished.len(), 2, "{kinds:?}");
    [ends[1].1, finished[0], finished[1]].map(|end| &transcript[..end])
}

/// RFC 8448, section 3: what makes this key schedule worth anything.
#[test]
fn the_key_schedule_is_that_of_rfc_8448() {
    let hash = Hash(Cipher::ChaCha20Poly1305);
    let early = hash.hmac(&[0; 32], &[0; 32]);
    let derived = hash.derive(&early, "derived", b"");
    assert_eq!(
        early,
        crate::unhex("33ad0a1c607ec03b09e6cd9893680ce210adf300aa1f2660e1b22e10f170f92a")
    );
    assert_eq!(
        derived,
        crate::unhex("6f2615a108c702c5678f54fc9dbab69716c076189c48250cebeac3576c3611ba")
    );
}
