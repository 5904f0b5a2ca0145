//! Derives a pre-shared key of TLS from a QKD key.

use std::hint::black_box;

use aws_lc_rs::hkdf::{HKDF_SHA256, KeyType, Salt};
use rustls_axon::external_psk::ExternalPsk;
use zeroize::Zeroizing;

use super::PskIdentity;
use crate::erase::erasing_stack;
use crate::psk::Psk;
use crate::{Cipher, Error};

/// Derives the pre-shared key of one connection from a QKD key.
///
/// The derivation is `HKDF-SHA256` with the salt `AXON-QKD-TLS13-EXTERNAL-PSK-v1` and the key. The
/// info is the key_ID, the client SAE, the server SAE and the name of the cipher's hash, each
/// preceded by its length. The result is as long as the output of that hash.
///
/// Client and server give the same names in the same order. Equal SAE IDs are refused.
pub fn derive_psk(
    key: &[u8; 32],
    key_id: &str,
    client_sae: &str,
    server_sae: &str,
    cipher: Cipher,
) -> Result<Psk, Error> {
    let identity = PskIdentity::new(client_sae, key_id)?;
    if server_sae.is_empty() || server_sae.len() > MAX_SAE_ID {
        return Err(Error::Name { what: "server SAE ID", reason: "must have 1 to 255 bytes" });
    }
    if client_sae == server_sae {
        return Err(Error::EqualSaeIds);
    }

    let (hash_name, len) = match cipher {
        Cipher::ChaCha20Poly1305 => ("SHA256", 32),
        Cipher::Aes256Gcm => ("SHA384", 48),
    };
    let names = [key_id, client_sae, server_sae, hash_name];
    let secret = erasing_stack(|| secret(key, names, len))?;
    Ok(ExternalPsk::new(identity.to_bytes(), secret, cipher.hash())?.into())
}

fn secret(key: &[u8; 32], names: [&str; 4], len: usize) -> Result<Zeroizing<Vec<u8>>, Error> {
    let mut info = Vec::new();
    for name in names {
        length_prefixed(&mut info, name.as_bytes());
    }
    let mut secret = Zeroizing::new(vec![0; len]);
    fill(black_box(key), &info, &mut secret)?;
    // aws-lc-rs moves the extracted key and leaves it on the stack. The same code with a public key
    // overwrites the same places.
    fill(black_box(&[0; 32]), &info, &mut Zeroizing::new(vec![0; len]))?;
    Ok(secret)
}

/// The function is never inlined, so that each call runs the same code at the same stack depth.
#[inline(never)]
fn fill(key: &[u8; 32], info: &[u8], secret: &mut [u8]) -> Result<(), Error> {
    Salt::new(HKDF_SHA256, SALT)
        .extract(key)
        .expand(&[info], Len(secret.len()))
        .and_then(|okm| okm.fill(secret))
        .map_err(|_| Error::KeyGeneration)
}

const SALT: &[u8] = b"AXON-QKD-TLS13-EXTERNAL-PSK-v1";
const MAX_SAE_ID: usize = 255;

/// Appends the length as a 16-bit number, then the bytes. The caller has checked that all names are
/// short.
fn length_prefixed(out: &mut Vec<u8>, part: &[u8]) {
    out.extend_from_slice(&(part.len() as u16).to_be_bytes());
    out.extend_from_slice(part);
}

struct Len(usize);

impl KeyType for Len {
    fn len(&self) -> usize {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::PskKex;
    use crate::qkd::client_config;
    use rustls_axon::ClientConnection;

    /// The vectors come from `tests/vectors/make.py`, which is independent of this file.
    #[test]
    fn vectors() {
        let vectors: Vec<serde_json::Value> =
            serde_json::from_str(include_str!("../../tests/vectors/psk.json")).unwrap();
        assert_eq!(vectors.len(), 12);
        for vector in vectors {
            let text = |name: &str| vector[name].as_str().unwrap();
            let key: Vec<u8> = (0..32)
                .map(|at| u8::from_str_radix(&text("key")[2 * at..][..2], 16).unwrap())
                .collect();
            let key: [u8; 32] = key.try_into().unwrap();
            let (cipher, len) = match text("hash") {
                "SHA256" => (Cipher::ChaCha20Poly1305, 32),
                _ => (Cipher::Aes256Gcm, 48),
            };
            let (key_id, client, server) = (text("key_id"), text("client_sae"), text("server_sae"));

            let psk = derive_psk(&key, key_id, client, server, cipher).unwrap();
            assert_eq!(psk.identity(), text("identity").as_bytes());
            assert_eq!(psk.cipher(), cipher);
            let secret = secret(&key, [key_id, client, server, text("hash")], len).unwrap();
            let hex: String = secret.iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(hex, text("psk"));
        }
    }

    #[test]
    fn erased_key_begins_no_handshake() {
        let psk = Arc::new(derive_psk(&[1; 32], "k", "a", "b", Cipher::default()).unwrap());
        let config = client_config(Arc::clone(&psk), PskKex::PskKe, b"").unwrap();
        let config = Arc::new(config);
        let connect = || ClientConnection::new(Arc::clone(&config), "peer".try_into().unwrap());
        assert!(connect().is_ok());
        psk.erase();
        assert!(connect().is_err());
    }

    #[test]
    fn names_that_cannot_be_told_apart_are_refused() {
        let derive = |client, server| derive_psk(&[1; 32], "k", client, server, Cipher::default());
        assert!(matches!(derive("a", "a"), Err(Error::EqualSaeIds)));
        assert!(derive("", "a").is_err());
        assert!(derive("a", "").is_err());
        assert!(derive("a", &"b".repeat(256)).is_err());
        assert!(derive_psk(&[1; 32], "", "a", "b", Cipher::default()).is_err());
    }
}
