//! Imports a QKD key as a pre-shared key of TLS, as RFC 9258 specifies.

use rustls_axon::crypto::aws_lc_rs::cipher_suite::TLS13_CHACHA20_POLY1305_SHA256;
use rustls_axon::crypto::hash::HashAlgorithm;
use rustls_axon::external_psk::{ExternalPsk, ImportedIdentity as TlsIdentity, ImportedPsk};
use zeroize::Zeroizing;

use crate::erase::erasing_stack;
use crate::psk::Psk;
use crate::{Cipher, Error};

/// Imports a QKD key for one connection, as RFC 9258 specifies.
///
/// **It is for peers that are not AXON and implement RFC 9258.** If both ends use this crate, use
/// [`derive_psk()`](super::derive_psk). A QKD key must be used in only one of the two forms: two peers must not use
/// different forms, and neither may two attempts.
///
/// The external identity is the key_ID. The context is the client SAE and the server SAE, each preceded by its length.
/// The target protocol is TLS 1.3, and the target KDF is HKDF with the hash of `cipher`. The QKD key itself has no
/// hash, so it is imported with SHA-256 (section 5.1). The binder is made under `imp binder`, so the two forms cannot
/// be confused.
///
/// Client and server give the same names in the same order. Equal SAE IDs are refused, and so are names that do not
/// have 1 to 255 bytes.
pub fn import_psk(
    key: &[u8; 32],
    key_id: &str,
    client_sae: &str,
    server_sae: &str,
    cipher: Cipher,
) -> Result<Psk, Error> {
    let named = ImportedIdentity::new(key_id, client_sae, server_sae, cipher)?;
    let context = named.context();
    let identity = TlsIdentity::new(named.key_id.as_bytes(), &context, cipher.hash())?;
    let base_key = Zeroizing::new(key.to_vec());
    let suite = TLS13_CHACHA20_POLY1305_SHA256.tls13().ok_or(Error::KeyGeneration)?;
    let imported = erasing_stack(|| ImportedPsk::new(identity, &base_key, suite))?;
    Ok(ExternalPsk::from(imported).into())
}

/// The contents of the identity of an imported QKD key. The identity is sent in the clear.
///
/// It also names the server, which [`PskIdentity`](super::PskIdentity) does not.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ImportedIdentity {
    key_id: String,
    client_sae: String,
    server_sae: String,
    cipher: Cipher,
}

impl ImportedIdentity {
    /// Parses the bytes that a client sent. Accepts exactly the identities of [`import_psk()`].
    pub fn parse(bytes: &[u8]) -> Result<Self, Error> {
        let wrong = |reason| Error::Name { what: "imported PSK identity", reason };
        let identity = TlsIdentity::decode(bytes)
            .ok_or(wrong("is not one of TLS 1.3 with HKDF-SHA256 or HKDF-SHA384"))?;
        let cipher = match identity.target_hash() {
            HashAlgorithm::SHA384 => Cipher::Aes256Gcm,
            _ => Cipher::ChaCha20Poly1305,
        };
        let text = |bytes| std::str::from_utf8(bytes).map_err(|_| wrong("has a name not in UTF-8"));
        let (client_sae, server_sae) =
            split(identity.context()).ok_or(wrong("has another context than two SAE IDs"))?;
        Self::new(text(identity.external_identity())?, text(client_sae)?, text(server_sae)?, cipher)
    }

    /// Returns the key_ID, as the client wrote it.
    pub fn key_id(&self) -> &str {
        &self.key_id
    }

    /// Returns the SAE ID of the client.
    pub fn client_sae(&self) -> &str {
        &self.client_sae
    }

    /// Returns the SAE ID of the server that the client wants to reach.
    pub fn server_sae(&self) -> &str {
        &self.server_sae
    }

    /// Returns the cipher for which the key was imported.
    pub fn cipher(&self) -> Cipher {
        self.cipher
    }

    fn new(
        key_id: &str,
        client_sae: &str,
        server_sae: &str,
        cipher: Cipher,
    ) -> Result<Self, Error> {
        for (what, name) in
            [("key_ID", key_id), ("client SAE ID", client_sae), ("server SAE ID", server_sae)]
        {
            if name.is_empty() || name.len() > MAX_NAME {
                return Err(Error::Name { what, reason: "must have 1 to 255 bytes" });
            }
        }
        if client_sae == server_sae {
            return Err(Error::EqualSaeIds);
        }
        let [key_id, client_sae, server_sae] = [key_id, client_sae, server_sae].map(str::to_owned);
        Ok(Self { key_id, client_sae, server_sae, cipher })
    }

