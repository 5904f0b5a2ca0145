//! psk_ke against OpenSSL, as real processes.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::ops::{Deref, DerefMut};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use axon_tls::qkd::{Psk, PskResolver, client_config, derive_psk, negotiated, server_config};
use axon_tls::{Cipher, KeyExchange, Negotiated, PskKex};
use rustls_axon::{ClientConnection, ConnectionCommon, ServerConnection, SideData, Stream};

const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";

/// The PSK of the vector with SHA-256 for `KEY_ID`, client `sae-client` and server `sae-server`:
/// what OpenSSL gets was not derived by the code under test.
fn psk_from_vectors() -> (String, String) {
    let vectors: Vec<serde_json::Value> =
        serde_json::from_str(include_str!("vectors/psk.json")).unwrap();
    let vector = vectors
        .iter()
        .find(|vector| {
            vector["key_id"] == KEY_ID
                && vector["client_sae"] == "sae-client"
                && vector["hash"] == "SHA256"
        })
        .unwrap();
    let text = |name: &str| vector[name].as_str().unwrap().to_owned();
    (text("identity"), text("psk"))
}

fn psk(first_byte: u8) -> Arc<Psk> {
    let mut key: [u8; 32] = std::array::from_fn(|at| at as u8);
    key[0] = first_byte;
    Arc::new(
        derive_psk(&key, KEY_ID, "sae-client", "sae-server", Cipher::ChaCha20Poly1305).unwrap(),
    )
}

struct OneKey(Arc<Psk>);

impl std::fmt::Debug for OneKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("OneKey")
    }
}

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        (identity == self.0.identity()).then(|| Arc::clone(&self.0))
    }
}

/// A process that does not outlive the test.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `openssl COMMAND` for psk_ke with ChaCha20-Poly1305; `None` if there is no OpenSSL 1.1.1 or later.
fn openssl(command: &str, args: &[&str]) -> Option<Killed> {
    let version = Command::new("openssl").arg("version").output();
    let version = version.map(|out| String::from_utf8_lossy(&out.stdout).into_owned());
    match version {
        Ok(text) if text.starts_with("OpenSSL 3") || text.starts_with("OpenSSL 1.1.1") => {}
        other => {
            eprintln!("skipped: no OpenSSL to talk to ({other:?})");
            return None;
        }
    }
    let (identity, secret) = psk_from_vectors();
    let child = Command::new("openssl")
        .args([command, "-quiet", "-tls1_3", "-allow_no_dhe_kex"])
        .args(["-ciphersuites", "TLS_CHACHA20_POLY1305_SHA256"])
        .args(["-psk_identity", &identity, "-psk", &secret])
        .args(args)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    Some(Killed(child))
}

fn openssl_server() -> Option<(Killed, TcpStream)> {
    let localhost = |port| SocketAddr::from((Ipv4Addr::LOCALHOST, port));
    let port = TcpListener::bind(localhost(0)).unwrap().local_addr().unwrap().port();
    let server = openssl("s_server", &["-nocert", "-accept", &localhost(port).to_string()])?;
    loop {
        match TcpStream::connect(localhost(port)) {
            Ok(socket) => return Some((server, socket)),
            // it is still starting
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

fn send_line(process: &mut Killed, line: &str) {
    let stdin = process.0.stdin.as_mut().unwrap();
    writeln!(stdin, "{line}").unwrap();
    stdin.flush().unwrap();
}

fn receive_line(process: &mut Killed) -> String {
    let mut line = String::new();
    BufReader::new(process.0.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    line.trim_end().to_owned()
}

fn exchange<C, S>(conn: &mut C, socket: &mut TcpStream, openssl: &mut Killed)
where
    C: Deref<Target = ConnectionCommon<S>> + DerefMut,
    S: SideData,
{
    let mut stream = Stream::new(conn, socket);
    stream.write_all(b"from axon\n").unwrap();
    assert_eq!(receive_line(openssl), "from axon");
    send_line(openssl, "from openssl");
    let mut received = [0; 13];
    stream.read_exact(&mut received).unwrap();
    assert_eq!(&received, b"from openssl\n");
}

#[track_caller]
fn is_psk_ke(negotiated: Option<Negotiated>) {
    let negotiated = negotiated.expect("the handshake is complete");
    assert_eq!(negotiated.key_exchange, KeyExchange::PskKe);
    assert_eq!(negotiated.cipher, Cipher::ChaCha20Poly1305);
    assert_eq!(negotiated.psk_identity, Some(psk_from_vectors().0.into_bytes()));
}

#[test]
fn our_client_refuses_a_server_with_another_key() {
    let Some((_server, mut socket)) = openssl_server() else { return };
    let config = client_config(psk(99), PskKex::PskKe, b"").unwrap();
    let mut conn = ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap();
    assert!(conn.complete_io(&mut socket).is_err());
    assert_eq!(negotiated(&conn), None);
}

#[test]
fn our_server_refuses_a_client_with_another_key() {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let addr = listener.local_addr().unwrap().to_string();
    let Some(_client) = openssl("s_client", &["-connect", &addr]) else { return };
    let (mut socket, _) = listener.accept().unwrap();
    let resolver = Arc::new(OneKey(psk(99)));
    let config = server_config(resolver, Cipher::ChaCha20Poly1305, PskKex::PskKe, b"").unwrap();
    let mut conn = ServerConnection::new(Arc::new(config)).unwrap();
    assert!(conn.complete_io(&mut socket).is_err());
    assert_eq!(negotiated(&conn), None);
}

/// OpenSSL's server sends tickets, which have to be ignored.
#[test]
fn our_client_and_their_server() {
    let Some((mut server, mut socket)) = openssl_server() else { return };
    let config = client_config(psk(0), PskKex::PskKe, b"").unwrap();
    let mut conn = ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap();
    while conn.is_handshaking() {
        conn.complete_io(&mut socket).unwrap();
    }
    exchange(&mut conn, &mut socket, &mut server);
    is_psk_ke(negotiated(&conn));
    assert!(conn.tls13_tickets_received() > 0, "or this test shows less than it says");
}

/// OpenSSL's client offers psk_dhe_ke too, with a key share.
#[test]
fn their_client_and_our_server() {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let addr = listener.local_addr().unwrap().to_string();
    let Some(mut client) = openssl("s_client", &["-connect", &addr]) else { return };
    let (mut socket, _) = listener.accept().unwrap();
    let resolver = Arc::new(OneKey(psk(0)));
    let config = server_config(resolver, Cipher::ChaCha20Poly1305, PskKex::PskKe, b"").unwrap();
    let mut conn = ServerConnection::new(Arc::new(config)).unwrap();
    while conn.is_handshaking() {
        conn.complete_io(&mut socket).unwrap();
    }
    exchange(&mut conn, &mut socket, &mut client);
    is_psk_ke(negotiated(&conn));
}
