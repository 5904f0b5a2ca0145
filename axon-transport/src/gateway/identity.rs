//! The classic identity: our key and whom it trusts, from the files that the settings name.

use std::{fs, path::Path, sync::Arc};

use axon_tls::identity::{Auth, CaMaterial, SigningKey, Trust, TrustFile};

use super::GatewayError;
use crate::config::{ClassicAuth, ClassicConfig};

/// Reads what `classic` names. An ephemeral key for `none`.
///
/// # Errors
/// A file that cannot be read or understood, by the name of its variable.
pub(super) fn load(classic: &ClassicConfig) -> Result<Auth, GatewayError> {
    Ok(match classic.auth {
        ClassicAuth::None => Auth::None(SigningKey::generate()?),
        ClassicAuth::Pinned => Auth::Pinned {
            key: key(classic.key.as_deref())?,
            trust: Trust::new(trust(classic.trust.as_deref())?),
        },
        ClassicAuth::Ca => ca(classic)?,
    })
}

fn read(variable: &'static str, path: Option<&Path>) -> Result<String, GatewayError> {
    let path = path.ok_or(GatewayError::Missing(variable))?;
    fs::read_to_string(path).map_err(|e| GatewayError::File {
        variable,
        path: path.to_owned(),
        reason: e.to_string(),
    })
}

fn key(path: Option<&Path>) -> Result<SigningKey, GatewayError> {
    let pem = zeroize::Zeroizing::new(read("AXON_CLASSIC_KEY", path)?);
    Ok(SigningKey::from_pem(&pem)?)
}

/// Reads the trust file.
pub(super) fn trust(path: Option<&Path>) -> Result<TrustFile, GatewayError> {
    let text = read("AXON_CLASSIC_TRUST", path)?;
    TrustFile::parse(&text).map_err(|e| GatewayError::File {
        variable: "AXON_CLASSIC_TRUST",
        path: path.map(Into::into).unwrap_or_default(),
        reason: e.to_string(),
    })
}

/// What this host is called in HELLO under `auth`: `node`, its own name; in `ca` a name that its
/// certificate has, since peers accept no other.
///
/// # Errors
/// The certificate names several hosts, or none, and none of them is `node`.
pub(super) fn host(
    auth: Option<&Auth>,
    classic: &ClassicConfig,
    node: &str,
) -> Result<String, GatewayError> {
    let Some(Auth::Ca(material)) = auth else { return Ok(node.to_owned()) };
    let names = material.our_hosts();
    if names.iter().any(|name| name.eq_ignore_ascii_case(node)) {
        return Ok(node.to_owned());
    }
    match &names[..] {
        [name] => Ok(name.clone()),
        _ => Err(GatewayError::File {
            variable: "AXON_CLASSIC_CERT",
            path: classic.cert.clone().unwrap_or_default(),
            reason: format!(
                "it names {}, so it does not say which host this is; it needs the DNS name {node}, \
                 or one DNS name alone (wildcards do not count)",
                if names.is_empty() { "no host".to_owned() } else { names.join(", ") }
            ),
        }),
    }
}

fn ca(classic: &ClassicConfig) -> Result<Auth, GatewayError> {
    let roots = read("AXON_CLASSIC_CA", classic.ca.as_deref())?;
    let chain = read("AXON_CLASSIC_CERT", classic.cert.as_deref())?;
    let key = zeroize::Zeroizing::new(read("AXON_CLASSIC_KEY", classic.key.as_deref())?);
    let crls = match &classic.crl {
        Some(path) => Some(read("AXON_CLASSIC_CRL", Some(path))?),
        None => None,
    };
    let material = CaMaterial::from_pem(&roots, &chain, &key, crls.as_deref())?;
    // Addresses are dialled, not names: `establish` compares the certificate with HELLO instead.
    Ok(Auth::Ca(Arc::new(material.with_names_checked_by_application())))
}
