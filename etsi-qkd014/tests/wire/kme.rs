//! A KME whose answers a test chooses: wiremock, which speaks plain HTTP, behind mutual TLS.
//!
//! The client cannot speak plain HTTP, not even for a test. The mock is behind a port that ends TLS as a KME does: with
//! a KME's certificate, and only for an SAE of the same CA.

use std::net::SocketAddr;
use std::sync::Arc;

use etsi_qkd014::sim::{Network, Sae};
use etsi_qkd014::{ClientBuilder, RetryPolicy};
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{CertificateDer, PrivateKeyDer};
use tokio::io::copy_bidirectional;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;
use wiremock::matchers::any;
use wiremock::{Mock, MockServer, ResponseTemplate};

pub(crate) const ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
pub(crate) const KEY: &str = "wHHVxRwDJs3/bXd38GHP3oe4svTuRpZS0yCC7x4Ly+s=";

/// Returns a container with one key.
pub(crate) fn container() -> String {
    format!(r#"{{"keys":[{{"key_ID":"{ID}","key":"{KEY}"}}]}}"#)
}

/// Returns an answer of status 200 in JSON.
pub(crate) fn ok(body: impl Into<Vec<u8>>) -> ResponseTemplate {
    ResponseTemplate::new(200).set_body_raw(body, "application/json")
}

pub(crate) struct Kme {
    pub(crate) mock: MockServer,
    network: Network,
    url: String,
    front: JoinHandle<()>,
}

impl Kme {
    /// Starts a KME that answers 404 to every request that no mock matches.
    pub(crate) async fn start() -> Self {
        let network = Network::builder()
            .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
            .start()
            .await
            .unwrap();
        let dir = tempfile::tempdir().unwrap();
        network.write_files(dir.path()).unwrap();
        let mock = MockServer::start().await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("https://{}", listener.local_addr().unwrap());
        let front = tokio::spawn(front(
            listener,
            acceptor(dir.path(), network.sae("sae-a").unwrap()),
            *mock.address(),
        ));
        Self { mock, network, url, front }
    }

    /// Starts a KME that gives this answer, of status 200 in JSON, to every request.
    pub(crate) async fn answering(body: &[u8]) -> Self {
        let kme = Self::start().await;
        kme.mount(ok(body)).await;
        kme
    }

    /// Gives this answer to everything.
    pub(crate) async fn mount(&self, answer: ResponseTemplate) {
        Mock::given(any()).respond_with(answer).mount(&self.mock).await;
    }

    /// Returns settings of a client that calls once.
    pub(crate) fn client(&self) -> ClientBuilder {
        self.network.client_builder("sae-a").kme_url(&self.url).retry(RetryPolicy::none())
    }
}

impl Drop for Kme {
    fn drop(&mut self) {
        self.front.abort();
    }
}

fn acceptor(dir: &std::path::Path, sae: &Sae) -> TlsAcceptor {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(sae.ca_pem().as_bytes()).unwrap()).unwrap();
    let provider = Arc::new(default_provider());
    let verifier =
        WebPkiClientVerifier::builder_with_provider(roots.into(), Arc::clone(&provider)).build();
    let cert = CertificateDer::from_pem_file(dir.join("kme-a.crt")).unwrap();
    let key = PrivateKeyDer::from_pem_file(dir.join("kme-a.key")).unwrap();
    let tls = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_client_cert_verifier(verifier.unwrap())
        .with_single_cert(vec![cert], key)
        .unwrap();
    TlsAcceptor::from(Arc::new(tls))
}

/// Ends TLS and hands the bytes on.
async fn front(listener: TcpListener, tls: TlsAcceptor, mock: SocketAddr) {
    loop {
        let (stream, _) = listener.accept().await.unwrap();
        let tls = tls.clone();
        tokio::spawn(async move {
            let mut outside = tls.accept(stream).await?;
            let mut inside = TcpStream::connect(mock).await?;
            copy_bidirectional(&mut outside, &mut inside).await
        });
    }
}
