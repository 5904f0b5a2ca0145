//! The sockets: TLS in front of [`http`](super::http) and [`api`](super::api).

use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::PrivateKeyDer;
use rustls::pki_types::pem::PemObject;
use rustls::server::{ServerConfig, WebPkiClientVerifier};
use rustls::version::{TLS12, TLS13};
use rustls::{RootCertStore, SupportedProtocolVersion};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;

use super::fault::Fault;
use super::http::{self, NoRequest};
use super::network::{KmeState, Shared};
use super::pki::Pair;
use super::{Error, api};
use crate::{subject, tls};

/// Open connections of one KME.
const MAX_CONNECTIONS: usize = 256;
const HANDSHAKE_TIME: Duration = Duration::from_secs(10);
const IDLE_TIME: Duration = Duration::from_secs(60);

pub(super) fn tls_config(
    ca: &str,
    pair: &Pair,
    tls12_only: bool,
) -> Result<Arc<ServerConfig>, Error> {
    let wrong = |e: &dyn std::fmt::Display| Error::Certificates(e.to_string());
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
        .map(Arc::new)
        .map_err(|e| wrong(&e))
}

/// Serves until it is aborted, and takes its connections with it then.
pub(super) async fn serve(
    listener: TcpListener,
    tls: Arc<ServerConfig>,
    shared: Arc<Shared>,
    kme: Arc<KmeState>,
) {
    let acceptor = TlsAcceptor::from(tls);
    let permits = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    let mut connections = JoinSet::new();
    loop {
        while connections.try_join_next().is_some() {}
        let Ok(permit) = Arc::clone(&permits).acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let fault = kme.faults().for_connection();
        if fault == Some(Fault::HandshakeDropped) {
            continue;
        }
        let (acceptor, shared, kme) = (acceptor.clone(), Arc::clone(&shared), Arc::clone(&kme));
        connections.spawn(async move {
            let _permit = permit;
            // A client that breaks off is its own business.
            let _ = match fault {
                Some(_) => refuse(stream).await,
                None => connection(stream, &acceptor, &shared, &kme).await,
            };
        });
    }
}

async fn connection(
    stream: TcpStream,
    acceptor: &TlsAcceptor,
    shared: &Shared,
    kme: &KmeState,
) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let accepted = acceptor.accept(stream).into_fallible();
    let Ok(accepted) = tokio::time::timeout(HANDSHAKE_TIME, accepted).await else { return Ok(()) };
    let mut stream = match accepted {
        Ok(stream) => stream,
        Err((_, stream)) => return linger(stream).await,
    };
    let caller = stream
        .get_ref()
        .1
        .peer_certificates()
        .and_then(|chain| subject::common_name(chain.first()?));
    let mut buffer = Vec::new();
    loop {
        let read = http::read(&mut stream, &mut buffer);
        let request = match tokio::time::timeout(IDLE_TIME, read).await {
            Ok(Ok(request)) => request,
            Ok(Err(NoRequest::Refused(status))) => {
                let answer = api::error(status, "the request cannot be read", Vec::new());
                http::write(&mut stream, &answer, None).await?;
                return stream.shutdown().await;
            }
            Ok(Err(NoRequest::Closed)) | Err(_) => return stream.shutdown().await,
        };
        let met = kme.faults().for_request(api::method(&request));
        let fault = met.fault;
        let answer = api::answer(shared, kme, caller.as_deref(), &request, fault.as_ref());
        tokio::time::sleep(met.delay).await;
        match fault {
            Some(Fault::Silence) => return std::future::pending().await,
            Some(Fault::ResetAfterRequest) => {
                let _ = stream.get_ref().0.set_zero_linger();
                return Ok(());
            }
            _ => {}
        }
        if !http::write(&mut stream, &answer, fault.as_ref()).await? {
            if fault == Some(Fault::LyingLength) {
                return std::future::pending().await;
            }
            return stream.shutdown().await;
        }
    }
}

/// Refuses the handshake as a TLS server does that shares nothing with its client: after the
/// ClientHello, with a fatal alert (RFC 8446, 6.2).
async fn refuse(mut stream: TcpStream) -> std::io::Result<()> {
    const HANDSHAKE_FAILURE: [u8; 7] = [21, 3, 3, 0, 2, 2, 40];
    let mut first = [0];
    let read = stream.read(&mut first);
    if !matches!(tokio::time::timeout(HANDSHAKE_TIME, read).await, Ok(Ok(1))) {
        return Ok(());
    }
    stream.write_all(&HANDSHAKE_FAILURE).await?;
    linger(stream).await
}

/// After a refused handshake: reads what the client has already sent, because closing over unread
/// bytes resets the connection, and the client may then never see the alert that says why.
async fn linger(mut stream: TcpStream) -> std::io::Result<()> {
    stream.shutdown().await?;
    let mut sink = [0; 4096];
    let drain = async {
        while stream.read(&mut sink).await? > 0 {}
        std::io::Result::Ok(())
    };
    tokio::time::timeout(Duration::from_secs(1), drain).await.unwrap_or(Ok(()))
}
