//! The settings of a client.

use std::fmt;
use std::fs::File;
use std::path::PathBuf;
use std::time::Duration;

use reqwest::Url;
use secrecy::{ExposeSecret, SecretSlice};

use crate::secret::SecretBuf;
use crate::tls::{self, Identity};
use crate::{Client, Error, Quirks, RetryPolicy};

/// Time for which an idle connection is kept. It is shorter than the common keep-alive time of servers (5 s), so that a
/// request is not written to a connection that the KME is just closing: such a call would have to be reported as
/// [`Error::KeyPossiblyConsumed`].
const IDLE: Duration = Duration::from_secs(4);

/// Largest file read as a certificate or key, in bytes.
const MAX_FILE: usize = 1 << 20;

/// Builds a [`Client`]. Required are [`kme_url`](Self::kme_url), [`ca`](Self::ca), [`sae_cert`](Self::sae_cert) and
/// [`sae_key`](Self::sae_key); the last three may also be files.
#[must_use]
pub struct ClientBuilder {
    kme_url: Option<String>,
    ca: Option<PemSource>,
    sae_cert: Option<PemSource>,
    sae_key: Option<PemSource>,
    identity: Identity,
    connect_timeout: Duration,
    limits: Limits,
}

/// The limits that apply to each call.
#[derive(Clone, Debug)]
pub(crate) struct Limits {
    pub(crate) timeout: Duration,
    pub(crate) deadline: Duration,
    pub(crate) max_body: usize,
    pub(crate) retry: RetryPolicy,
    pub(crate) quirks: Quirks,
}

enum PemSource {
    Bytes(SecretSlice<u8>),
    File(PathBuf),
}

impl Default for ClientBuilder {
    fn default() -> Self {
        Self {
            kme_url: None,
            ca: None,
            sae_cert: None,
            sae_key: None,
            identity: Identity { kme_id: None, check_name: true },
            connect_timeout: Duration::from_secs(3),
            limits: Limits {
                timeout: Duration::from_secs(10),
                deadline: Duration::from_secs(30),
                max_body: 1 << 20,
                retry: RetryPolicy::default(),
                quirks: Quirks::STRICT,
            },
        }
    }
}

impl ClientBuilder {
    /// Sets the KME's address, as `https://kme-a.example:8443` or `https://192.0.2.1`. A path is kept as a prefix of
    /// `/api/v1/keys`.
    pub fn kme_url(mut self, url: impl Into<String>) -> Self {
        self.kme_url = Some(url.into());
        self
    }

    /// Sets the CA that must have issued the KME's certificate: PEM (one or several) or DER. No other CA is trusted.
    pub fn ca(mut self, pem_or_der: impl Into<Vec<u8>>) -> Self {
        self.ca = Some(PemSource::Bytes(SecretSlice::from(pem_or_der.into())));
        self
    }

