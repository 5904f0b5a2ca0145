//! Loads an identity from files.

use std::sync::Arc;

use axon_tls::{
    CaPart, Error,
    identity::{Auth, CaMaterial, SigningKey, Trust, TrustFile},
};
use axon_transport::config::{ClassicAuth, ClassicConfig};

use super::file::NamedFile;
use crate::error::GatewayError;

/// The files that `classic` names.
pub(super) struct IdentityFiles {
    kind: Kind,
}

enum Kind {
    None,
    Pinned { key: NamedFile, trust: NamedFile },
    Ca { roots: NamedFile, chain: NamedFile, key: NamedFile, crl: Option<NamedFile> },
}

impl IdentityFiles {
    /// Returns the files that the settings name.
    ///
    /// # Errors
    /// A setting is missing.
    pub(super) fn of(classic: &ClassicConfig) -> Result<Self, GatewayError> {
        let ClassicConfig { key, trust, ca, cert, crl, .. } = classic;
        let kind = match classic.auth {
            ClassicAuth::None => Kind::None,
            ClassicAuth::Pinned => Kind::Pinned {
                key: NamedFile::new("AXON_CLASSIC_KEY", key.as_deref())?,
                trust: NamedFile::new("AXON_CLASSIC_TRUST", trust.as_deref())?,
            },
            ClassicAuth::Ca => Kind::Ca {
                roots: NamedFile::new("AXON_CLASSIC_CA", ca.as_deref())?,
                chain: NamedFile::new("AXON_CLASSIC_CERT", cert.as_deref())?,
                key: NamedFile::new("AXON_CLASSIC_KEY", key.as_deref())?,
                crl: match crl {
                    Some(path) => Some(NamedFile::new("AXON_CLASSIC_CRL", Some(path))?),
                    None => None,
                },
            },
        };
        Ok(Self { kind })
    }

    /// Returns all files.
    pub(super) fn files(&self) -> Vec<NamedFile> {
        match &self.kind {
            Kind::None => Vec::new(),
            Kind::Pinned { key, trust } => vec![key.clone(), trust.clone()],
            Kind::Ca { roots, chain, key, crl } => {
                [roots, chain, key].into_iter().chain(crl).cloned().collect()
            }
        }
    }

    /// Reads all files. `before` is the identity that they gave the last time: handshakes in progress refer to its
    /// pins.
    ///
    /// # Errors
    /// A file that cannot be read or understood, by the name of its variable.
    pub(super) fn load(&self, before: Option<&Auth>) -> Result<Loaded, GatewayError> {
        Ok(match (&self.kind, before) {
            (Kind::None, Some(before)) => Loaded { auth: before.clone(), pins: None },
            (Kind::None, None) => Loaded { auth: Auth::None(SigningKey::generate()?), pins: None },
            (Kind::Pinned { key, trust }, before) => {
                let pem = key.read()?;
                let loaded = SigningKey::from_pem(text(key, &pem)?);
                let loaded = loaded.map_err(|e| key.unusable(e))?;
                let bytes = trust.read()?;
                let pins = TrustFile::parse(text(trust, &bytes)?);
                let pins = pins.map_err(|e| trust.unusable(e))?;
                let shared = match before {
                    Some(Auth::Pinned { trust, .. }) => trust.clone(),
                    _ => Trust::default(),
                };
                let auth = Auth::Pinned { key: loaded, trust: shared };
                Loaded { auth, pins: Some(pins) }
            }
            (Kind::Ca { roots, chain, key, crl }, _) => {
                let [root_bytes, chain_bytes, pem] = [roots.read()?, chain.read()?, key.read()?];
                let list_bytes = crl.as_ref().map(NamedFile::read).transpose()?;
                let lists = match (crl, &list_bytes) {
                    (Some(crl), Some(bytes)) => Some(text(crl, bytes)?),
                    _ => None,
                };
                let material = CaMaterial::from_pem(
                    text(roots, &root_bytes)?,
                    text(chain, &chain_bytes)?,
                    text(key, &pem)?,
                    lists,
                )
                .map_err(|error| match (error, crl) {
                    (Error::Certificates { part: CaPart::RevocationLists, reason }, Some(crl)) => {
                        crl.unusable(reason)
                    }
                    (Error::Certificates { part: CaPart::Roots, reason }, _) => {
                        roots.unusable(reason)
                    }
                    (Error::Certificates { part: CaPart::Key, reason }, _) => key.unusable(reason),
                    (Error::Certificates { reason, .. }, _) => chain.unusable(reason),
                    (other, _) => other.into(),
                })?;
                if let Err(error) = material.accepts_us() {
                    tracing::warn!(%error,
                        "by AXON_CLASSIC_CA and _CRL this host's own certificate is not accepted: peers \
                         with the same files will refuse it; is it AXON_CLASSIC_CERT that must be \
                         renewed, the revocation list, or the clock that is wrong?");
                }
                // Addresses are dialled, not names: `establish` compares the certificate with HELLO
                // instead.
                let material = material.with_names_checked_by_application();
                Loaded { auth: Auth::Ca(Arc::new(material)), pins: None }
            }
        })
    }

    /// Returns the name of this host in HELLO under `auth`: `node`, its own name; in `ca` a name in its certificate,
    /// since peers accept no other.
    ///
    /// # Errors
    /// The certificate names several hosts, or none, and none of them is `node`.
    pub(super) fn host(&self, auth: &Auth, node: &str) -> Result<String, GatewayError> {
        let (Auth::Ca(material), Kind::Ca { chain, .. }) = (auth, &self.kind) else {
            return Ok(node.to_owned());
        };
        let names = material.our_hosts();
        if names.iter().any(|name| name.eq_ignore_ascii_case(node)) {
            return Ok(node.to_owned());
        }
        match &names[..] {
            [name] => Ok(name.clone()),
            _ => Err(chain.unusable(format!(
                "it names {}, so it does not say which host this is; it needs the DNS name {node}, \
                 or one DNS name alone (wildcards do not count)",
                if names.is_empty() { "no host".to_owned() } else { names.join(", ") }
            ))),
        }
    }

    /// Checks that later files still give this host its name, by which peers know it.
    ///
    /// # Errors
    /// Its certificate no longer has that name.
    pub(super) fn still_names(&self, auth: &Auth, host: &str) -> Result<(), GatewayError> {
        match (auth, &self.kind) {
            (Auth::Ca(material), Kind::Ca { chain, .. })
                if !material.our_hosts().iter().any(|name| name.eq_ignore_ascii_case(host)) =>
            {
                Err(chain.unusable(format!(
                    "it does not name {host}, as this daemon calls itself; restart the daemon to go \
                     by another name"
                )))
            }
            _ => Ok(()),
        }
    }
}

/// The identity that the files define.
pub(super) struct Loaded {
    auth: Auth,
    pins: Option<TrustFile>,
}

impl Loaded {
    /// Returns the identity for inspection. Its pins are not in force.
    pub(super) fn auth(&self) -> &Auth {
        &self.auth
    }

    /// Puts the identity in force, also for handshakes that have begun.
    pub(super) fn put_in_force(self) -> Auth {
        if let (Auth::Pinned { trust, .. }, Some(pins)) = (&self.auth, self.pins) {
            trust.replace(pins);
        }
        self.auth
    }
}

fn text<'a>(file: &NamedFile, bytes: &'a [u8]) -> Result<&'a str, GatewayError> {
    std::str::from_utf8(bytes).map_err(|_| file.unusable("it is not text in UTF-8"))
}
