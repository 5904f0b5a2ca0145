//! Checking the certificate of a peer: from given roots, in date, not revoked, for its role; and
//! whether it is for the host that the peer says it is.

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
/// With a revocation list, every issuer in the chain needs one that is in date: an old list says
/// nothing about what was revoked since.
#[derive(Debug)]
pub(super) struct FromRoots {
    pub(super) roots: Arc<RootCertStore>,
    pub(super) crls: Arc<Vec<CertRevocationList<'static>>>,
    pub(super) algorithms: WebPkiSupportedAlgorithms,
    /// Whether a client leaves the server's name to the application.
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
        // no lists were given: nothing to check against
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
    /// Of several lists of one issuer, webpki asks the first that covers a certificate, which may be
    /// the oldest. Here each is asked, about every certificate that was shown.
    fn revoked_nowhere(
        &self,
        shown: &CertificateDer<'_>,
        others: &[CertificateDer<'_>],
    ) -> Result<(), Error> {
        for certificate in std::iter::once(shown).chain(others) {
            // One that is none is in no chain either.
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

/// Whether the certificate names exactly this host: a DNS name, in whatever case, and no wildcard,
/// by which each of many hosts could be all of them.
pub(super) fn is_for_host(certificate: &CertificateDer<'_>, host: &str) -> bool {
    let (Ok(certificate), Ok(name)) =
        (EndEntityCert::try_from(certificate), DnsName::try_from(host))
    else {
        return false;
    };
    certificate.verify_is_valid_for_subject_name(&ServerName::DnsName(name)).is_ok()
        && certificate.valid_dns_names().any(|dns| dns.eq_ignore_ascii_case(host))
}

/// The DNS names of the certificate that are no wildcards.
pub(super) fn host_names(certificate: &CertificateDer<'_>) -> Vec<String> {
    let Ok(certificate) = EndEntityCert::try_from(certificate) else { return Vec::new() };
    certificate.valid_dns_names().filter(|n| !n.contains('*')).map(str::to_owned).collect()
}

/// In rustls's words where it has them, for the alert that the peer is sent.
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
