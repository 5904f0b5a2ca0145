//! Against OpenSSL and GnuTLS as real processes: every mode they have in common with us, and that
//! everything classical is refused.
//!
//! `TEST_OPENSSL` may name a second `openssl`; X25519MLKEM768 needs 3.5 or later. What is missing is
//! skipped with a line that says so.

use std::io::{BufRead, BufReader, Error, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::ops::{Deref, DerefMut};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use axon_tls::identity::{Auth, SigningKey};
use axon_tls::qkd::{self, Psk, PskResolver, derive_psk};
use axon_tls::{Cipher, KeyExchange, PskKex, hybrid};
use rustls_axon::{ClientConnection, ConnectionCommon, ServerConnection, SideData, Stream};

const KEY_ID: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
const PATIENCE: Duration = Duration::from_secs(30);
const LABEL: &str = "EXPORTER-axon-test";

fn psk(cipher: Cipher) -> Arc<Psk> {
    let key = std::array::from_fn(|at| at as u8);
    Arc::new(derive_psk(&key, KEY_ID, "sae-client", "sae-server", cipher).unwrap())
}

/// Identity and key as the independent script derived them, in hexadecimal.
fn vector(cipher: Cipher) -> (String, String) {
    let hash = if cipher == Cipher::Aes256Gcm { "SHA384" } else { "SHA256" };
    let vectors: Vec<serde_json::Value> =
        serde_json::from_str(include_str!("vectors/psk.json")).unwrap();
    let vector = vectors
        .iter()
        .find(|vector| {
            vector["key_id"] == KEY_ID
                && vector["client_sae"] == "sae-client"
                && vector["hash"] == hash
        })
        .unwrap();
    let text = |name: &str| vector[name].as_str().unwrap().to_owned();
    (text("identity"), text("psk"))
}

#[derive(Debug)]
struct OneKey(Cipher);

impl PskResolver for OneKey {
    fn resolve(&self, identity: &[u8]) -> Option<Arc<Psk>> {
        Some(psk(self.0)).filter(|psk| psk.identity() == identity)
    }
}

/// A process that does not outlive the test, and the lines it prints.
struct Peer {
    child: Child,
    lines: Receiver<String>,
}

impl Peer {
    fn start(program: &str, args: &[&str]) -> Self {
        let mut child = Command::new(program)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (tell, lines) = channel();
        let outputs: [Box<dyn Read + Send>; 2] =
            [Box::new(child.stdout.take().unwrap()), Box::new(child.stderr.take().unwrap())];
        for output in outputs {
            let tell = tell.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(output).split(b'\n').map_while(Result::ok) {
                    let _ = tell.send(String::from_utf8_lossy(&line).into_owned());
                }
            });
        }
        Self { child, lines }
    }

    #[track_caller]
    fn expect(&self, part: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no {part:?}"));
            if line.contains(part) {
                return line;
            }
        }
    }

    fn say(&mut self, line: &str) {
        let stdin = self.child.stdin.as_mut().unwrap();
        writeln!(stdin, "{line}").unwrap();
        stdin.flush().unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A free port that no other test of this process gets, outside the range the system hands out.
fn port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    loop {
        let port =
            21_000 + NEXT.fetch_add(1, Ordering::Relaxed) + (std::process::id() % 80 * 100) as u16;
        if TcpListener::bind((Ipv4Addr::LOCALHOST, port)).is_ok() {
            return port;
        }
    }
}

