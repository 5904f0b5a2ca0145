//! An SAE that speaks plain TLS, so that this crate's client corrects nothing on the way.

#![allow(dead_code, reason = "each test program uses its part")]

use std::net::SocketAddr;
use std::sync::Arc;

use etsi_qkd014::sim::{Network, Sae};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

/// Opens a TLS connection to the KME of an SAE, with that SAE's certificate.
pub(crate) async fn connect(network: &Network, sae: &str) -> Connection {
    let sae = network.sae(sae).unwrap();
    let addr = network.kme(sae.kme_id()).unwrap().addr();
    open(&connector(sae), addr).await.unwrap()
}

/// Returns a TLS connector with an SAE's certificate and CA.
pub(crate) fn connector(sae: &Sae) -> TlsConnector {
    with_pair(sae.ca_pem(), sae.cert_pem(), sae.key_pem())
}

pub(crate) fn with_pair(ca: &str, cert: &str, key: &str) -> TlsConnector {
    let certificate = |pem: &str| CertificateDer::from_pem_slice(pem.as_bytes()).unwrap();
    let mut roots = rustls::RootCertStore::empty();
    roots.add(certificate(ca)).unwrap();
    let key = PrivateKeyDer::from_pem_slice(key.as_bytes()).unwrap();
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let config = rustls::ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_client_auth_cert(vec![certificate(cert)], key)
        .unwrap();
    TlsConnector::from(Arc::new(config))
}

pub(crate) async fn open(tls: &TlsConnector, addr: SocketAddr) -> std::io::Result<Connection> {
    let stream = TcpStream::connect(addr).await?;
    let stream = tls.connect(ServerName::from(addr.ip()), stream).await?;
    Ok(Connection { stream, unread: Vec::new() })
}

pub(crate) struct Connection {
    pub(crate) stream: TlsStream<TcpStream>,
    unread: Vec<u8>,
}

pub(crate) struct Answer {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: Value,
}

impl Connection {
    pub(crate) async fn send(&mut self, request: &str) -> std::io::Result<()> {
        self.stream.write_all(request.as_bytes()).await?;
        self.stream.flush().await
    }

    /// Reads the next answer; `None` if the connection is closed before one.
    pub(crate) async fn answer(&mut self) -> Option<Answer> {
        let (head, length) = loop {
            let text = String::from_utf8_lossy(&self.unread);
            if let Some((head, _)) = text.split_once("\r\n\r\n") {
                let header =
                    |line: &str| line.strip_prefix("Content-Length: ")?.parse::<usize>().ok();
                break (head.to_owned(), head.lines().find_map(header).unwrap_or(0));
            }
            if !matches!(self.stream.read_buf(&mut self.unread).await, Ok(1..)) {
                return None;
            }
        };
        let total = head.len() + 4 + length;
        while self.unread.len() < total {
            assert!(self.stream.read_buf(&mut self.unread).await.unwrap() > 0, "cut");
        }
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        let body = serde_json::from_slice(&self.unread[head.len() + 4..total]);
        self.unread.drain(..total);
        Some(Answer { status, head, body: body.unwrap_or_default() })
    }
}

/// Returns a POST as most clients write it.
pub(crate) fn post(path: &str, body: &str) -> String {
    let length = body.len();
    format!(
        "POST /api/v1/keys/{path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n\
         Content-Length: {length}\r\n\r\n{body}"
    )
}

pub(crate) fn get(path: &str) -> String {
    format!("GET /api/v1/keys/{path} HTTP/1.1\r\nHost: x\r\n\r\n")
}
