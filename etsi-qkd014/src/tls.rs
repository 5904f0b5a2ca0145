//! The rustls configuration: mutual TLS, one CA, aws-lc-rs, hybrid key exchange preferred.

use std::sync::Arc;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::{Resumption, verify_server_cert_signed_by_trust_anchor, verify_server_name};
use rustls::crypto::{
    CryptoProvider, WebPkiSupportedAlgorithms, aws_lc_rs, verify_tls12_signature,
    verify_tls13_signature,
};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::sign::{CertifiedKey, SingleCertAndKey};
use rustls::{
    AlertDescription, CertificateError, ClientConfig, DigitallySignedStruct, OtherError,
    RootCertStore, SignatureScheme,
};

use crate::pem::PrivateKey;
use crate::subject::common_name;
use crate::{Error, RefusedBy};

/// Returns the provider, with X25519MLKEM768 first, and the classical groups for KMEs that lack it.
pub(crate) fn provider() -> Arc<CryptoProvider> {
    use aws_lc_rs::kx_group::{SECP256R1, SECP384R1, X25519, X25519MLKEM768};
    Arc::new(CryptoProvider {
        kx_groups: vec![X25519MLKEM768, X25519, SECP256R1, SECP384R1],
        ..aws_lc_rs::default_provider()
    })
}

/// The KME's ID, and whether the host name in the URL is checked.
#[derive(Clone, Debug)]
pub(crate) struct Identity {
    pub(crate) kme_id: Option<String>,
    pub(crate) check_name: bool,
}

pub(crate) fn client_config(
    ca: &[u8],
    sae_cert: &[u8],
    sae_key: &[u8],
    identity: Identity,
) -> Result<ClientConfig, Error> {
    let provider = provider();
    let mut roots = RootCertStore::empty();
    for certificate in certificates(ca, "ca")? {
        roots.add(certificate).map_err(|e| config("ca", format!("no usable CA: {e}")))?;
    }
    let verifier =
        KmeVerifier { roots, algorithms: provider.signature_verification_algorithms, identity };
    let resolver = SingleCertAndKey::from(certified_key(sae_cert, sae_key)?);
    let mut tls = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|e| config("tls", e.to_string()))?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(verifier))
        .with_client_cert_resolver(Arc::new(resolver));
    // Each connection authenticates both ends again, and no session secret is kept.
    tls.resumption = Resumption::disabled();
    Ok(tls)
}

fn config(setting: &'static str, reason: impl Into<String>) -> Error {
    Error::Config { setting, reason: reason.into() }
}

fn is_pem(bytes: &[u8]) -> bool {
    bytes.windows(11).any(|window| window == b"-----BEGIN ")
}

/// Returns all certificates of a PEM text, or the one of a DER file.
pub(crate) fn certificates(
    bytes: &[u8],
    setting: &'static str,
) -> Result<Vec<CertificateDer<'static>>, Error> {
    if !is_pem(bytes) {
        return Ok(vec![CertificateDer::from(bytes.to_vec())]);
    }
    let all: Vec<_> = CertificateDer::pem_slice_iter(bytes)
        .collect::<Result<_, _>>()
        .map_err(|e| config(setting, format!("PEM that cannot be read: {e}")))?;
    if all.is_empty() {
        return Err(config(setting, "PEM without a CERTIFICATE section"));
    }
    Ok(all)
}

/// The certificate has X.509 version 1 or 2. Such a certificate has no extensions, and so names neither host nor
/// purpose.
#[derive(Debug)]
struct OldVersion;

impl std::fmt::Display for OldVersion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(
            "it is X.509 version 1 (or 2), which has no extensions; have it issued again as version 3",
        )
    }
}

impl std::error::Error for OldVersion {}

/// Returns whether a certificate has X.509 version 1 or 2.
fn is_of_old_version(certificate: &CertificateDer<'_>) -> bool {
    let parsed = webpki::EndEntityCert::try_from(certificate);
    matches!(parsed, Err(webpki::Error::UnsupportedCertVersion))
}

