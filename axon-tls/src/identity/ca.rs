//! Certificates from given roots.

use std::sync::Arc;

use rustls::crypto::aws_lc_rs::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use rustls::sign::{CertifiedKey, SingleCertAndKey};
use rustls::{ClientConfig, ConfigBuilder, RootCertStore, ServerConfig, WantsVerifier};
use webpki::{CertRevocationList, OwnedCertRevocationList};

use super::roots::{self, FromRoots};
use super::verifier::Verifier;
use super::{pem, signing_key};
use crate::Error;

/// Roots, our certificate and its key, and the certificates that were revoked.
///
/// Each end checks that the other's certificate comes from the roots, is in date, is for the role of
/// a client or a server if it is limited to one, and was not revoked. With a revocation list, every
/// issuer in the peer's chain needs one that is in date. A client checks the server's name too,
/// against the one it connects with. Which client it is, is for the application of the server to
/// check, with [`CaMaterial::is_for_host()`].
pub struct CaMaterial {
    roots: Arc<RootCertStore>,
    ours: Arc<CertifiedKey>,
    crls: Arc<Vec<CertRevocationList<'static>>>,
    names_checked_later: bool,
}

impl CaMaterial {
    /// Reads PEM texts: the roots, our certificate with the chain to a root, its PKCS#8 key, and
    /// revocation lists if there are any.
    pub fn from_pem(
        roots: &str,
        chain: &str,
        key: &str,
        crls: Option<&str>,
    ) -> Result<Self, Error> {
        let mut store = RootCertStore::empty();
        for root in CertificateDer::pem_slice_iter(roots.as_bytes()) {
            let root = root.map_err(|err| unusable("roots", err))?;
            store.add(root).map_err(|err| unusable("roots", err))?;
        }
        if store.is_empty() {
            return Err(unusable("roots", "no PEM section `CERTIFICATE`"));
        }

        let chain = CertificateDer::pem_slice_iter(chain.as_bytes())
            .collect::<Result<Vec<_>, _>>()
            .map_err(|err| unusable("our certificate", err))?;
        if chain.is_empty() {
            return Err(unusable("our certificate", "no PEM section `CERTIFICATE`"));
        }
        let key = pem::private_key(key)?;
        let key = signing_key(&PrivateKeyDer::Pkcs8(key.as_slice().into()))?;
        let ours = CertifiedKey::new(chain, key);
        ours.keys_match().map_err(|err| unusable("our certificate and key", err))?;

        let crls = match crls {
            None => Vec::new(),
            Some(text) => {
                let crls = CertificateRevocationListDer::pem_slice_iter(text.as_bytes())
                    .collect::<Result<Vec<_>, _>>()
                    .map_err(|err| unusable("revocation lists", err))?;
                if crls.is_empty() {
                    return Err(unusable("revocation lists", "no PEM section `X509 CRL`"));
                }
                crls.iter()
                    .map(|crl| OwnedCertRevocationList::from_der(crl).map(Into::into))
                    .collect::<Result<Vec<_>, _>>()
                    .map_err(|err| unusable("revocation lists", err))?
            }
        };
        Ok(Self {
            roots: Arc::new(store),
            ours: Arc::new(ours),
            crls: Arc::new(crls),
            names_checked_later: false,
        })
    }

    /// Leaves the server's name to the application too, for protocols in which both ends say who
    /// they are once they are connected.
    ///
    /// **Whoever calls this must check what each peer says with [`CaMaterial::is_for_host()`]**:
    /// until then any holder of a certificate from the roots can be the server.
    #[must_use]
    pub fn with_names_checked_by_application(mut self) -> Self {
        self.names_checked_later = true;
        self
    }

    /// Whether a peer that showed `certificate` may call itself `host`: one of the certificate's
    /// DNS names is exactly that. A wildcard is not.
    pub fn is_for_host(certificate: &CertificateDer<'_>, host: &str) -> bool {
        roots::is_for_host(certificate, host)
    }

    /// The hosts that our own certificate is for: its DNS names without wildcards.
    pub fn our_hosts(&self) -> Vec<String> {
        roots::host_names(&self.ours.cert[0])
    }

    pub(super) fn client(
        &self,
        builder: ConfigBuilder<ClientConfig, WantsVerifier>,
    ) -> ClientConfig {
        builder
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(self.verifier()))
            .with_client_cert_resolver(Arc::new(SingleCertAndKey::from(Arc::clone(&self.ours))))
    }

    pub(super) fn server(
        &self,
        builder: ConfigBuilder<ServerConfig, WantsVerifier>,
    ) -> ServerConfig {
        builder
            .with_client_cert_verifier(Arc::new(self.verifier()))
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(Arc::clone(&self.ours))))
    }

    fn verifier(&self) -> Verifier<FromRoots> {
        Verifier(FromRoots {
            roots: Arc::clone(&self.roots),
            crls: Arc::clone(&self.crls),
            algorithms: default_provider().signature_verification_algorithms,
            names_checked_later: self.names_checked_later,
        })
    }
}

fn unusable(what: &str, why: impl std::fmt::Display) -> Error {
    Error::Certificates(format!("{what}: {why}"))
}
