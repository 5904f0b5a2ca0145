//! A KME whose status and key_IDs a test chooses, for answers that no honest KME gives. It uses real TLS.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use base64::prelude::{BASE64_STANDARD, Engine};
use etsi_qkd014::sim::{Layout, Pki};
use etsi_qkd014::{Client, RetryPolicy};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, crypto::aws_lc_rs};
use serde_json::json;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;

/// The answers of the KME.
pub(crate) struct Script {
    /// `stored_key_count` and `max_key_per_request` of its status.
    pub(crate) stock: (u64, u64),
    /// The key_ID of the n-th key that it gives.
    pub(crate) key_id: fn(u64) -> String,
}

pub(crate) struct Scripted {
    client: Client,
    pub(crate) calls: Arc<AtomicU64>,
    pub(crate) keys: Arc<AtomicU64>,
    task: tokio::task::JoinHandle<()>,
}

impl Scripted {
    pub(crate) fn client(&self) -> Client {
        self.client.clone()
    }
}

impl Drop for Scripted {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Returns the n-th UUID.
pub(crate) fn uuid(n: u64) -> String {
    format!("00000000-0000-4000-8000-{n:012x}")
}

pub(crate) async fn start(script: Script) -> Scripted {
    let mut layout = Layout::default();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let addr = listener.local_addr().unwrap();
    for (kme, bind, sae) in [("kme-a", addr, "sae-a"), ("kme-b", addr, "sae-b")] {
        layout.sites.push(site(kme, bind, sae));
    }
    let dir = tempfile::tempdir().unwrap();
    Pki::create(&layout).unwrap().write(dir.path()).unwrap();
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    let client = Client::builder()
        .kme_url(format!("https://{addr}"))
        .ca(read("ca.pem"))
        .sae_cert(read("sae-a.crt"))
        .sae_key(read("sae-a.key"))
        .retry(RetryPolicy::none())
        .build()
        .unwrap();
    let tls = TlsAcceptor::from(Arc::new(server(dir.path())));
    let (calls, keys) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let counts = (Arc::clone(&calls), Arc::clone(&keys));
    let script = Arc::new(script);
    let task = tokio::spawn(async move {
        loop {
            let Ok((stream, _)) = listener.accept().await else { return };
            tokio::spawn(serve(stream, tls.clone(), Arc::clone(&script), counts.clone()));
        }
    });
    Scripted { client, calls, keys, task }
}

pub(crate) fn site(kme: &str, bind: SocketAddr, sae: &str) -> etsi_qkd014::sim::Site {
    serde_json::from_value(json!({ "kme": kme, "bind": bind, "saes": [sae] })).unwrap()
}

fn server(dir: &Path) -> ServerConfig {
    let chain = vec![CertificateDer::from_pem_file(dir.join("kme-a.crt")).unwrap()];
    let key = PrivateKeyDer::from_pem_file(dir.join("kme-a.key")).unwrap();
    ServerConfig::builder_with_provider(Arc::new(aws_lc_rs::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .unwrap()
}

async fn serve(
    stream: TcpStream,
    tls: TlsAcceptor,
    script: Arc<Script>,
    (calls, keys): (Arc<AtomicU64>, Arc<AtomicU64>),
) {
    let Ok(stream) = tls.accept(stream).await else { return };
    let mut stream = BufReader::new(stream);
    loop {
        let (mut first, mut length) = (String::new(), 0);
        loop {
            let mut line = String::new();
            if !matches!(stream.read_line(&mut line).await, Ok(1..)) {
                return;
            }
            let line = line.trim().to_ascii_lowercase();
            if line.is_empty() {
                break;
            }
            if let Some(value) = line.strip_prefix("content-length:") {
                length = value.trim().parse().unwrap();
            }
            if first.is_empty() {
                first = line;
            }
        }
        let mut body = vec![0; length];
        stream.read_exact(&mut body).await.unwrap();
        let answer = if first.contains("/enc_keys") {
            calls.fetch_add(1, Ordering::Relaxed);
            let asked: serde_json::Value = serde_json::from_slice(&body).unwrap();
            let number = asked["number"].as_u64().unwrap_or(1);
            let from = keys.fetch_add(number, Ordering::Relaxed);
            let key = |n: u64| {
                let mut secret = [0x5a; 32];
                secret[..8].copy_from_slice(&n.to_le_bytes());
                json!({ "key_ID": (script.key_id)(n), "key": BASE64_STANDARD.encode(secret) })
            };
            json!({ "keys": (from..from + number).map(key).collect::<Vec<_>>() })
        } else {
            json!({
                "source_KME_ID": "kme-a", "target_KME_ID": "kme-b",
                "master_SAE_ID": "sae-a", "slave_SAE_ID": "sae-b",
                "key_size": 256, "stored_key_count": script.stock.0, "max_key_count": 0,
                "max_key_per_request": script.stock.1, "max_key_size": 256,
                "min_key_size": 256, "max_SAE_ID_count": 0,
            })
        };
        let answer = answer.to_string();
        let head = format!(
            "HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
            answer.len()
        );
        if stream.write_all((head + &answer).as_bytes()).await.is_err()
            || stream.flush().await.is_err()
        {
            return;
        }
    }
}
