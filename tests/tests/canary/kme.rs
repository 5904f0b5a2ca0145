//! KMEs in a process of their own, since a KME's memory is full of keys: simulated ones, and one
//! that follows a script with keys that are known beforehand.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use etsi_qkd014::sim::Network;
use etsi_qkd014::{Client, ClientBuilder, RetryPolicy};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, ServerConnection, StreamOwned};

/// Tells the test binary that it is to be the KMEs, and where to write their certificates.
const VARIABLE: &str = "AXON_CANARY_KMES";

/// The key of a number, as the script has it.
pub(crate) fn key(number: u64) -> [u8; 32] {
    let mut state = number.wrapping_add(0x51_7c_c1_b7_27_22_0a_95);
    let mut key = [0; 32];
    for part in key.chunks_exact_mut(8) {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = state;
        mixed = (mixed ^ mixed >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        part.copy_from_slice(&(mixed ^ mixed >> 31).to_be_bytes());
    }
    key
}

/// Its key_ID.
pub(crate) fn key_id(number: u64) -> String {
    format!("00000000-0000-4000-8000-{number:012x}")
}

/// The KMEs, which end with this.
pub(crate) struct Kmes {
    child: Child,
    _stdin: ChildStdin,
    dir: tempfile::TempDir,
    urls: Vec<String>,
}

impl Kmes {
    pub(crate) fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kmes", "--nocapture"])
            .env(VARIABLE, dir.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let urls = lines
            .map_while(Result::ok)
            .find_map(|line| Some(line.split_once("KMEs: ")?.1.to_owned()))
            .expect("the child must say where its KMEs are");
        let urls = urls.split(' ').map(str::to_owned).collect();
        Self { child, _stdin: stdin, dir, urls }
    }

    /// Settings for the simulated KME of `sae`.
    pub(crate) fn simulated(&self, sae: &str) -> ClientBuilder {
        self.settings(sae, &self.urls[usize::from(sae == "sae-b")])
    }

    /// A file that the KMEs wrote, as `sae-a.key`.
    pub(crate) fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Settings for the KME with the script.
    pub(crate) fn scripted(&self) -> ClientBuilder {
        self.settings("sae-a", &self.urls[2])
    }

    fn settings(&self, sae: &str, url: &str) -> ClientBuilder {
        Client::builder()
            .kme_url(url)
            .ca_file(self.file("ca.pem"))
            .sae_cert_file(self.file(&format!("{sae}.crt")))
            .sae_key_file(self.file(&format!("{sae}.key")))
            .retry(RetryPolicy::none())
    }
}

impl Drop for Kmes {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// In the child: serves until standard input ends. Elsewhere: nothing.
pub(crate) fn serve_if_asked() {
    let Some(dir) = std::env::var_os(VARIABLE).map(PathBuf::from) else { return };
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .max_keys_per_request(1_000)
        .start();
    let network = runtime.block_on(network).unwrap();
    network.write_files(&dir).unwrap();
    let script = listen(&dir);
    let urls = network.kmes().iter().map(|kme| kme.url()).chain([&*script]);
    let urls = urls.collect::<Vec<_>>().join(" ");
    std::io::stdout().write_all(format!("KMEs: {urls}\n").as_bytes()).unwrap();
    axon_tests::end_with_stdin();
}

fn listen(dir: &Path) -> String {
    let cert = CertificateDer::from_pem_file(dir.join("kme-a.crt")).unwrap();
    let key = PrivateKeyDer::from_pem_file(dir.join("kme-a.key")).unwrap();
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let tls = ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![cert], key)
        .unwrap();
    let tls = Arc::new(tls);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let connection = ServerConnection::new(Arc::clone(&tls)).unwrap();
            let stream = StreamOwned::new(connection, stream.unwrap());
            // An error ends the connection, as the client wanted or the script says.
            std::thread::spawn(move || answer(stream));
        }
    });
    url
}

type Stream = StreamOwned<ServerConnection, TcpStream>;