    /// Sets a file for [`ca`](Self::ca), which [`build`](Self::build) reads.
    pub fn ca_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.ca = Some(PemSource::File(path.into()));
        self
    }

    /// Sets the SAE's certificate: PEM (with any intermediates) or DER.
    pub fn sae_cert(mut self, pem_or_der: impl Into<Vec<u8>>) -> Self {
        self.sae_cert = Some(PemSource::Bytes(SecretSlice::from(pem_or_der.into())));
        self
    }

    /// Sets a file for [`sae_cert`](Self::sae_cert), which [`build`](Self::build) reads.
    pub fn sae_cert_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.sae_cert = Some(PemSource::File(path.into()));
        self
    }

    /// Sets the SAE's private key, PEM or DER: PKCS#8, SEC1 or PKCS#1. It is zeroized after [`build`](Self::build).
    ///
    /// A `Vec<u8>` is used without a copy if its capacity equals its length. Otherwise the allocator shrinks it, and
    /// may leave a copy behind. In that case pass a `Box<[u8]>` or a `SecretSlice`.
    pub fn sae_key(mut self, pem_or_der: impl Into<SecretSlice<u8>>) -> Self {
        self.sae_key = Some(PemSource::Bytes(pem_or_der.into()));
        self
    }

    /// Sets a file for [`sae_key`](Self::sae_key), which [`build`](Self::build) reads.
    pub fn sae_key_file(mut self, path: impl Into<PathBuf>) -> Self {
        self.sae_key = Some(PemSource::File(path.into()));
        self
    }

    /// Sets the KME's ID, which must be the common name in the subject of its certificate. This is checked in addition
    /// to the host name or address in the URL.
    ///
    /// Clause 5.1 asks an SAE to confirm the KME's ID from its certificate before anything else. Without this setting,
    /// the host name or address stands for the ID: any certificate of the [`ca`](Self::ca) for the host in the URL is
    /// accepted. Set it if one CA issues certificates to several KMEs, or to other servers.
    pub fn kme_id(mut self, id: impl Into<String>) -> Self {
        self.identity.kme_id = Some(id.into());
        self
    }

    /// Trusts the [`kme_id`](Self::kme_id) alone, and does not compare the certificate with the host name: for KMEs
    /// whose certificates contain no host name. The specification lets a KME be identified by its ID. The CA must then
    /// name each KME truthfully.
    pub fn kme_id_replaces_name_check(mut self) -> Self {
        self.identity.check_name = false;
        self
    }

    /// Sets the time for TCP and TLS. Default 3 s. Keep it below [`timeout`](Self::timeout): a call that runs out of
    /// time while it connects has certainly not consumed a key.
    pub fn connect_timeout(mut self, time: Duration) -> Self {
        self.connect_timeout = time;
        self
    }

    /// Sets the time for one attempt, from connecting to the last byte of the answer. Default 10 s.
    pub fn timeout(mut self, time: Duration) -> Self {
        self.limits.timeout = time;
        self
    }

    /// Sets the time for a whole call with its repeats and pauses. Default 30 s.
    pub fn deadline(mut self, time: Duration) -> Self {
        self.limits.deadline = time;
        self
    }

    /// Sets the largest accepted answer in bytes, whatever its Content-Length says. Default 1 MiB.
    pub fn max_body(mut self, bytes: usize) -> Self {
        self.limits.max_body = bytes;
        self
    }

    /// Sets when calls are repeated.
    pub fn retry(mut self, policy: RetryPolicy) -> Self {
        self.limits.retry = policy;
        self
    }

    /// Sets the deviations to tolerate. Default none.
    pub fn quirks(mut self, quirks: Quirks) -> Self {
        self.limits.quirks = quirks;
        self
    }

    /// Reads the files and creates the client. Sends nothing.
    ///
    /// # Errors
    /// [`Error::Config`] names the missing or unusable setting.
    pub fn build(self) -> Result<Client, Error> {
        let (base, kme) = base_url(self.kme_url)?;
        if !self.identity.check_name && self.identity.kme_id.is_none() {
            return Err(config(
                "kme_id_replaces_name_check",
                "needs kme_id: without it any certificate of the CA would do",
            ));
        }
        if self.identity.kme_id.as_deref() == Some("") {
            return Err(config("kme_id", "is empty"));
        }
        for (setting, time) in [
            ("connect_timeout", self.connect_timeout),
            ("timeout", self.limits.timeout),
            ("deadline", self.limits.deadline),
        ] {
            if time.is_zero() {
                return Err(config(setting, "is zero; give a duration over zero"));
            }
        }
        let ca = read(self.ca, "ca")?;
        let cert = read(self.sae_cert, "sae_cert")?;
        let key = read(self.sae_key, "sae_key")?;
        let tls = tls::client_config(
            ca.expose_secret(),
            cert.expose_secret(),
            key.expose_secret(),
            self.identity,
        )?;
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(tls)
            .https_only(true)
            .http1_only()
            .no_proxy()
            .redirect(reqwest::redirect::Policy::none())
            .retry(reqwest::retry::never())
            .referer(false)
            .connect_timeout(self.connect_timeout)
            .pool_idle_timeout(IDLE)
            .user_agent(concat!("etsi-qkd014/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(|e| config("tls", format!("the HTTP client cannot be made: {e}")))?;
        Ok(Client::new(http, base, kme, self.connect_timeout, self.limits))
    }
}

impl fmt::Debug for ClientBuilder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientBuilder")
            .field("kme_url", &self.kme_url.as_deref().map(shown))
            .field("identity", &self.identity)
            .field("limits", &self.limits)
            .finish_non_exhaustive()
    }
}

