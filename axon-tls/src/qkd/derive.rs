//! From a QKD key to a pre-shared key of TLS.

use std::sync::Arc;

use aws_lc_rs::hkdf::{HKDF_SHA256, KeyType, Salt};
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::ExternalPsk;
use zeroize::Zeroizing;

use super::PskIdentity;
use crate::{Cipher, Error};

/// A pre-shared key for one connection, and the identity it is named by.
///
/// Zeroized on drop; neither `Clone` nor `Debug`. Share it with an [`Arc`].
pub struct Psk {
    psk: Arc<ExternalPsk>,
    cipher: Cipher,
}

impl Psk {
    /// The identity, as the client sends it.
    pub fn identity(&self) -> &[u8] {
        self.psk.identity()
    }

    /// The only cipher this key can be used with.
    pub fn cipher(&self) -> Cipher {
        self.cipher
    }

    pub(crate) fn external(&self) -> Arc<ExternalPsk> {
        Arc::clone(&self.psk)
    }
}

/// Derives the pre-shared key of one connection from a QKD key.
///
/// `HKDF-SHA256` with the salt `AXON-QKD-TLS13-EXTERNAL-PSK-v1`, the key, and as info key_ID,
/// client SAE, server SAE and the name of the cipher's hash, each with its length in front; as long
/// as that hash.
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

    let (hash_name, hash) = match cipher {
        Cipher::ChaCha20Poly1305 => ("SHA256", HashAlgorithm::SHA256),
        Cipher::Aes256Gcm => ("SHA384", HashAlgorithm::SHA384),
    };
    let mut info = Vec::new();
    for part in [key_id, client_sae, server_sae, hash_name] {
        length_prefixed(&mut info, part.as_bytes());
    }

    let len = if hash == HashAlgorithm::SHA384 { 48 } else { 32 };
    let mut secret = Zeroizing::new(vec![0; len]);
    Salt::new(HKDF_SHA256, SALT)
        .extract(key)
        .expand(&[&info], Len(len))
        .and_then(|okm| okm.fill(&mut secret))
        .map_err(|_| Error::KeyGeneration)?;

    let psk = ExternalPsk::new(identity.to_bytes(), secret, hash)?;
    Ok(Psk { psk: Arc::new(psk), cipher })
}

const SALT: &[u8] = b"AXON-QKD-TLS13-EXTERNAL-PSK-v1";
const MAX_SAE_ID: usize = 255;

/// The length as a 16-bit number, then the bytes. All names are short by now.
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
