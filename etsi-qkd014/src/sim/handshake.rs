//! The TLS of a KME: the certificates that it shows, and its refusals.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::PrivateKeyDer;
use rustls::pki_types::pem::PemObject;
use rustls::server::{ServerConfig, WebPkiClientVerifier};
use rustls::version::{TLS12, TLS13};
use rustls::{KeyLog, RootCertStore, SupportedProtocolVersion};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;

use super::Error;
use super::fault::Fault;
use super::pki::{Pair, Pki, Validity};
use crate::tls;

/// Time for a client to finish its handshake.
pub(super) const TIME: Duration = Duration::from_secs(10);
const LINGER: Duration = Duration::from_secs(1);

/// The function that gets the secrets of TLS connections, if any.
#[derive(Clone, Default)]
pub(super) struct TlsWitness(Option<Arc<Tell>>);

type Tell = dyn Fn(&str, &[u8]) + Send + Sync;

impl TlsWitness {
    pub(super) fn new(tell: impl Fn(&str, &[u8]) + Send + Sync + 'static) -> Self {
        Self(Some(Arc::new(tell)))
    }
}

impl fmt::Debug for TlsWitness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_some() { "a witness" } else { "no witness" })
    }
}

impl KeyLog for TlsWitness {
    fn will_log(&self, _: &str) -> bool {
        self.0.is_some()
    }

    fn log(&self, label: &str, _: &[u8], secret: &[u8]) {
        if let Some(tell) = &self.0 {
            tell(label, secret);
        }
    }
}

/// One acceptor for each certificate that a KME can show.
pub(super) struct Acceptors {
    valid: TlsAcceptor,
    expired: TlsAcceptor,
    not_yet_valid: TlsAcceptor,
}

impl Acceptors {
    pub(super) fn new(
        pki: &Pki,
        kme: &str,
        tls12_only: bool,
        witness: &TlsWitness,
    ) -> Result<Self, Error> {
        let of = |validity| {
            let mut config = server_config(pki.ca_pem(), pki.known(kme, validity)?, tls12_only)?;
            config.key_log = Arc::new(witness.clone());
            Ok::<_, Error>(TlsAcceptor::from(Arc::new(config)))
        };
        Ok(Self {
            valid: of(Validity::Now)?,
            expired: of(Validity::Past)?,
            not_yet_valid: of(Validity::Future)?,
        })
    }

    /// Returns the acceptor for a connection with this fault.
    pub(super) fn of(&self, fault: Option<&Fault>) -> &TlsAcceptor {
        match fault {
            Some(Fault::CertificateExpired) => &self.expired,
            Some(Fault::CertificateNotYetValid) => &self.not_yet_valid,
            _ => &self.valid,
        }
    }
}

fn server_config(ca: &str, pair: &Pair, tls12_only: bool) -> Result<ServerConfig, Error> {
    let wrong = |e: &dyn fmt::Display| Error::Certificates(e.to_string());
    let provider = tls::provider();
    let mut roots = RootCertStore::empty();
    for cert in tls::certificates(ca.as_bytes(), "ca").map_err(|e| wrong(&e))? {
        roots.add(cert).map_err(|e| wrong(&e))?;
    }
    let verifier =
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(&provider))
            .build()
            .map_err(|e| wrong(&e))?;
    let chain = tls::certificates(pair.cert.as_bytes(), "cert").map_err(|e| wrong(&e))?;
    let key = PrivateKeyDer::from_pem_slice(pair.key.as_bytes()).map_err(|e| wrong(&e))?;
    let versions: &[&SupportedProtocolVersion] =
        if tls12_only { const { &[&TLS12] } } else { const { &[&TLS13, &TLS12] } };
    ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(versions)
        .map_err(|e| wrong(&e))?
        .with_client_cert_verifier(verifier)
        .with_single_cert(chain, key)
        .map_err(|e| wrong(&e))
}

/// Refuses the handshake like a TLS server that has no parameters in common with its client: with a
/// fatal alert after the ClientHello (RFC 8446, 6.2).
pub(super) async fn refuse(mut stream: TcpStream) -> std::io::Result<()> {
    const HANDSHAKE_FAILURE: [u8; 7] = [21, 3, 3, 0, 2, 2, 40];
    let mut first = [0];
    let read = stream.read(&mut first);
    if !matches!(tokio::time::timeout(TIME, read).await, Ok(Ok(1))) {
        return Ok(());
    }
    stream.write_all(&HANDSHAKE_FAILURE).await?;
    linger(stream).await
}

/// After a refusal, reads what the client has already sent. Closing with unread bytes would reset
/// the connection, and the client might never see the reason.
pub(super) async fn linger<S: AsyncRead + AsyncWrite + Unpin>(
    mut stream: S,
) -> std::io::Result<()> {
    stream.shutdown().await?;
    tokio::time::timeout(LINGER, until_gone(&mut stream)).await.unwrap_or(Ok(()))
}

/// Reads and discards until the client is gone.
pub(super) async fn until_gone<S: AsyncRead + Unpin>(stream: &mut S) -> std::io::Result<()> {
    let mut sink = [0; 4096];
    while stream.read(&mut sink).await? > 0 {}
    Ok(())
}
