//! A KME that follows a script with keys that are known beforehand, beside the simulated ones.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use etsi_qkd014::ClientBuilder;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ServerConfig, ServerConnection, StreamOwned};

use crate::kmes::{self, Kmes};

/// Returns the key of a number in a script.
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

/// Returns the key_ID of this number.
pub(crate) fn key_id(number: u64) -> String {
    format!("00000000-0000-4000-8000-{number:012x}")
}

impl Kmes {
    /// Returns settings for the KME with the script.
    pub(crate) fn scripted(&self) -> ClientBuilder {
        self.settings("sae-a", 2)
    }
}

/// In the child: serves until standard input ends. Elsewhere: does nothing.
pub(crate) fn serve_if_asked() {
    kmes::serve_if_asked(1_000, |dir| Some(listen(dir)));
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
            // An error ends the connection, as the client or the script intends.
            std::thread::spawn(move || answer(stream));
        }
    });
    url
}

type Stream = StreamOwned<ServerConnection, TcpStream>;

/// Answers requests. The SAE ID in the path selects the script.
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

/// Sends bytes: each call is a TLS record of its own.
fn send(stream: &mut Stream, bytes: &[u8]) -> std::io::Result<()> {
    stream.write_all(bytes)?;
    stream.flush()
}

enum Request {
    Status { script: String },
    Keys { script: String, keys: Vec<u64> },
}

/// Reads a request. Returns the script, and the numbers of the keys to answer with. They are the same in each call,
/// unless the script asks for new ones; then the next numbers follow.
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
