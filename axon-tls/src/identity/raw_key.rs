//! Verifies the raw public key of a peer (RFC 7250).

use std::time::SystemTime;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::crypto::{WebPkiSupportedAlgorithms, verify_tls13_signature_with_raw_key};
use rustls::pki_types::{CertificateDer, SubjectPublicKeyInfoDer, UnixTime};
use rustls::{CertificateError, DigitallySignedStruct, Error, SignatureScheme};

use super::refused::Refused;
use super::verifier::{Peers, Role};
use super::{SpkiDigest, Trust};

/// Accepts a raw public key that is pinned, or any key if there are no pins. In both cases the peer
/// must have signed the handshake with it.
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
        let Some(trust) = &self.trust else { return Ok(()) };
        match trust.pin_of(&SpkiDigest::of(shown)) {
            Some(pin) if pin.holds(SystemTime::now()) => Ok(()),
            Some(pin) => {
                Err(Refused::PinEnded(pin.last_day().unwrap_or_default().to_owned()).into())
            }
            None => Err(CertificateError::UnknownIssuer.into()),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::TrustFile;

    #[test]
    fn an_ended_pin_says_its_last_day_and_an_unknown_key_says_none() {
        let [ended, known, unknown] = [1, 2, 3].map(|byte| CertificateDer::from(vec![byte]));
        let digest = |shown: &CertificateDer<'_>| SpkiDigest::of(shown);
        let text = format!("arm {} 2024-02-29\nbase {}", digest(&ended), digest(&known));
        let keys = RawKeys::new(Some(Trust::new(TrustFile::parse(&text).unwrap())));
        let accept = |shown| keys.accept(shown, &[], Role::Client, UnixTime::now());
        assert!(accept(&known).is_ok());
        let said = accept(&ended).unwrap_err().to_string();
        assert!(said.contains("last day") && said.contains("2024-02-29 (UTC)"), "{said}");
        assert!(!said.contains("arm"), "the peer is told the reason, not our name for it: {said}");
        assert_eq!(accept(&unknown), Err(CertificateError::UnknownIssuer.into()));
    }
}
