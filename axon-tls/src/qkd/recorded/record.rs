//! Makes the recordings. To make them again, with the `openssl` of `TEST_OPENSSL`:
//! `cargo test -p axon-tls --lib qkd::recorded::record -- --ignored`.

use std::fmt::Write as _;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::ops::DerefMut;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use base64::Engine as _;
use rustls_axon::{ConnectionCommon, SideData, Stream};
use serde_json::{Value, json};

use super::{FROM_OPENSSL, FROM_US, LABEL, client, psk, server};
use crate::Cipher;

const HOW: &str = "Connections over TCP between axon-tls (qkd, psk_ke), whose random bytes were \
    40 41 42 ... for every value, and `openssl s_server -nocert` or `openssl s_client` with \
    -tls1_3 -allow_no_dhe_kex. The pre-shared key is the one of tests/vectors/psk.json for key_ID \
    bc490419-7d60-487f-adc1-4ddcc177c139, sae-client and sae-server: given to openssl with -psk \
    for SHA-256, and in a session file (-psk_session) for SHA-384. A flight is all that one end \
    sent before the other did, in hexadecimal, with the records' headers. Each end sent one line \
    after the handshake, axon first. `exporter` is what openssl printed for -keymatexport \
    EXPORTER-axon-test -keymatexportlen 32.";

/// A connection that records the bytes that pass through it.
struct Tap {
    socket: TcpStream,
    flights: Vec<(bool, Vec<u8>)>,
}

impl Tap {
    fn new(socket: TcpStream) -> Self {
        socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        Self { socket, flights: Vec::new() }
    }

    fn keep(&mut self, ours: bool, bytes: &[u8]) {
        match self.flights.last_mut() {
            Some((whose, flight)) if *whose == ours => flight.extend_from_slice(bytes),
            _ => self.flights.push((ours, bytes.to_vec())),
        }
    }
}

impl Read for Tap {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let len = self.socket.read(buf)?;
        self.keep(false, &buf[..len]);
        Ok(len)
    }
}

impl Write for Tap {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        let len = self.socket.write(buf)?;
        self.keep(true, &buf[..len]);
        Ok(len)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.socket.flush()
    }
}

struct OpenSsl(Child);

impl OpenSsl {
    fn start(program: &str, cipher: Cipher, command: &[&str]) -> Self {
        let vector = vector(cipher);
        let [identity, secret] = ["identity", "psk"].map(|name| vector[name].as_str().unwrap());
        let mut args = command.to_vec();
        args.extend(["-tls1_3", "-allow_no_dhe_kex", "-psk_identity", identity]);
        args.extend(["-keymatexport", LABEL, "-keymatexportlen", "32"]);
        let session;
        match cipher {
            Cipher::ChaCha20Poly1305 => {
                args.extend(["-psk", secret, "-ciphersuites", "TLS_CHACHA20_POLY1305_SHA256"]);
            }
            Cipher::Aes256Gcm => {
                session = session_file(secret);
                args.extend(["-psk_session", session.to_str().unwrap()]);
                args.extend(["-ciphersuites", "TLS_AES_256_GCM_SHA384"]);
            }
        }
        let child = Command::new(program)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        Self(child)
    }

    /// Returns the rest of the first output line that contains `part`, after `part`.
    fn line(&mut self, part: &str) -> String {
        // the buffer has one byte, so that the bytes after the line remain for the next call
        let mut output = BufReader::with_capacity(1, self.0.stdout.as_mut().unwrap());
        let mut line = String::new();
        loop {
            line.clear();
            assert!(output.read_line(&mut line).unwrap() > 0, "openssl ended before {part:?}");
            if let Some((_, rest)) = line.split_once(part) {
                return rest.trim().to_owned();
            }
        }
    }
}

impl Drop for OpenSsl {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn vector(cipher: Cipher) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors/psk.json");
    let vectors: Vec<Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    let psk = psk(cipher);
    let identity = std::str::from_utf8(psk.identity()).unwrap();
    let hash = if cipher == Cipher::Aes256Gcm { "SHA384" } else { "SHA256" };
    let is_ours = |vector: &Value| {
        vector["identity"] == identity
            && vector["hash"] == hash
            && vector["server_sae"] == "sae-server"
    };
    vectors.into_iter().find(is_ours).unwrap()
}