/// Returns an error about the old version of a certificate that the chain needs, or the given error. A root that a KME
/// sends along may have any version.
fn version_or(
    error: rustls::Error,
    end_entity: &CertificateDer<'_>,
    intermediates: &[CertificateDer<'_>],
) -> rustls::Error {
    use CertificateError::{Other, UnknownIssuer};
    let no_path = matches!(error, rustls::Error::InvalidCertificate(UnknownIssuer | Other(_)));
    if is_of_old_version(end_entity) || (no_path && intermediates.iter().any(is_of_old_version)) {
        return Other(OtherError(Arc::new(OldVersion))).into();
    }
    error
}

fn certified_key(cert: &[u8], key: &[u8]) -> Result<CertifiedKey, Error> {
    let chain = certificates(cert, "sae_cert")?;
    if chain.iter().any(is_of_old_version) {
        return Err(config("sae_cert", format!("no usable certificate: {OldVersion}")));
    }
    // The parsers' reasons are not passed on, because the parsers have seen the key.
    let unusable = || {
        let accepted = "accepted: PKCS#8, SEC1 or PKCS#1, as PEM or DER, unencrypted";
        config("sae_key", format!("no usable private key; {accepted}"))
    };
    let signer = if is_pem(key) {
        let key = PrivateKey::from_pem(key).ok_or_else(unusable)?;
        aws_lc_rs::sign::any_supported_type(&key.der())
    } else {
        let der = PrivateKeyDer::try_from(key).map_err(|_| unusable())?;
        aws_lc_rs::sign::any_supported_type(&der)
    };
    let certified = CertifiedKey::new(chain, signer.map_err(|_| unusable())?);
    match certified.keys_match() {
        Ok(()) | Err(rustls::Error::InconsistentKeys(rustls::InconsistentKeys::Unknown)) => {
            Ok(certified)
        }
        Err(rustls::Error::InconsistentKeys(_)) => {
            Err(config("sae_key", "does not belong to the certificate of sae_cert"))
        }
        Err(e) => Err(config("sae_cert", format!("no usable certificate: {e}"))),
    }
}

/// webpki's checks with the one CA, and a check of the subject if a KME ID was given.
#[derive(Debug)]
struct KmeVerifier {
    roots: RootCertStore,
    algorithms: WebPkiSupportedAlgorithms,
    identity: Identity,
}

impl ServerCertVerifier for KmeVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        let cert = ParsedCertificate::try_from(end_entity)
            .and_then(|cert| {
                let (roots, algorithms) = (&self.roots, self.algorithms.all);
                verify_server_cert_signed_by_trust_anchor(
                    &cert,
                    roots,
                    intermediates,
                    now,
                    algorithms,
                )?;
                Ok(cert)
            })
            .map_err(|error| version_or(error, end_entity, intermediates))?;
        if self.identity.check_name {
            verify_server_name(&cert, server_name)?;
        }
        if let Some(expected) = &self.identity.kme_id {
            let found = common_name(end_entity);
            if found.as_ref() != Some(expected) {
                let found = found.unwrap_or_else(|| "none or several".to_owned());
                return Err(rustls::Error::General(format!(
                    "the certificate's subject names KME {found:?}, kme_id asks for {expected:?}"
                )));
            }
        }
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls12_signature(message, cert, dss, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        verify_tls13_signature(message, cert, dss, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

/// Finds rustls' own error inside another library's error.
pub(crate) fn tls_error<'e>(
    error: &'e (dyn std::error::Error + 'static),
) -> Option<&'e rustls::Error> {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(found) = error.downcast_ref::<rustls::Error>() {
            return Some(found);
        }
        next = match error.downcast_ref::<std::io::Error>() {
            // io::Error's `source` skips the wrapped error.
            Some(io) => io.get_ref().map(|e| e as &(dyn std::error::Error + 'static)),
            None => error.source(),
        };
    }
    None
}

