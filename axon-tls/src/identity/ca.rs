//! Certificates from given roots.

use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivatePkcs8KeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::sign::{CertifiedKey, SingleCertAndKey};
use rustls::{ClientConfig, ConfigBuilder, RootCertStore, ServerConfig, WantsVerifier};

use crate::Error;

/// Roots, our certificate and its key, and the certificates that were revoked.
///
/// A client checks the server's name too, against the one it connects with. A server checks that
/// the client's certificate is from the roots: which client it is, is for the application to check.
/// With a revocation list, one for every issuer in the peer's chain is required.
pub struct CaMaterial {
    roots: Arc<RootCertStore>,
    ours: Arc<CertifiedKey>,
    crls: Vec<CertificateRevocationListDer<'static>>,
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
        let key = PrivatePkcs8KeyDer::from_pem_slice(key.as_bytes())
            .map_err(|_| Error::PrivateKey("no PEM section `PRIVATE KEY` (PKCS#8)"))?;
        let ours = CertifiedKey::from_der(chain, key.into(), &default_provider())
            .map_err(|err| unusable("our certificate and key", err))?;

        let crls = match crls {
            None => Vec::new(),
            Some(text) => {
                let crls = CertificateRevocationListDer::pem_slice_iter(text.as_bytes())
                    .collect::<Result<Vec<_>, _>>()
                    .map_err(|err| unusable("revocation lists", err))?;
                if crls.is_empty() {
                    return Err(unusable("revocation lists", "no PEM section `X509 CRL`"));
                }
                crls
            }
        };
        Ok(Self { roots: Arc::new(store), ours: Arc::new(ours), crls })
    }

    pub(super) fn client(
        &self,
        builder: ConfigBuilder<ClientConfig, WantsVerifier>,
    ) -> Result<ClientConfig, Error> {
        let verifier = WebPkiServerVerifier::builder_with_provider(
            Arc::clone(&self.roots),
            Arc::clone(builder.crypto_provider()),
        )
        .with_crls(self.crls.iter().cloned())
        .build()
        .map_err(|err| unusable("roots and revocation lists", err))?;
        Ok(builder
            .with_webpki_verifier(verifier)
            .with_client_cert_resolver(Arc::new(SingleCertAndKey::from(Arc::clone(&self.ours)))))
    }

    pub(super) fn server(
        &self,
        builder: ConfigBuilder<ServerConfig, WantsVerifier>,
    ) -> Result<ServerConfig, Error> {
        let verifier = WebPkiClientVerifier::builder_with_provider(
            Arc::clone(&self.roots),
            Arc::clone(builder.crypto_provider()),
        )
        .with_crls(self.crls.iter().cloned())
        .build()
        .map_err(|err| unusable("roots and revocation lists", err))?;
        Ok(builder
            .with_client_cert_verifier(verifier)
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(Arc::clone(&self.ours)))))
    }
}

fn unusable(what: &str, why: impl std::fmt::Display) -> Error {
    Error::Certificates(format!("{what}: {why}"))
}
