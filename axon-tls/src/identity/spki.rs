//! The digest that identifies a public key.

use std::fmt;
use std::str::FromStr;

use aws_lc_rs::digest::{SHA256, digest};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rustls::pki_types::CertificateDer;

/// The SHA-256 of a public key's SubjectPublicKeyInfo in DER.
///
/// Its text form is `spki-sha256:` and 44 characters of base64.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SpkiDigest(pub [u8; 32]);

impl SpkiDigest {
    /// Returns the digest of a SubjectPublicKeyInfo.
    pub fn of(spki: &[u8]) -> Self {
        let mut bytes = [0; 32];
        bytes.copy_from_slice(digest(&SHA256, spki).as_ref());
        Self(bytes)
    }

    /// Returns the digest of the key in what rustls calls a peer's certificate, which is a
    /// certificate or a raw public key.
    pub(crate) fn of_peer(shown: &CertificateDer<'_>) -> Option<Self> {
        match rustls::server::ParsedCertificate::try_from(shown) {
            Ok(certificate) => Some(Self::of(&certificate.subject_public_key_info())),
            Err(_) => Some(Self::of(shown)),
        }
    }
}

impl fmt::Display for SpkiDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{PREFIX}{}", STANDARD.encode(self.0))
    }
}

impl fmt::Debug for SpkiDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The text is not `spki-sha256:` and 44 characters of base64.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a key digest is `spki-sha256:` and 44 characters of base64")]
pub struct InvalidSpkiDigest;

impl FromStr for SpkiDigest {
    type Err = InvalidSpkiDigest;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let encoded = text.strip_prefix(PREFIX).ok_or(InvalidSpkiDigest)?;
        if encoded.len() != 44 {
            return Err(InvalidSpkiDigest);
        }
        let bytes = STANDARD.decode(encoded).map_err(|_| InvalidSpkiDigest)?;
        bytes.try_into().map(Self).map_err(|_| InvalidSpkiDigest)
    }
}

const PREFIX: &str = "spki-sha256:";
