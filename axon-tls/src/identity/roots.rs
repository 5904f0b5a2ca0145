//! Verifies the certificate of a peer: it must come from given roots, be in date, not be revoked, and permit the peer's
//! role. Also checks whether it is for the host name that the peer uses.

use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::{WebPkiSupportedAlgorithms, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, DnsName, ServerName, UnixTime};
use rustls::{
    CertRevocationListError, CertificateError, DigitallySignedStruct, Error, OtherError,
    RootCertStore, SignatureScheme,
};
use webpki::{
    CertRevocationList, EndEntityCert, ExpirationPolicy, KeyUsage, RevocationOptionsBuilder,
};

use super::refused::Refused;
use super::verifier::{Peers, Role};

/// Accepts certificates from given roots.
///
/// If there are revocation lists, every issuer in the chain needs one that is in date. An old list does not tell which
/// certificates were revoked later.
#[derive(Debug)]
pub(super) struct FromRoots {
    pub(super) roots: Arc<RootCertStore>,
    pub(super) crls: Arc<Vec<CertRevocationList<'static>>>,
    pub(super) algorithms: WebPkiSupportedAlgorithms,
    /// Whether a client leaves the check of the server's name to the application.
    pub(super) names_checked_later: bool,
}

impl Peers for FromRoots {
    const RAW_KEYS: bool = false;

    fn accept(
        &self,
        shown: &CertificateDer<'_>,
        others: &[CertificateDer<'_>],
        role: Role<'_>,
        now: UnixTime,
    ) -> Result<(), Error> {
        let certificate = EndEntityCert::try_from(shown).map_err(refusal)?;
        let crls: Vec<_> = self.crls.iter().collect();
        // without revocation lists there is nothing to check
        let revocation = RevocationOptionsBuilder::new(&crls)
            .ok()
            .map(|options| options.with_expiration_policy(ExpirationPolicy::Enforce).build());
        let usage = match role {
            Role::Client => KeyUsage::client_auth(),
            Role::Server(_) | Role::Nameless => KeyUsage::server_auth(),
        };
        let (algorithms, roots) = (self.algorithms.all, &self.roots.roots);
        certificate
            .verify_for_usage(algorithms, roots, others, now, usage, revocation, None)
            .map_err(refusal)?;
        self.revoked_nowhere(shown, others)?;
        match role {
            Role::Server(name) if !self.names_checked_later => {
                certificate.verify_is_valid_for_subject_name(name).map_err(refusal)
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
        verify_tls13_signature(message, shown, signature, &self.algorithms)
    }

    fn schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

impl FromRoots {
    /// Checks that no list has revoked any certificate that was shown. If an issuer has several lists, webpki uses the
    /// first that covers a certificate, which may be the oldest. This function uses all of them.
    fn revoked_nowhere(
        &self,
        shown: &CertificateDer<'_>,
        others: &[CertificateDer<'_>],
    ) -> Result<(), Error> {
        for certificate in std::iter::once(shown).chain(others) {
            // Bytes that are not a certificate are not part of the verified chain.
            let Ok(certificate) = EndEntityCert::try_from(certificate) else { continue };
            for list in self.crls.iter().filter(|list| list.issuer() == certificate.issuer()) {
                if list.find_serial(certificate.serial()).map_err(refusal)?.is_some() {
                    return Err(refusal(webpki::Error::CertRevoked));
                }
            }
        }
        Ok(())
    }
}

/// Returns whether the certificate names exactly this host by a DNS name, in upper or lower case. A wildcard does not
/// count, because it would let each of many hosts use all their names.
pub(super) fn is_for_host(certificate: &CertificateDer<'_>, host: &str) -> bool {
    let (Ok(certificate), Ok(name)) =
        (EndEntityCert::try_from(certificate), DnsName::try_from(host))
    else {
        return false;
    };
    certificate.verify_is_valid_for_subject_name(&ServerName::DnsName(name)).is_ok()
        && certificate.valid_dns_names().any(|dns| dns.eq_ignore_ascii_case(host))
}

/// Returns the DNS names of the certificate, except wildcards.
pub(super) fn host_names(certificate: &CertificateDer<'_>) -> Vec<String> {
    let Ok(certificate) = EndEntityCert::try_from(certificate) else { return Vec::new() };
    certificate.valid_dns_names().filter(|n| !n.contains('*')).map(str::to_owned).collect()
}

/// Maps an error to rustls's own errors where it has one, because this decides the alert that the peer receives.
fn refusal(error: webpki::Error) -> Error {
    match error {
        webpki::Error::InvalidCrlSignatureForPublicKey => {
            return CertRevocationListError::BadSignature.into();
        }
        webpki::Error::UnsupportedCertVersion => return Refused::OldVersion.into(),
        webpki::Error::BadDer => CertificateError::BadEncoding,
        webpki::Error::CertExpired { .. } => CertificateError::Expired,
        webpki::Error::CertNotValidYet { .. } => CertificateError::NotValidYet,
        webpki::Error::CertRevoked => CertificateError::Revoked,
        webpki::Error::CertNotValidForName(_) => CertificateError::NotValidForName,
        webpki::Error::InvalidSignatureForPublicKey => CertificateError::BadSignature,
        webpki::Error::UnknownIssuer => CertificateError::UnknownIssuer,
        webpki::Error::UnknownRevocationStatus => CertificateError::UnknownRevocationStatus,
        webpki::Error::CrlExpired { .. } => CertificateError::ExpiredRevocationList,
        other => CertificateError::Other(OtherError(Arc::new(other))),
    }
    .into()
}