    /// Returns the context. Both SAE IDs are short, see [`ImportedIdentity::new()`].
    fn context(&self) -> Vec<u8> {
        let mut context = Vec::new();
        for name in [&self.client_sae, &self.server_sae] {
            context.extend_from_slice(&(name.len() as u16).to_be_bytes());
            context.extend_from_slice(name.as_bytes());
        }
        context
    }
}

const MAX_NAME: usize = 255;

/// Splits a context into its two names. Returns `None` if it holds anything else.
fn split(context: &[u8]) -> Option<(&[u8], &[u8])> {
    let (client, rest) = prefixed(context)?;
    let (server, rest) = prefixed(rest)?;
    rest.is_empty().then_some((client, server))
}

fn prefixed(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (len, rest) = bytes.split_first_chunk::<2>()?;
    rest.split_at_checked(usize::from(u16::from_be_bytes(*len)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_identity_is_that_of_the_rfc() {
        for (cipher, kdf) in [(Cipher::ChaCha20Poly1305, 1), (Cipher::Aes256Gcm, 2)] {
            let psk = import_psk(&[7; 32], "key-1", "robot", "base", cipher).unwrap();
            let mut expected =
                b"\x00\x05key-1\x00\x0d\x00\x05robot\x00\x04base\x03\x04\x00".to_vec();
            expected.push(kdf);
            assert_eq!(psk.identity(), expected);
            assert_eq!(psk.cipher(), cipher);

            let identity = ImportedIdentity::parse(psk.identity()).unwrap();
            assert_eq!(identity.key_id(), "key-1");
            assert_eq!((identity.client_sae(), identity.server_sae()), ("robot", "base"));
            assert_eq!(identity.cipher(), cipher);
        }
    }

    #[test]
    fn hostile_identities_are_refused() {
        let genuine = b"\x00\x05key-1\x00\x0d\x00\x05robot\x00\x04base\x03\x04\x00\x01";
        assert!(ImportedIdentity::parse(genuine).is_ok());
        for len in 0..genuine.len() {
            assert!(ImportedIdentity::parse(&genuine[..len]).is_err(), "{len} bytes");
        }
        let hostile: [&[u8]; 10] = [
            b"axon-qkd-v1:robot:key-1",
            // another protocol, another KDF, bytes after the identity
            b"\x00\x05key-1\x00\x0d\x00\x05robot\x00\x04base\x03\x03\x00\x01",
            b"\x00\x05key-1\x00\x0d\x00\x05robot\x00\x04base\x03\x04\x00\x03",
            b"\x00\x05key-1\x00\x0d\x00\x05robot\x00\x04base\x03\x04\x00\x01\x00",
            // no context, one name, three names
            b"\x00\x05key-1\x00\x00\x03\x04\x00\x01",
            b"\x00\x05key-1\x00\x07\x00\x05robot\x03\x04\x00\x01",
            b"\x00\x05key-1\x00\x10\x00\x05robot\x00\x04base\x00\x01c\x03\x04\x00\x01",
            // an empty name, the same name twice, no text
            b"\x00\x05key-1\x00\x09\x00\x05robot\x00\x00\x03\x04\x00\x01",
            b"\x00\x05key-1\x00\x0e\x00\x05robot\x00\x05robot\x03\x04\x00\x01",
            b"\x00\x05key\xff1\x00\x0d\x00\x05robot\x00\x04base\x03\x04\x00\x01",
        ];
        for bytes in hostile {
            assert!(ImportedIdentity::parse(bytes).is_err(), "{}", bytes.escape_ascii());
        }
    }

    #[test]
    fn names_that_cannot_be_told_apart_are_refused() {
        let import = |id: &str, client: &str, server: &str| {
            import_psk(&[1; 32], id, client, server, Cipher::default())
        };
        assert!(matches!(import("k", "a", "a"), Err(Error::EqualSaeIds)));
        for (id, client, server) in [("", "a", "b"), ("k", "", "b"), ("k", "a", "")] {
            assert!(import(id, client, server).is_err());
        }
        let long = "n".repeat(256);
        assert!(import(&long, "a", "b").is_err());
        assert!(import("k", &long, "b").is_err());
        assert!(import("k", "a", &long).is_err());
        assert!(import(&long[1..], "a", "b").is_ok());
    }
}
