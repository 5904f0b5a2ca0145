//! Checking the raw public key of a peer (RFC 7250).

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::crypto::{WebPkiSupportedAlgorithms, verify_tls13_signature_with_raw_key};
use rustls::pki_types::{CertificateDer, SubjectPublicKeyInfoDer, UnixTime};
use rustls::{CertificateError, DigitallySignedStruct, Error, SignatureScheme};

use super::verifier::{Peers, Role};
use super::{SpkiDigest, Trust};

/// Accepts a raw public key that is pinned, or any if there are no pins to go by; and in both
/// cases only with its signature of the handshake.
#[derive(Debug)]
pub(super) struct RawKeys {
    trust: Option<Trust>,
    algorithms: WebPkiSupportedAlgorithms,
}

impl RawKeys {
    pub(super) fn new(trust: Option<Trust>) -> Self {
        Self { trust, algorithms: default_provider().signature_verification_algorithms }
    }
}

impl Peers for RawKeys {
    const RAW_KEYS: bool = true;

    fn accept(
        &self,
        shown: &CertificateDer<'_>,
        others: &[CertificateDer<'_>],
        _role: Role<'_>,
        _now: UnixTime,
    ) -> Result<(), Error> {
        if !others.is_empty() {
            return Err(CertificateError::BadEncoding.into());
        }
        match &self.trust {
            Some(trust) if trust.name_of(&SpkiDigest::of(shown)).is_none() => {
                Err(CertificateError::UnknownIssuer.into())
            }
            _ => Ok(()),
        }
    }

    fn signed(
        &self,
        message: &[u8],
        shown: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let key = SubjectPublicKeyInfoDer::from(shown.as_ref());
        verify_tls13_signature_with_raw_key(message, &key, signature, &self.algorithms)
    }

    fn schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}
