//! A TLS server that answers each request with bytes of the test's own.

use std::io::{Read, Write};
use std::net::TcpListener;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use etsi_qkd014::sim::Network;
use etsi_qkd014::{ClientBuilder, RetryPolicy};
use rustls::crypto::aws_lc_rs::default_provider;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, ServerConnection, StreamOwned};

pub(crate) const ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
pub(crate) const KEY: &str = "wHHVxRwDJs3/bXd38GHP3oe4svTuRpZS0yCC7x4Ly+s=";

/// Returns a container with one key.
pub(crate) fn container() -> String {
    format!(r#"{{"keys":[{{"key_ID":"{ID}","key":"{KEY}"}}]}}"#)
}

/// Returns a whole answer, with further lines in its head.
pub(crate) fn answer(status: &str, more: &str, body: &[u8]) -> Vec<u8> {
    let length = body.len();
    let head = format!("HTTP/1.1 {status}\r\n{more}Content-Length: {length}\r\n\r\n");
    [head.as_bytes(), body].concat()
}

/// Returns an answer of status 200 in JSON.
pub(crate) fn ok(body: &[u8]) -> Vec<u8> {
    answer("200 OK", "Content-Type: application/json\r\n", body)
}

/// The action of the server after its answer.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Then {
    /// Waits for the next request.
    KeepAlive,
    /// Ends TLS, and then TCP.
    Close,
    /// Ends TCP without a word.
    CutOff,
    /// Sends nothing more, and does not end.
    Stall,
    /// Sends the last bytes over and over.
    Repeat(usize),
}

pub(crate) struct Server {
    settings: Box<dyn Fn() -> ClientBuilder>,
    connections: Arc<AtomicUsize>,
    heads: Arc<Mutex<Vec<String>>>,
}

impl Server {
    pub(crate) async fn start(answer: Vec<u8>, then: Then) -> Self {
        let network = Network::builder()
            .strict()
            .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
            .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
            .start()
            .await
            .unwrap();
        let dir = tempfile::tempdir().unwrap();
        network.write_files(dir.path()).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("https://{}", listener.local_addr().unwrap());
        let tls = tls(dir.path());
        let connections = Arc::<AtomicUsize>::default();
        let heads = Arc::<Mutex<Vec<String>>>::default();
        let (counter, seen) = (Arc::clone(&connections), Arc::clone(&heads));
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let connection = ServerConnection::new(Arc::clone(&tls)).unwrap();
                let stream = StreamOwned::new(connection, stream.unwrap());
                let (answer, counter, seen) = (answer.clone(), counter.clone(), seen.clone());
                std::thread::spawn(move || serve(stream, &answer, then, &counter, &seen));
            }
        });
        let settings =
            move || network.client_builder("sae-a").kme_url(&url).retry(RetryPolicy::none());
        Self { settings: Box::new(settings), connections, heads }
    }

    /// Returns settings of a client that calls once.
    pub(crate) fn client(&self) -> ClientBuilder {
        (self.settings)()
    }

    pub(crate) fn connections(&self) -> usize {
        self.connections.load(Ordering::SeqCst)
    }

    /// Returns the heads of the requests, in lower case.
    pub(crate) fn heads(&self) -> Vec<String> {
        self.heads.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

fn tls(dir: &std::path::Path) -> Arc<ServerConfig> {
    let cert = CertificateDer::from_pem_file(dir.join("kme-a.crt")).unwrap();
    let key = PrivateKeyDer::from_pem_file(dir.join("kme-a.key")).unwrap();
    let tls = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![cert], key)
        .unwrap();
    Arc::new(tls)
}

type Stream = StreamOwned<ServerConnection, std::net::TcpStream>;

/// Serves a connection. An error ends it: the client has gone.
fn serve(
    mut stream: Stream,
    answer: &[u8],
    then: Then,
    connections: &AtomicUsize,
    heads: &Mutex<Vec<String>>,
) -> std::io::Result<()> {
    let mut is_first = true;
    loop {
        let head = request(&mut stream)?;
        heads.lock().unwrap_or_else(PoisonError::into_inner).push(head);
        if std::mem::take(&mut is_first) {
            connections.fetch_add(1, Ordering::SeqCst);
        }
        stream.write_all(answer)?;
        stream.flush()?;
        match then {
            Then::KeepAlive => {}
            Then::Close => {
                stream.conn.send_close_notify();
                return stream.flush();
            }
            Then::CutOff => return Ok(()),
            Then::Stall => loop {
                std::thread::park();
            },
            Then::Repeat(last) => loop {
                stream.write_all(&answer[answer.len() - last..])?;
                stream.flush()?;
            },
        }
    }
}

fn request(stream: &mut Stream) -> std::io::Result<String> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte)?;
        head.push(byte[0]);
    }
    let head = String::from_utf8(head).map_err(std::io::Error::other)?.to_ascii_lowercase();
    let length = head.lines().find_map(|line| line.strip_prefix("content-length:"));
    let length = length.map_or(0, |length| length.trim().parse().unwrap());
    stream.read_exact(&mut vec![0; length])?;
    Ok(head)
}
