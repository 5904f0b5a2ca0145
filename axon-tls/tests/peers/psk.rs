//! Peers on the pre-shared key of the vectors.

use std::sync::Arc;

use axon_tls::qkd::{self, Psk, PskResolver, derive_psk};
use axon_tls::{Cipher, KeyExchange, PskKex};
use rustls_axon::{ClientConnection, ServerConnection};

use super::{LABEL, Peer, file};

const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";

/// Returns the PSK that follows from the key of the vectors with another first byte; 0 is the right one.
pub(crate) fn psk(cipher: Cipher, first_byte: u8) -> Arc<Psk> {
    let mut key: [u8; 32] = std::array::from_fn(|at| at as u8);
    key[0] = first_byte;
    Arc::new(derive_psk(&key, KEY_ID, "sae-client", "sae-server", cipher).unwrap())
}

/// Returns identity and key as the independent script derived them, in hexadecimal.
pub(crate) fn vector(cipher: Cipher) -> (String, String) {
    let hash = if cipher == Cipher::Aes256Gcm { "SHA384" } else { "SHA256" };
    let vectors: Vec<serde_json::Value> =
        serde_json::from_str(include_str!("../vectors/psk.json")).unwrap();
    let vector = vectors
        .iter()
        .find(|vector| {
            vector["key_id"] == KEY_ID
                && vector["client_sae"] == "sae-client"
                && vector["hash"] == hash
        })
        .unwrap();
    let text = |name: &str| vector[name].as_str().unwrap().to_owned();
    (text("identity"), text("psk"))
}

struct OneKey(Arc<Psk>);

impl std::fmt::Debug for OneKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("OneKey")
    }
}

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        (identity == self.0.identity()).then(|| Arc::clone(&self.0))
    }
}

/// OpenSSL takes a PSK with SHA-384 only as a session: `SSL_SESSION` in DER, in PEM.
fn session(psk: &str) -> String {
    use base64::Engine as _;
    let key = (0..psk.len()).step_by(2).map(|at| u8::from_str_radix(&psk[at..at + 2], 16).unwrap());
    let mut body = vec![2, 1, 1, 2, 2, 3, 4, 4, 2, 0x13, 0x02, 4, 0, 4, 48];
    body.extend(key);
    // as old as can be, and valid for 127 seconds: a PSK does not age
    body.extend([0xa1, 3, 2, 1, 0, 0xa2, 3, 2, 1, 0x7f]);
    let der = [&[0x30, body.len() as u8], &body[..]].concat();
    let body = base64::engine::general_purpose::STANDARD.encode(der);
    let (first, second) = body.split_at(64);
    let label = "SSL SESSION PARAMETERS-----";
    file("session.pem", &format!("-----BEGIN {label}\n{first}\n{second}\n-----END {label}\n"))
}

pub(crate) fn openssl_psk(program: &str, command: &[&str], cipher: Cipher, kex: PskKex) -> Peer {
    let (identity, secret) = vector(cipher);
    let mut args = command.to_vec();
    args.extend(["-tls1_3", "-psk_identity", &identity, "-keymatexport", LABEL]);
    args.extend(["-keymatexportlen", "32"]);
    if kex == PskKex::PskKe {
        args.push("-allow_no_dhe_kex");
    } else {
        args.extend(["-groups", "X25519MLKEM768"]);
    }
    let session_file;
    match cipher {
        Cipher::ChaCha20Poly1305 => {
            args.extend(["-psk", &secret, "-ciphersuites", "TLS_CHACHA20_POLY1305_SHA256"]);
        }
        Cipher::Aes256Gcm => {
            session_file = session(&secret);
            args.extend(["-psk_session", &session_file, "-ciphersuites", "TLS_AES_256_GCM_SHA384"]);
        }
    }
    Peer::start(program, &args)
}

pub(crate) fn is_on(negotiated: Option<axon_tls::Negotiated>, cipher: Cipher, kex: PskKex) {
    let negotiated = negotiated.expect("the handshake is complete");
    let expected = match kex {
        PskKex::PskKe => KeyExchange::PskKe,
        PskKex::PskDheKe => KeyExchange::PskDheKe,
    };
    assert_eq!((negotiated.key_exchange, negotiated.cipher), (expected, cipher));
    assert_eq!(negotiated.psk_identity.unwrap(), vector(cipher).0.into_bytes());
}

pub(crate) fn our_client(psk: Arc<Psk>, kex: PskKex) -> ClientConnection {
    let config = qkd::client_config(psk, kex, b"").unwrap();
    ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
}

pub(crate) fn our_server(psk: Arc<Psk>, kex: PskKex) -> ServerConnection {
    let cipher = psk.cipher();
    let config = qkd::server_config(Arc::new(OneKey(psk)), cipher, kex, b"").unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}