/// Answers requests. The SAE ID in the path says how.
fn answer(mut stream: Stream) -> std::io::Result<()> {
    stream.sock.set_nodelay(true)?;
    loop {
        let (script, body) = match request(&mut stream)? {
            Request::Status { script } => ("whole".to_owned(), status(&script)),
            Request::Keys { script, keys } => (script, container(&keys)),
        };
        let length = body.len();
        let mut head = "HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n".to_owned();
        match script.as_str() {
            "chunked" => {
                head.push_str("Transfer-Encoding: chunked\r\n\r\n");
                send(&mut stream, head.as_bytes())?;
                for piece in body.as_bytes().chunks(700) {
                    let chunk = format!("{:x}\r\n", piece.len());
                    send(&mut stream, &[chunk.as_bytes(), piece, b"\r\n"].concat())?;
                }
                send(&mut stream, b"0\r\n\r\n")?;
            }
            "cut" | "drip" | "new-drip" => {
                head.push_str(&format!("Content-Length: {length}\r\n\r\n"));
                head.push_str(&body[..length * 2 / 3]);
                send(&mut stream, head.as_bytes())?;
                if script == "cut" {
                    return Ok(());
                }
                for byte in body.as_bytes()[length * 2 / 3..].chunks(1) {
                    std::thread::sleep(Duration::from_millis(50));
                    send(&mut stream, byte)?;
                }
            }
            other => {
                let body = match other {
                    "malformed" => &body[..length - 1],
                    _ => &body,
                };
                if other == "failing" {
                    head = head.replace("200 OK", "500 Internal Server Error");
                }
                head.push_str(&format!("Content-Length: {}\r\n\r\n{body}", body.len()));
                send(&mut stream, head.as_bytes())?;
            }
        }
    }
}

/// Each call is a record of its own.
fn send(stream: &mut Stream, bytes: &[u8]) -> std::io::Result<()> {
    stream.write_all(bytes)?;
    stream.flush()
}

enum Request {
    Status { script: String },
    Keys { script: String, keys: Vec<u64> },
}

/// The script, and the numbers of the keys to answer with: the same in each call, or where the
/// script asks for new ones, those that follow.
fn request(stream: &mut Stream) -> std::io::Result<Request> {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte)?;
        head.extend_from_slice(&byte);
    }
    let head = String::from_utf8(head).map_err(std::io::Error::other)?.to_ascii_lowercase();
    let script = head.split('/').nth(4).unwrap_or_default().to_owned();
    if head.starts_with("get ") {
        return Ok(Request::Status { script });
    }
    let length = head
        .lines()
        .find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok())
        .unwrap_or(0);
    let mut body = vec![0; length];
    stream.read_exact(&mut body)?;
    let body: serde_json::Value = serde_json::from_slice(&body)?;
    let number = match body["key_IDs"].as_array() {
        Some(ids) => ids.len() as u64,
        None => body["number"].as_u64().unwrap_or(1),
    };
    let first =
        if script.starts_with("new") { NEXT.fetch_add(number, Ordering::SeqCst) } else { 0 };
    Ok(Request::Keys { script, keys: (first..first + number).collect() })
}

fn status(slave: &str) -> String {
    format!(
        r#"{{"source_KME_ID":"kme-a","target_KME_ID":"kme-b","master_SAE_ID":"sae-a",
        "slave_SAE_ID":"{slave}","key_size":256,"stored_key_count":100000,"max_key_count":100000,
        "max_key_per_request":1000,"max_key_size":256,"min_key_size":256,"max_SAE_ID_count":0}}"#
    )
}

fn container(keys: &[u64]) -> String {
    let keys: Vec<_> = keys
        .iter()
        .map(|number| {
            let key = STANDARD.encode(key(*number));
            format!(r#"{{"key_ID":"{}","key":"{key}"}}"#, key_id(*number))
        })
        .collect();
    format!(r#"{{"keys":[{}]}}"#, keys.join(","))
}
