//! The proof in READY: it shows that its sender holds the key, and binds the key to this connection (docs/formats.md,
//! section 2).

use axon_envelope::{KeyId, KmeKey};
use hkdf::Hkdf;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;
use zeroize::Zeroizing;

use crate::wire::keys::PROOF_LEN as LEN;

/// Returns `HMAC-SHA256(HKDF-SHA256(no salt, key, "axon ready"), key_ID || ready)`; `ready` is the connection's TLS
/// exporter [`READY_EXPORTER`](super::READY_EXPORTER).
pub fn compute(key: &KmeKey, key_id: &KeyId, ready: &[u8; 32]) -> [u8; LEN] {
    key.derive(|key| mac(key, key_id, ready).finalize().into_bytes().into())
}

/// Returns whether `proof` equals the proof that [`compute`] returns. Compares in constant time.
#[must_use]
pub fn verify(key: &KmeKey, key_id: &KeyId, ready: &[u8; 32], proof: &[u8; LEN]) -> bool {
    key.derive(|key| mac(key, key_id, ready).verify_slice(proof).is_ok())
}

fn mac(key: &[u8; LEN], key_id: &KeyId, ready: &[u8; 32]) -> Hmac<Sha256> {
    let mut k = Zeroizing::new([0; LEN]);
    Hkdf::<Sha256>::new(None, key)
        .expand(b"axon ready", &mut k[..])
        .expect("32 bytes are within HKDF-SHA256's limit of 8160");
    Hmac::<Sha256>::new_from_slice(&k[..])
        .expect("HMAC takes keys of any length")
        .chain_update(key_id.as_bytes())
        .chain_update(ready)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(byte: u8) -> KmeKey {
        KmeKey::from_slice(&[byte; 32]).unwrap()
    }

    fn id(text: &str) -> KeyId {
        KeyId::new(text).unwrap()
    }

    #[test]
    fn anything_else_changed_is_refused() {
        let proof = compute(&key(1), &id("a"), &[2; 32]);
        assert!(!verify(&key(3), &id("a"), &[2; 32], &proof), "another key");
        assert!(!verify(&key(1), &id("A"), &[2; 32], &proof), "another spelling of the key_ID");
        assert!(!verify(&key(1), &id("a"), &[3; 32], &proof), "another connection");
        for bit in 0..LEN * 8 {
            let mut wrong = proof;
            wrong[bit / 8] ^= 1 << (bit % 8);
            assert!(!verify(&key(1), &id("a"), &[2; 32], &wrong), "bit {bit}");
        }
        assert!(verify(&key(1), &id("a"), &[2; 32], &proof));
    }

    // Computed apart, with Python's hmac and hashlib alone:
    //   prk = hmac.new(b"\0"*32, KEY, sha256).digest()
    //   k = hmac.new(prk, b"axon ready" + b"\x01", sha256).digest()
    //   hmac.new(k, KEY_ID + READY, sha256).hexdigest()
    #[test]
    fn vectors() {
        let rising: Vec<u8> = (0..32).collect();
        let falling: Vec<u8> = (0..32).rev().map(|i| i * 8).collect();
        for (key, key_id, ready, expected) in [
            (
                &rising,
                "bc490419-7d60-487f-adc1-4ddcc177c139",
                &falling[..],
                "ecfe13c9492accb137459ca74f8639bae49af7d8f1a5c799ff5df39d67b202e9",
            ),
            (
                &falling,
                "Key/7",
                &rising[..],
                "c3d3c766f252aa915b1c236fb3c7a0f60f166f03cabf758bdd44be69f08c5606",
            ),
        ] {
            let key = KmeKey::from_slice(key).unwrap();
            let ready: &[u8; 32] = ready.try_into().unwrap();
            let proof = compute(&key, &id(key_id), ready);
            let hex: String = proof.iter().map(|b| format!("{b:02x}")).collect();
            assert_eq!(hex, expected);
        }
    }
}