fn config(setting: &'static str, reason: impl Into<String>) -> Error {
    Error::Config { setting, reason: reason.into() }
}

/// Returns a URL for errors, without its text if that may contain a password.
fn shown(url: &str) -> &str {
    if url.contains('@') { "(a URL with a user name, not shown)" } else { url }
}

/// Returns the URL below which the methods are, and host:port for errors.
fn base_url(text: Option<String>) -> Result<(Url, String), Error> {
    let text = text.ok_or_else(|| config("kme_url", "is missing"))?;
    let accepted = "accepted: https://host[:port][/prefix]";
    let mut url = Url::parse(&text)
        .map_err(|e| config("kme_url", format!("{:?}: {e}; {accepted}", shown(&text))))?;
    let Some(host) = url.host_str().map(str::to_owned) else {
        return Err(config("kme_url", format!("has no host; {accepted}")));
    };
    if url.scheme() != "https" {
        return Err(config("kme_url", format!("{:?} is not https; {accepted}", shown(&text))));
    }
    if !url.username().is_empty() || url.password().is_some() {
        return Err(config("kme_url", format!("holds a user name or password; {accepted}")));
    }
    if url.query().is_some() || url.fragment().is_some() {
        return Err(config("kme_url", format!("has a query or fragment; {accepted}")));
    }
    let kme = format!("{host}:{}", url.port_or_known_default().unwrap_or(443));
    url.path_segments_mut()
        .map_err(|()| config("kme_url", accepted))?
        .pop_if_empty()
        .extend(["api", "v1", "keys"]);
    Ok((url, kme))
}

fn read(source: Option<PemSource>, setting: &'static str) -> Result<SecretSlice<u8>, Error> {
    let path = match source {
        None => return Err(config(setting, "is missing")),
        Some(PemSource::Bytes(bytes)) => return Ok(bytes),
        Some(PemSource::File(path)) => path,
    };
    let fail = |reason: String| config(setting, format!("{}: {reason}", path.display()));
    // A file that is not regular, such as a pipe from a password manager, does not state its length.
    let file = File::open(&path).map_err(|e| fail(e.to_string()))?;
    match SecretBuf::read_from(file, MAX_FILE).map_err(|e| fail(e.to_string()))? {
        Some(content) => Ok(content.into_secret()),
        None => Err(fail(format!("is larger than {MAX_FILE} bytes"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(builder: ClientBuilder, names: &str) {
        match builder.build() {
            Err(Error::Config { setting, .. }) => assert_eq!(setting, names),
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("must be refused: {names}"),
        }
    }

    #[test]
    fn each_unusable_setting_is_named() {
        let new = ClientBuilder::default;
        refused(new(), "kme_url");
        for bad in ["", "kme", "http://kme", "https://u:p@kme", "https://kme?x", "https://kme#x"] {
            refused(new().kme_url(bad), "kme_url");
        }
        let url = || new().kme_url("https://127.0.0.1");
        refused(url(), "ca");
        refused(url().kme_id_replaces_name_check(), "kme_id_replaces_name_check");
        refused(url().kme_id(""), "kme_id");
        refused(url().timeout(Duration::ZERO), "timeout");
        refused(url().ca_file("/nonexistent/ca.pem"), "ca");
        let garbage = || url().ca(*b"x").sae_cert(*b"x").sae_key(b"x".to_vec());
        refused(garbage(), "ca");
        refused(garbage().ca(*b"-----BEGIN X-----"), "ca");
    }

    #[test]
    fn a_prefix_in_the_url_is_kept() {
        let (url, kme) = base_url(Some("https://[::1]:8443/site/".into())).unwrap();
        assert_eq!(url.as_str(), "https://[::1]:8443/site/api/v1/keys");
        assert_eq!(kme, "[::1]:8443");
    }
}