/// Writes an `SSL_SESSION` in PEM: version, TLS 1.3, TLS_AES_256_GCM_SHA384, no session ID, and the
/// key. It was made at second 0 and is valid for 127 seconds, which has no effect on a pre-shared
/// key.
fn session_file(secret: &str) -> PathBuf {
    let mut body = vec![2, 1, 1, 2, 2, 3, 4, 4, 2, 0x13, 0x02, 4, 0, 4, 48];
    body.extend(super::from_hex(&Value::from(secret)));
    body.extend([0xa1, 3, 2, 1, 0, 0xa2, 3, 2, 1, 0x7f]);
    let der = [&[0x30, body.len() as u8], &body[..]].concat();
    let text = base64::engine::general_purpose::STANDARD.encode(der);
    let (first, second) = text.split_at(64);
    let label = "SSL SESSION PARAMETERS-----";
    let path = std::env::temp_dir().join(format!("axon-record-{}.pem", std::process::id()));
    let pem = format!("-----BEGIN {label}\n{first}\n{second}\n-----END {label}\n");
    std::fs::write(&path, pem).unwrap();
    path
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").unwrap();
        text
    })
}

fn connection<S: SideData>(
    mut conn: impl DerefMut<Target = ConnectionCommon<S>>,
    socket: TcpStream,
    openssl: &mut OpenSsl,
    (role, cipher): (&str, Cipher),
) -> Value {
    let mut tap = Tap::new(socket);
    while conn.is_handshaking() {
        conn.complete_io(&mut tap).unwrap();
    }
    let mut stream = Stream::new(&mut conn, &mut tap);
    stream.write_all(FROM_US).unwrap();
    let exporter = openssl.line("Keying material: ").to_lowercase();
    openssl.line(std::str::from_utf8(FROM_US).unwrap().trim_end());
    openssl.0.stdin.as_mut().unwrap().write_all(FROM_OPENSSL).unwrap();
    let mut answer = [0; FROM_OPENSSL.len()];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(answer, FROM_OPENSSL);

    let name = |ours: bool| if ours { "axon" } else { "openssl" };
    let flights: Vec<_> = tap
        .flights
        .iter()
        .map(|(ours, bytes)| json!({ "from": name(*ours), "bytes": hex(bytes) }))
        .collect();
    let cipher = format!("{cipher:?}");
    json!({ "our_role": role, "cipher": cipher, "exporter": exporter, "flights": flights })
}

#[test]
#[ignore = "makes the recordings anew"]
fn record() {
    let program = std::env::var("TEST_OPENSSL").unwrap_or_else(|_| "openssl".to_owned());
    let version = Command::new(&program).arg("version").output().unwrap().stdout;
    let mut recordings = Vec::new();
    for cipher in Cipher::ALL {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let addr = listener.local_addr().unwrap().to_string();
        let mut openssl = OpenSsl::start(&program, cipher, &["s_client", "-connect", &addr]);
        let socket = listener.accept().unwrap().0;
        recordings.push(connection(server(cipher), socket, &mut openssl, ("server", cipher)));

        let addr = {
            let free = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
            free.local_addr().unwrap().to_string()
        };
        let command = ["s_server", "-nocert", "-accept", &addr];
        let mut openssl = OpenSsl::start(&program, cipher, &command);
        let socket = loop {
            match TcpStream::connect(&addr) {
                Ok(socket) => break socket,
                Err(_) => std::thread::sleep(Duration::from_millis(20)),
            }
        };
        recordings.push(connection(client(cipher), socket, &mut openssl, ("client", cipher)));
    }
    let file = json!({
        "how": HOW,
        "openssl": String::from_utf8(version).unwrap().trim(),
        "recordings": recordings,
    });
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/qkd/recorded/openssl.json");
    std::fs::write(path, serde_json::to_string_pretty(&file).unwrap() + "\n").unwrap();
}
