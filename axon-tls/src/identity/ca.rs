//! Authentication by certificates from given roots.

use std::sync::Arc;

use rustls::crypto::aws_lc_rs::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer, UnixTime};
use rustls::sign::{CertifiedKey, SigningKey, SingleCertAndKey};
use rustls::{
    ClientConfig, ConfigBuilder, InconsistentKeys, RootCertStore, ServerConfig, WantsVerifier,
};
use webpki::{CertRevocationList, OwnedCertRevocationList};

use super::refused::{Refused, is_of_old_version};
use super::roots::{self, FromRoots};
use super::verifier::{Peers, Role, Verifier};
use super::{pem, signing_key};
use crate::{CaPart, Error};

/// The roots, this end's certificate and key, and the revocation lists.
///
/// Each end checks that the other's certificate comes from the roots, is in date, permits the role of a client or a
/// server, and was not revoked. If there are revocation lists, every issuer in the peer's chain needs one that is in
/// date. If an issuer has several lists, all of them apply. A client also checks that the server's certificate is for
/// the name to which it connects. The application of the server has to check the identity of a client, with
/// [`CaMaterial::is_for_host()`].
pub struct CaMaterial {
    roots: Arc<RootCertStore>,
    ours: Arc<CertifiedKey>,
    crls: Arc<Vec<CertRevocationList<'static>>>,
    names_checked_later: bool,
}

impl CaMaterial {
    /// Reads PEM texts: the roots, this end's certificate with the chain to a root, its PKCS#8 key, and optional
    /// revocation lists.
    ///
    /// # Errors
    /// A text cannot be used, the key does not belong to the certificate, or no revocation list is of a root. In the
    /// last case no peer could be accepted.
    pub fn from_pem(
        roots: &str,
        chain: &str,
        key: &str,
        crls: Option<&str>,
    ) -> Result<Self, Error> {
        let mut store = RootCertStore::empty();
        for root in certificates(CaPart::Roots, roots)? {
            store.add(root).map_err(|err| unusable(CaPart::Roots, err))?;
        }
        let chain = certificates(CaPart::Chain, chain)?;
        let key = private_key(key).map_err(|err| unusable(CaPart::Key, err))?;
        // Roots may be of an old version, because only their names and keys are used.
        if chain.iter().any(is_of_old_version) {
            return Err(unusable(CaPart::Chain, Refused::OldVersion));
        }
        let ours = CertifiedKey::new(chain, key);
        ours.keys_match().map_err(|error| match error {
            rustls::Error::InconsistentKeys(InconsistentKeys::KeyMismatch) => {
                unusable(CaPart::Key, "it is not the key of our certificate")
            }
            rustls::Error::InconsistentKeys(_) => {
                let why = "a key of this kind cannot be compared with our certificate; use Ed25519, \
                           ECDSA, RSA or ML-DSA-65";
                unusable(CaPart::Key, why)
            }
            other => unusable(CaPart::Chain, format!("it cannot be read: {other}")),
        })?;
        let crls = crls.map_or(Ok(Vec::new()), |text| revocation_lists(text, &store))?;
        Ok(Self {
            roots: Arc::new(store),
            ours: Arc::new(ours),
            crls: Arc::new(crls),
            names_checked_later: false,
        })
    }

    /// Leaves the check of the server's name to the application, for protocols in which both ends send their names
    /// after they have connected.
    ///
    /// **The caller must check the name that each peer sends with [`CaMaterial::is_for_host()`]**: until then any
    /// holder of a certificate from the roots can be the server.
    #[must_use]
    pub fn with_names_checked_by_application(mut self) -> Self {
        self.names_checked_later = true;
        self
    }

    /// Returns whether a peer with `certificate` may use the name `host`. One of the certificate's DNS names must be
    /// exactly that; a wildcard is not enough.
    pub fn is_for_host(certificate: &CertificateDer<'_>, host: &str) -> bool {
        roots::is_for_host(certificate, host)
    }

    /// Returns the hosts that this end's own certificate is for: its DNS names without wildcards.
    pub fn our_hosts(&self) -> Vec<String> {
        roots::host_names(&self.ours.cert[0])
    }

    /// Checks that a client with `chain` would be accepted now. A certificate may have expired since the handshake, and
    /// newer material may have other roots and lists.
    ///
    /// It does not check the client's signature, which the handshake verified.
    pub fn accepts_client(&self, chain: &[CertificateDer<'_>]) -> Result<(), Error> {
        self.accepts(chain, Role::Client)
    }

    /// As [`CaMaterial::accepts_client()`], for a server. The server's name is not checked.
    pub fn accepts_server(&self, chain: &[CertificateDer<'_>]) -> Result<(), Error> {
        self.accepts(chain, Role::Nameless)
    }

    /// Checks that a peer with the same roots and lists would accept this end now, in both roles.
    pub fn accepts_us(&self) -> Result<(), Error> {
        self.accepts_client(&self.ours.cert).and_then(|()| self.accepts_server(&self.ours.cert))
    }

    fn accepts(&self, chain: &[CertificateDer<'_>], role: Role<'_>) -> Result<(), Error> {
        let (shown, others) = chain.split_first().ok_or(rustls::Error::NoCertificatesPresented)?;
        Ok(self.verifier().0.accept(shown, others, role, UnixTime::now())?)
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

fn certificates(part: CaPart, text: &str) -> Result<Vec<CertificateDer<'static>>, Error> {
    let certificates = CertificateDer::pem_slice_iter(text.as_bytes())
        .collect::<Result<Vec<_>, _>>()
        .map_err(|err| unusable(part, err))?;
    if certificates.is_empty() {
        return Err(unusable(part, "no PEM section `CERTIFICATE`"));
    }
    Ok(certificates)
}

fn private_key(text: &str) -> Result<Arc<dyn SigningKey>, Error> {
    let der = pem::private_key(text)?;
    signing_key(&PrivateKeyDer::Pkcs8(der.as_slice().into()))
}

fn revocation_lists(
    text: &str,
    roots: &RootCertStore,
) -> Result<Vec<CertRevocationList<'static>>, Error> {
    let part = CaPart::RevocationLists;
    let mut lists = Vec::new();
    for der in CertificateRevocationListDer::pem_slice_iter(text.as_bytes()) {
        let der = der.map_err(|err| unusable(part, err))?;
        let list = OwnedCertRevocationList::from_der(&der).map_err(|err| unusable(part, err))?;
        lists.push(CertRevocationList::from(list));
    }
    if lists.is_empty() {
        return Err(unusable(part, "no PEM section `X509 CRL`"));
    }
    // Every chain ends at a root, and every issuer in it needs a list.
    let of_a_root = |list: &CertRevocationList<'_>| {
        roots.roots.iter().any(|root| root.subject.as_ref() == list.issuer())
    };
    if !lists.iter().any(of_a_root) {
        return Err(unusable(part, "none is of one of the roots, so nobody could be accepted"));
    }
    Ok(lists)
}

fn unusable(part: CaPart, why: impl std::fmt::Display) -> Error {
    Error::Certificates { part, reason: why.to_string() }
}
