//! The key of this end.

use std::sync::Arc;

use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::signature::{Ed25519KeyPair, ML_DSA_65_SIGNING, PqdsaKeyPair};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rustls::client::AlwaysResolvesClientRawPublicKeys;
use rustls::crypto::aws_lc_rs::sign::any_supported_type;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::server::AlwaysResolvesServerRawPublicKeys;
use rustls::sign::CertifiedKey;
use zeroize::Zeroizing;

use super::{SpkiDigest, pem};
use crate::Error;

/// The signature algorithm of a new key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum KeyAlgorithm {
    /// ML-DSA-65 (FIPS 204). A quantum computer cannot forge its signatures.
    #[default]
    MlDsa65,
    /// Ed25519 (RFC 8032). It is small and classical.
    Ed25519,
}

/// A private key that signs handshakes. The peer receives it as a raw public key.
///
/// A generated key is for ML-DSA-65, or for the algorithm in [`SigningKey::generate_pem_with()`]. A
/// key that is read may be for any algorithm with which rustls can sign (also ECDSA and RSA-PSS).
/// It cannot be printed. Clones share one key.
#[derive(Clone)]
pub struct SigningKey {
    certified: Arc<CertifiedKey>,
}

impl SigningKey {
    /// Generates an ML-DSA-65 key.
    pub fn generate() -> Result<Self, Error> {
        let pkcs8 = generate_pkcs8(KeyAlgorithm::MlDsa65)?;
        Self::from_pkcs8(&pkcs8)
    }

    /// Generates an ML-DSA-65 key as a PEM text, which [`SigningKey::from_pem()`] can read.
    pub fn generate_pem() -> Result<Zeroizing<String>, Error> {
        Self::generate_pem_with(KeyAlgorithm::MlDsa65)
    }

    /// As [`SigningKey::generate_pem()`], with the given algorithm.
    pub fn generate_pem_with(algorithm: KeyAlgorithm) -> Result<Zeroizing<String>, Error> {
        let pkcs8 = generate_pkcs8(algorithm)?;
        let body = Zeroizing::new(STANDARD.encode(&*pkcs8));
        // the capacity includes all line ends, so that the text is never moved and leaves no copy
        let mut pem = Zeroizing::new(String::with_capacity(body.len() + body.len() / 64 + 80));
        pem.push_str("-----BEGIN PRIVATE KEY-----\n");
        for at in (0..body.len()).step_by(64) {
            pem.push_str(&body[at..body.len().min(at + 64)]);
            pem.push('\n');
        }
        pem.push_str("-----END PRIVATE KEY-----\n");
        Ok(pem)
    }

    /// Reads a PKCS#8 key in DER.
    pub fn from_pkcs8(der: &[u8]) -> Result<Self, Error> {
        Self::load(&PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(der)))
    }

    /// Reads the first `PRIVATE KEY` in `text`, a PKCS#8 key in PEM.
    pub fn from_pem(text: &str) -> Result<Self, Error> {
        Self::from_pkcs8(&pem::private_key(text)?)
    }

    /// Returns the digest by which a peer pins this key.
    pub fn spki_digest(&self) -> SpkiDigest {
        SpkiDigest::of(&self.certified.cert[0])
    }

    fn load(der: &PrivateKeyDer<'_>) -> Result<Self, Error> {
        let key = signing_key(der)?;
        let spki = key
            .public_key()
            .ok_or(Error::PrivateKey("the public key cannot be derived from it"))?
            .into_owned();
        let shown = CertificateDer::from(spki.as_ref().to_vec());
        Ok(Self { certified: Arc::new(CertifiedKey::new(vec![shown], key)) })
    }

    pub(super) fn client_resolver(&self) -> Arc<AlwaysResolvesClientRawPublicKeys> {
        Arc::new(AlwaysResolvesClientRawPublicKeys::new(Arc::clone(&self.certified)))
    }

    pub(super) fn server_resolver(&self) -> Arc<AlwaysResolvesServerRawPublicKeys> {
        Arc::new(AlwaysResolvesServerRawPublicKeys::new(Arc::clone(&self.certified)))
    }
}

/// Parses a key from borrowed bytes. rustls's key provider would require its own copy, which it
/// does not erase.
pub(super) fn signing_key(
    der: &PrivateKeyDer<'_>,
) -> Result<Arc<dyn rustls::sign::SigningKey>, Error> {
    any_supported_type(der)
        .map_err(|_| Error::PrivateKey("not a PKCS#8 key that can sign a TLS 1.3 handshake"))
}

fn generate_pkcs8(algorithm: KeyAlgorithm) -> Result<Zeroizing<Vec<u8>>, Error> {
    let document = match algorithm {
        KeyAlgorithm::MlDsa65 => {
            PqdsaKeyPair::generate(&ML_DSA_65_SIGNING).and_then(|pair| pair.to_pkcs8v1())
        }
        KeyAlgorithm::Ed25519 => Ed25519KeyPair::generate_pkcs8v1(&SystemRandom::new()),
    };
    let document = document.map_err(|_| Error::KeyGeneration)?;
    Ok(Zeroizing::new(document.as_ref().to_vec()))
}

#[cfg(test)]
mod tests {
    use rustls::SignatureScheme;

    use super::*;

    #[test]
    fn a_generated_key_reads_back_as_itself() {
        for (algorithm, signs) in [
            (KeyAlgorithm::MlDsa65, SignatureScheme::ML_DSA_65),
            (KeyAlgorithm::Ed25519, SignatureScheme::ED25519),
        ] {
            let pem = SigningKey::generate_pem_with(algorithm).unwrap();
            let key = SigningKey::from_pem(&pem).unwrap();
            assert_eq!(key.spki_digest(), SigningKey::from_pem(&pem).unwrap().spki_digest());
            assert_ne!(key.spki_digest(), SigningKey::generate().unwrap().spki_digest());
            assert!(key.certified.key.choose_scheme(&[signs]).is_some(), "{algorithm:?}");
        }
    }

    #[test]
    fn signing_key_refuses_invalid_pem_and_pkcs8() {
        assert!(SigningKey::from_pem("").is_err());
        assert!(SigningKey::from_pem("-----BEGIN PRIVATE KEY-----\nAAAA\n").is_err());
        assert!(SigningKey::from_pkcs8(&[0x30, 0x00]).is_err());
        assert!(SigningKey::from_pkcs8(&[]).is_err());
    }
}
