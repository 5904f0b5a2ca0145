//! Authentication of the peer of a hybrid connection.
//!
//! The key exchange protects against an adversary that records traffic. Only authentication
//! protects against an active one. [`Auth`] selects the protection of a configuration, and there is
//! no default. Authentication is mutual in every case. In every case the peer has to prove that it
//! has the private key of what it shows.

mod ca;
mod key;
mod pem;
mod raw_key;
mod refused;
mod roots;
mod scan;
mod spki;
mod trust;
mod verifier;

use std::sync::Arc;

use rustls::client::ResolvesClientCert;
use rustls::server::ResolvesServerCert;
use rustls::{ClientConfig, ConfigBuilder, ServerConfig, WantsVerifier};

pub use ca::CaMaterial;
use key::signing_key;
pub use key::{KeyAlgorithm, SigningKey};
use raw_key::RawKeys;
pub use scan::{Probe, Shown};
pub use spki::SpkiDigest;
pub use trust::{Pin, Trust, TrustFile, TrustFileError};
use verifier::Verifier;

use crate::Error;

/// How the two ends of a hybrid connection authenticate.
#[derive(Clone)]
#[non_exhaustive]
pub enum Auth {
    /// No authentication. Any peer is accepted with the ephemeral raw public key that it shows.
    ///
    /// **This protects against eavesdroppers, not against a man in the middle.**
    None(SigningKey),
    /// Raw public keys (RFC 7250) that both ends know in advance.
    Pinned {
        /// The key of this end, which the peer has pinned.
        key: SigningKey,
        /// The keys of the peers.
        trust: Trust,
    },
    /// Certificates from the given roots only, on both ends. Public roots are not accepted.
    Ca(Arc<CaMaterial>),
}

impl Auth {
    /// Returns the name used in configuration: `none`, `pinned` or `ca`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::None(_) => "none",
            Self::Pinned { .. } => "pinned",
            Self::Ca(_) => "ca",
        }
    }

    pub(crate) fn client(
        &self,
        builder: ConfigBuilder<ClientConfig, WantsVerifier>,
    ) -> Result<ClientConfig, Error> {
        let (key, trust) = match self {
            Self::None(key) => (key, None),
            Self::Pinned { key, trust } => (key, Some(trust.clone())),
            Self::Ca(material) => return Ok(material.client(builder)),
        };
        let ours: Arc<dyn ResolvesClientCert> = key.client_resolver();
        Ok(builder
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(Verifier(RawKeys::new(trust))))
            .with_client_cert_resolver(ours))
    }

    pub(crate) fn server(
        &self,
        builder: ConfigBuilder<ServerConfig, WantsVerifier>,
    ) -> Result<ServerConfig, Error> {
        let (key, trust) = match self {
            Self::None(key) => (key, None),
            Self::Pinned { key, trust } => (key, Some(trust.clone())),
            Self::Ca(material) => return Ok(material.server(builder)),
        };
        let ours: Arc<dyn ResolvesServerCert> = key.server_resolver();
        Ok(builder
            .with_client_cert_verifier(Arc::new(Verifier(RawKeys::new(trust))))
            .with_cert_resolver(ours))
    }
}

impl std::fmt::Debug for Auth {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Auth::{}", self.name())
    }
}