fn dial(port: u16) -> TcpStream {
    let until = std::time::Instant::now() + PATIENCE;
    loop {
        match TcpStream::connect((Ipv4Addr::LOCALHOST, port)) {
            Ok(socket) => return patient(socket),
            Err(err) if std::time::Instant::now() > until => panic!("the server is not up: {err}"),
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

fn patient(socket: TcpStream) -> TcpStream {
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

fn listen() -> (TcpListener, SocketAddr) {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let addr = listener.local_addr().unwrap();
    (listener, addr)
}

fn handshake<C, S>(conn: &mut C, socket: &mut TcpStream) -> Result<(), Error>
where
    C: Deref<Target = ConnectionCommon<S>> + DerefMut,
    S: SideData,
{
    while conn.is_handshaking() {
        conn.complete_io(socket)?;
    }
    Ok(())
}

/// Both ends export the same, and data goes both ways. An echo server says what it hears.
fn exchange<C, S>(conn: &mut C, socket: &mut TcpStream, peer: &mut Peer, echoes: bool)
where
    C: Deref<Target = ConnectionCommon<S>> + DerefMut,
    S: SideData,
{
    let exported = conn.export_keying_material([0; 32], LABEL.as_bytes(), None).unwrap();
    let exported: String = exported.iter().map(|byte| format!("{byte:02x}")).collect();
    let line = peer.expect("material: ").to_lowercase();
    assert!(line.contains(&exported), "{line} is not {exported}");

    let mut stream = Stream::new(conn, socket);
    stream.write_all(b"from axon\n").unwrap();
    let answer: &[u8] = if echoes { b"from axon\n" } else { b"from the peer\n" };
    if !echoes {
        peer.expect("from axon");
        peer.say("from the peer");
    }
    let mut received = vec![0; answer.len()];
    stream.read_exact(&mut received).unwrap();
    assert_eq!(received, answer);
}

fn version_of(program: &str, ask: &str) -> Option<String> {
    let output = Command::new(program).arg(ask).output().ok()?;
    String::from_utf8_lossy(&output.stdout).lines().next().map(str::to_owned)
}

/// The `openssl` of the system, and the one of `TEST_OPENSSL`, which have X25519MLKEM768 or not.
fn openssls() -> Vec<(String, bool)> {
    let mut found = Vec::new();
    for program in ["openssl".to_owned()].into_iter().chain(std::env::var("TEST_OPENSSL").ok()) {
        match version_of(&program, "version") {
            Some(version) if version.starts_with("OpenSSL 3.") => {
                let minor = version[10..].split('.').next().and_then(|minor| minor.parse().ok());
                eprintln!("with {version}");
                found.push((program, minor.is_some_and(|minor: u32| minor >= 5)));
            }
            other => eprintln!("skipped: {program} is not OpenSSL 3 ({other:?})"),
        }
    }
    found
}

fn gnutls() -> bool {
    let found = version_of("gnutls-cli", "--version").zip(version_of("gnutls-serv", "--version"));
    eprintln!("{}", found.as_ref().map_or("skipped: no GnuTLS", |(version, _)| version));
    found.is_some()
}

fn file(name: &str, content: &str) -> String {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("{number}-{name}"));
    std::fs::write(&path, content).unwrap();
    path.to_str().unwrap().to_owned()
}

/// OpenSSL takes a PSK with SHA-384 only as a session: `SSL_SESSION` in DER, in PEM.
fn session(psk: &str) -> String {
    use base64::Engine as _;
    let key = (0..psk.len()).step_by(2).map(|at| u8::from_str_radix(&psk[at..at + 2], 16).unwrap());
    let mut body = vec![2, 1, 1, 2, 2, 3, 4, 4, 2, 0x13, 0x02, 4, 0, 4, 48];
    body.extend(key);
    // as old as can be, and valid for 127 seconds: a PSK does not age
    body.extend([0xa1, 3, 2, 1, 0, 0xa2, 3, 2, 1, 0x7f]);
    let der = [&[0x30, body.len() as u8], &body[..]].concat();
    let body = base64::engine::general_purpose::STANDARD.encode(der);
    let (first, second) = body.split_at(64);
    let label = "SSL SESSION PARAMETERS-----";
    file("session.pem", &format!("-----BEGIN {label}\n{first}\n{second}\n-----END {label}\n"))
}

fn openssl_psk(program: &str, command: &[&str], cipher: Cipher, kex: PskKex) -> Peer {
    let (identity, secret) = vector(cipher);
    let mut args = command.to_vec();
    args.extend(["-tls1_3", "-psk_identity", &identity, "-keymatexport", LABEL]);
    args.extend(["-keymatexportlen", "32"]);
    if kex == PskKex::PskKe {
        args.push("-allow_no_dhe_kex");
    } else {
        args.extend(["-groups", "X25519MLKEM768"]);
    }
    let session_file;
    match cipher {
        Cipher::ChaCha20Poly1305 => {
            args.extend(["-psk", &secret, "-ciphersuites", "TLS_CHACHA20_POLY1305_SHA256"]);
        }
        Cipher::Aes256Gcm => {
            session_file = session(&secret);
            args.extend(["-psk_session", &session_file, "-ciphersuites", "TLS_AES_256_GCM_SHA384"]);
        }
    }
    Peer::start(program, &args)
}

/// Every cipher and mode that `program` can do.
fn with_openssl(test: impl Fn(&str, Cipher, PskKex)) {
    for (program, has_group) in openssls() {
        for cipher in Cipher::ALL {
            test(&program, cipher, PskKex::PskKe);
            if has_group {
                test(&program, cipher, PskKex::PskDheKe);
            } else {
                eprintln!("skipped: psk_dhe_ke, {program} has no X25519MLKEM768");
            }
        }
    }
}

fn is_on(negotiated: Option<axon_tls::Negotiated>, cipher: Cipher, kex: PskKex) {
    let negotiated = negotiated.expect("the handshake is complete");
    let expected = match kex {
        PskKex::PskKe => KeyExchange::PskKe,
        PskKex::PskDheKe => KeyExchange::PskDheKe,
    };
    assert_eq!((negotiated.key_exchange, negotiated.cipher), (expected, cipher));
    assert_eq!(negotiated.psk_identity.unwrap(), vector(cipher).0.into_bytes());
}

fn our_client(cipher: Cipher, kex: PskKex) -> ClientConnection {
    let config = qkd::client_config(psk(cipher), kex, b"").unwrap();
    ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap()
}

fn our_server(cipher: Cipher, kex: PskKex) -> ServerConnection {
    let config = qkd::server_config(Arc::new(OneKey(cipher)), cipher, kex, b"").unwrap();
    ServerConnection::new(Arc::new(config)).unwrap()
}

#[test]
fn openssl_server_in_every_mode() {
    with_openssl(|program, cipher, kex| {
        let port = port();
        let addr = format!("127.0.0.1:{port}");
        let server = ["s_server", "-nocert", "-accept", &addr];
        let mut server = openssl_psk(program, &server, cipher, kex);
        let (mut socket, mut conn) = (dial(port), our_client(cipher, kex));
        handshake(&mut conn, &mut socket).unwrap();
        exchange(&mut conn, &mut socket, &mut server, false);
        is_on(qkd::negotiated(&conn), cipher, kex);
    });
}

#[test]
fn openssl_client_in_every_mode() {
    with_openssl(|program, cipher, kex| {
        let (listener, addr) = listen();
        let addr = addr.to_string();
        let mut client = openssl_psk(program, &["s_client", "-connect", &addr], cipher, kex);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = our_server(cipher, kex);
        handshake(&mut conn, &mut socket).unwrap();
        exchange(&mut conn, &mut socket, &mut client, false);
        is_on(qkd::negotiated(&conn), cipher, kex);
    });
}

const GNUTLS_PSK: &str = "NORMAL:-VERS-ALL:+VERS-TLS1.3:-KX-ALL:+PSK";
const GNUTLS_ECDHE_PSK: &str = "NORMAL:-VERS-ALL:+VERS-TLS1.3:-KX-ALL:+ECDHE-PSK";

fn gnutls_server(port: u16, priority: &str) -> Peer {
    let (identity, secret) = vector(Cipher::ChaCha20Poly1305);
    // a name with a colon in it goes in hexadecimal
    let name: String = identity.bytes().map(|byte| format!("{byte:02x}")).collect();
    let passwd = file("psk.txt", &format!("#{name}:{secret}\n"));
    let (port, label) = (port.to_string(), format!("--keymatexport={LABEL}"));
    let args = ["--echo", "-p", &port, "--pskpasswd", &passwd, "--priority", priority, &label];
    Peer::start("gnutls-serv", &[&args[..], &["--keymatexportsize=32"]].concat())
}

fn gnutls_client(addr: SocketAddr, priority: &str) -> Peer {
    let (identity, secret) = vector(Cipher::ChaCha20Poly1305);
    let (port, label) = (addr.port().to_string(), format!("--keymatexport={LABEL}"));
    let args =
        ["-p", &port, "--pskusername", &identity, "--pskkey", &secret, "--priority", priority];
    let rest = [&label, "--keymatexportsize=32", "--insecure", "127.0.0.1"];
    Peer::start("gnutls-cli", &[&args[..], &rest].concat())
}

/// GnuTLS has external PSKs with SHA-256 only.
#[test]
fn gnutls_both_ways_and_its_classical_groups_refused() {
    if !gnutls() {
        return;
    }
    let (cipher, kex) = (Cipher::ChaCha20Poly1305, PskKex::PskKe);
    for (priority, works) in [(GNUTLS_ECDHE_PSK, false), (GNUTLS_PSK, true)] {
        let port = port();
        let mut server = gnutls_server(port, priority);
        let (mut socket, mut conn) = (dial(port), our_client(cipher, kex));
        let outcome = handshake(&mut conn, &mut socket);
        assert_eq!(outcome.is_ok(), works, "server, {priority}: {outcome:?}");
        if works {
            exchange(&mut conn, &mut socket, &mut server, true);
            is_on(qkd::negotiated(&conn), cipher, kex);
        } else {
            assert_eq!(qkd::negotiated(&conn), None);
        }

        let (listener, addr) = listen();
        let mut client = gnutls_client(addr, priority);
        let mut socket = patient(listener.accept().unwrap().0);
        let mut conn = our_server(cipher, kex);
        let outcome = handshake(&mut conn, &mut socket);
        assert_eq!(outcome.is_ok(), works, "client, {priority}: {outcome:?}");
        if works {
            exchange(&mut conn, &mut socket, &mut client, false);
            is_on(qkd::negotiated(&conn), cipher, kex);
        } else {
            assert_eq!(qkd::negotiated(&conn), None);
        }
    }
}

/// How a peer is told to have one classical way alone: for OpenSSL, and for GnuTLS.
const CLASSICAL: [([&str; 3], &str); 3] = [
    (["-tls1_3", "-groups", "X25519"], "NORMAL:-VERS-ALL:+VERS-TLS1.3:-GROUP-ALL:+GROUP-X25519"),
    (["-tls1_3", "-groups", "P-256"], "NORMAL:-VERS-ALL:+VERS-TLS1.3:-GROUP-ALL:+GROUP-SECP256R1"),
    (["-tls1_2", "-groups", "X25519"], "NORMAL:-VERS-ALL:+VERS-TLS1.2"),
];

#[test]
fn classical_clients_are_refused() {
    let refuse = |start: &dyn Fn(&SocketAddr) -> Peer| {
        let (listener, addr) = listen();
        let _client = start(&addr);
        let mut socket = patient(listener.accept().unwrap().0);
        let auth = Auth::None(SigningKey::generate().unwrap());
        let config = hybrid::server_config(&auth, Cipher::default(), b"").unwrap();
        let mut conn = rustls::ServerConnection::new(Arc::new(config)).unwrap();
        let err = conn.complete_io(&mut socket).unwrap_err().to_string();
        assert!(err.contains("incompatible"), "{err}");
        assert_eq!(hybrid::negotiated(&conn), None);

        for kex in PskKex::ALL {
            let _client = start(&addr);
            let mut socket = patient(listener.accept().unwrap().0);
            let mut conn = our_server(Cipher::default(), kex);
            let err = handshake(&mut conn, &mut socket).unwrap_err().to_string();
            assert!(err.contains("incompatible"), "{err}");
            assert_eq!(qkd::negotiated(&conn), None);
        }
    };
    for (options, priority) in CLASSICAL {
        for (program, _) in openssls() {
            refuse(&|addr| {
                let args = ["s_client", "-connect", &addr.to_string()];
                Peer::start(&program, &[&args[..], &options].concat())
            });
        }
        if gnutls() {
            refuse(&|addr| {
                let port = addr.port().to_string();
                let args = ["-p", &port, "--insecure", "--priority", priority, "127.0.0.1"];
                Peer::start("gnutls-cli", &args)
            });
        }
    }
}

/// The same servers accept a stock rustls client, so what is refused is what they offer.
#[test]
fn classical_servers_are_refused() {
    let certified = rcgen::generate_simple_self_signed(["peer".to_owned()]).unwrap();
    let certificate = file("certificate.pem", &certified.cert.pem());
    let key = file("key.pem", &certified.signing_key.serialize_pem());
    let mut roots = rustls::RootCertStore::empty();
    roots.add(certified.cert.der().clone()).unwrap();

    let refused = |port: u16, tls13: bool| {
        if tls13 {
            let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
            let stock = rustls::ClientConfig::builder_with_provider(provider)
                .with_protocol_versions(&[&rustls::version::TLS13])
                .unwrap()
                .with_root_certificates(roots.clone())
                .with_no_client_auth();
            let mut conn =
                rustls::ClientConnection::new(Arc::new(stock), "peer".try_into().unwrap()).unwrap();
            let mut socket = dial(port);
            while conn.is_handshaking() {
                conn.complete_io(&mut socket).unwrap();
            }
        }
        let auth = Auth::None(SigningKey::generate().unwrap());
        let config = hybrid::client_config(&auth, Cipher::default(), b"").unwrap();
        let mut conn =
            rustls::ClientConnection::new(Arc::new(config), "peer".try_into().unwrap()).unwrap();
        let mut socket = dial(port);
        while conn.is_handshaking() && conn.complete_io(&mut socket).is_ok() {}
        assert!(conn.is_handshaking(), "a classical server was accepted");
        assert_eq!(hybrid::negotiated(&conn), None);

        for kex in PskKex::ALL {
            let (mut conn, mut socket) = (our_client(Cipher::default(), kex), dial(port));
            assert!(handshake(&mut conn, &mut socket).is_err());
            assert_eq!(qkd::negotiated(&conn), None);
        }
    };
    for (options, priority) in CLASSICAL {
        let tls13 = options[0] == "-tls1_3";
        for (program, _) in openssls() {
            let port = port();
            let addr = format!("127.0.0.1:{port}");
            let args = ["s_server", "-accept", &addr, "-cert", &certificate, "-key", &key];
            let _server = Peer::start(&program, &[&args[..], &options].concat());
            refused(port, tls13);
        }
        if gnutls() {
            let port = port();
            let text = port.to_string();
            let args = ["--echo", "-p", &text, "--x509certfile", &certificate, "--x509keyfile"];
            let rest = [&key, "--disable-client-cert", "--priority", priority];
            let _server = Peer::start("gnutls-serv", &[&args[..], &rest].concat());
            refused(port, tls13);
        }
    }
}