/// Returns which end refused the handshake, and why; `None` if the error does not mean that. `connected` is true if the
/// error came after the client's part of the handshake was over. Only then do TLS 1.3 servers refuse a client's
/// certificate, with an alert, before they read the request.
pub(crate) fn refusal(error: &rustls::Error, connected: bool) -> Option<(RefusedBy, String)> {
    use AlertDescription as Alert;
    match error {
        rustls::Error::AlertReceived(alert) => {
            let about_us = matches!(
                alert,
                Alert::BadCertificate
                    | Alert::UnsupportedCertificate
                    | Alert::CertificateRevoked
                    | Alert::CertificateExpired
                    | Alert::CertificateUnknown
                    | Alert::UnknownCA
                    | Alert::AccessDenied
                    | Alert::CertificateRequired
                    // Only sent in handshakes: our signature, or our certificate's, does not verify.
                    | Alert::DecryptError
                    | Alert::HandshakeFailure
            );
            if about_us {
                let hint = "it does not accept this SAE's certificate (sae_cert)";
                Some((RefusedBy::Kme, format!("{hint}: alert {alert:?}")))
            } else if connected {
                None
            } else {
                Some((RefusedBy::Kme, format!("alert {alert:?}")))
            }
        }
        _ if connected => None,
        rustls::Error::InvalidCertificate(reason) => {
            Some((RefusedBy::Client, certificate_reason(reason)))
        }
        other => Some((RefusedBy::Client, other.to_string())),
    }
}

fn certificate_reason(reason: &CertificateError) -> String {
    match reason {
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
            format!("the KME's certificate is not valid yet; check this machine's clock ({reason})")
        }
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
            format!("the KME's certificate has expired ({reason})")
        }
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            "the KME's certificate was not issued by the CA given (ca)".to_owned()
        }
        CertificateError::Other(OtherError(other)) if other.is::<OldVersion>() => {
            format!("the KME's certificate cannot be used: {other}")
        }
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            format!(
                "the KME's certificate: {reason}; give the host that it names in kme_url, or where it \
                 names none, know the KME by its ID alone (kme_id_replaces_name_check)"
            )
        }
        other => format!("the KME's certificate: {other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustls::NamedGroup;

    #[test]
    fn hybrid_key_exchange_is_offered_first_and_with_a_share() {
        // rustls sends a key share for the first group.
        assert_eq!(provider().kx_groups[0].name(), NamedGroup::X25519MLKEM768);
    }

    #[test]
    fn a_certificate_that_is_not_valid_yet_says_clock() {
        assert!(certificate_reason(&CertificateError::NotValidYet).contains("clock"));
    }

    #[test]
    fn only_handshake_alerts_mean_that_the_request_was_not_served() {
        let alert = |alert, connected| {
            refusal(&rustls::Error::AlertReceived(alert), connected).map(|(by, _)| by)
        };
        assert_eq!(alert(AlertDescription::InternalError, true), None);
        assert_eq!(alert(AlertDescription::BadRecordMac, true), None);
        assert_eq!(alert(AlertDescription::InternalError, false), Some(RefusedBy::Kme));
        assert_eq!(alert(AlertDescription::UnknownCA, true), Some(RefusedBy::Kme));
        assert!(refusal(&rustls::Error::DecryptError, true).is_none());
    }

    #[test]
    fn private_keys_that_cannot_be_read_are_not_quoted() {
        let secret = "c2VjcmV0c2VjcmV0";
        for text in [
            format!("-----BEGIN PRIVATE KEY-----\n{secret}\n-----END PRIVATE KEY-----\n"),
            format!("-----BEGIN PRIVATE KEY-----\n{secret}"),
            secret.to_owned(),
        ] {
            let error = certified_key(b"x", text.as_bytes()).unwrap_err();
            assert!(!format!("{error} {error:?}").contains(secret));
        }
    }
}
