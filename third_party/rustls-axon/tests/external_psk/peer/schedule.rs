//! The key schedule of RFC 8446, section 7, for SHA-256.

use hmac::{Hmac, KeyInit, Mac};
use sha2::{Digest, Sha256};

pub(crate) type Secret = [u8; 32];

pub(crate) fn digest(messages: &[u8]) -> Secret {
    Sha256::digest(messages).into()
}

fn hmac(key: &[u8], data: &[u8]) -> Secret {
    let mut mac = Hmac::<Sha256>::new_from_slice(key).unwrap();
    mac.update(data);
    mac.finalize().into_bytes().into()
}

pub(super) fn expand_label(secret: &Secret, label: &str, context: &[u8], len: usize) -> Vec<u8> {
    assert!(len <= 32, "one block of HKDF-Expand");
    let mut info = vec![0, len as u8, label.len() as u8 + 6];
    info.extend(b"tls13 ");
    info.extend(label.as_bytes());
    info.push(context.len() as u8);
    info.extend(context);
    info.push(1);
    hmac(secret, &info)[..len].to_vec()
}

/// Derive-Secret, with the transcript already hashed.
pub(crate) fn derive(secret: &Secret, label: &str, transcript_hash: &Secret) -> Secret {
    expand_label(secret, label, transcript_hash, 32).try_into().unwrap()
}

/// The `verify_data` of a Finished, or a binder.
pub(crate) fn finished(base: &Secret, transcript_hash: &Secret) -> Secret {
    hmac(&expand_label(base, "finished", b"", 32), transcript_hash)
}

/// What a ticket stands for.
pub(crate) fn resumption_psk(resumption_master: &Secret, nonce: &[u8]) -> Secret {
    expand_label(resumption_master, "resumption", nonce, 32).try_into().unwrap()
}

pub(crate) struct Early(Secret);

impl Early {
    /// Without a PSK there are zeros in its place.
    pub(crate) fn new(psk: Option<&[u8]>) -> Self {
        Self(hmac(&[0; 32], psk.unwrap_or(&[0; 32])))
    }

    /// A binder under `label`, which should be `ext binder`, `imp binder` or `res binder`.
    pub(crate) fn binder(&self, label: &str, transcript_hash: &Secret) -> Secret {
        finished(&derive(&self.0, label, &digest(b"")), transcript_hash)
    }

    pub(crate) fn traffic(&self, client_hello_hash: &Secret) -> Secret {
        derive(&self.0, "c e traffic", client_hello_hash)
    }

    pub(super) fn handshake(&self, shared: Option<&[u8]>, transcript_hash: &Secret) -> Handshake {
        let salt = derive(&self.0, "derived", &digest(b""));
        let secret = hmac(&salt, shared.unwrap_or(&[0; 32]));
        Handshake {
            client: derive(&secret, "c hs traffic", transcript_hash),
            server: derive(&secret, "s hs traffic", transcript_hash),
            secret,
        }
    }
}

pub(super) struct Handshake {
    secret: Secret,
    pub(super) client: Secret,
    pub(super) server: Secret,
}

impl Handshake {
    /// `transcript_hash` is up to the server's Finished.
    pub(super) fn application(&self, transcript_hash: &Secret) -> Application {
        let master = hmac(&derive(&self.secret, "derived", &digest(b"")), &[0; 32]);
        Application {
            client: derive(&master, "c ap traffic", transcript_hash),
            server: derive(&master, "s ap traffic", transcript_hash),
            master,
        }
    }
}

pub(super) struct Application {
    pub(super) master: Secret,
    pub(super) client: Secret,
    pub(super) server: Secret,
}

/// RFC 8448, section 4: what makes this key schedule worth anything.
#[test]
fn binders_are_those_of_rfc_8448() {
    let unhex = |text: &str| -> Vec<u8> {
        let digits = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
        (0..text.len()).step_by(2).map(digits).collect()
    };
    let psk = unhex("4ecd0eb6ec3b4d87f5d6028f922ca4c5851a277fd41311c9e62d2c9492e1c4f3");
    let hash = unhex("63224b2e4573f2d3454ca84b9d009a04f6be9e05711a8396473aefa01e924a14");
    let binder = unhex("3add4fb2d8fdf822a0ca3cf7678ef5e88dae990141c5924d57bb6fa31b9e5f9d");
    let ours = Early::new(Some(&psk)).binder("res binder", &hash.try_into().unwrap());
    assert_eq!(ours.to_vec(), binder);
}
