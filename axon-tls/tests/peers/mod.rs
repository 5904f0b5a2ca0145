//! OpenSSL and GnuTLS as real processes: how the tests find, start and talk to them.
//!
//! `TEST_OPENSSL` may name a second `openssl`; X25519MLKEM768 needs 3.5 or later. A program that is
//! missing is skipped with a line that says so.
#![allow(dead_code, reason = "each test file uses its own part")]

pub(crate) mod psk;

use std::fmt::Display;
use std::io::{BufRead, BufReader, Error, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(30);
/// The label that both ends export to check that they have the same secrets.
pub(crate) const LABEL: &str = "EXPORTER-axon-test";

/// A process that does not outlive the test, and the lines it prints.
pub(crate) struct Peer {
    child: Child,
    lines: Receiver<String>,
}

impl Peer {
    pub(crate) fn start(program: &str, args: &[&str]) -> Self {
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
    pub(crate) fn expect(&self, part: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no {part:?}"));
            if line.contains(part) {
                return line;
            }
        }
    }

    pub(crate) fn say(&mut self, line: &str) {
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

/// Returns a free port that no other test of this process gets, outside the range that the system assigns.
pub(crate) fn port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    loop {
        let port =
            21_000 + NEXT.fetch_add(1, Ordering::Relaxed) + (std::process::id() % 80 * 100) as u16;
        if TcpListener::bind((Ipv4Addr::LOCALHOST, port)).is_ok() {
            return port;
        }
    }
}

pub(crate) fn dial(port: u16) -> TcpStream {
    let until = std::time::Instant::now() + PATIENCE;
    loop {
        match TcpStream::connect((Ipv4Addr::LOCALHOST, port)) {
            Ok(socket) => return patient(socket),
            Err(err) if std::time::Instant::now() > until => panic!("the server is not up: {err}"),
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

pub(crate) fn patient(socket: TcpStream) -> TcpStream {
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

pub(crate) fn listen() -> (TcpListener, SocketAddr) {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let addr = listener.local_addr().unwrap();
    (listener, addr)
}

/// The functions that the tests need of a connection, of rustls or of rustls-axon.
pub(crate) trait Tls {
    fn is_handshaking(&self) -> bool;
    fn complete_io(&mut self, socket: &mut TcpStream) -> Result<(), Error>;
    fn export(&mut self) -> [u8; 32];
    fn stream<'a>(&'a mut self, socket: &'a mut TcpStream) -> Box<dyn ReadWrite + 'a>;
}

pub(crate) trait ReadWrite: Read + Write {}

impl<T: Read + Write> ReadWrite for T {}

macro_rules! tls {
    ($($tls:ident::$conn:ident,)*) => {$(
        impl Tls for $tls::$conn {
            fn is_handshaking(&self) -> bool {
                $tls::CommonState::is_handshaking(self)
            }

            fn complete_io(&mut self, socket: &mut TcpStream) -> Result<(), Error> {
                $tls::ConnectionCommon::complete_io(self, socket).map(|_| ())
            }

            fn export(&mut self) -> [u8; 32] {
                self.export_keying_material([0; 32], LABEL.as_bytes(), None).unwrap()
            }

            fn stream<'a>(&'a mut self, socket: &'a mut TcpStream) -> Box<dyn ReadWrite + 'a> {
                Box::new($tls::Stream::new(self, socket))
            }
        }
    )*};
}

tls! {
    rustls::ClientConnection,
    rustls::ServerConnection,
    rustls_axon::ClientConnection,
    rustls_axon::ServerConnection,
}

pub(crate) fn handshake(conn: &mut impl Tls, socket: &mut TcpStream) -> Result<(), Error> {
    while conn.is_handshaking() {
        conn.complete_io(socket)?;
    }
    Ok(())
}

/// Checks that both ends export the same secret, and that data goes both ways. An echo server returns the data that it
/// receives.
pub(crate) fn exchange(conn: &mut impl Tls, socket: &mut TcpStream, peer: &mut Peer, echoes: bool) {
    let exported: String = conn.export().iter().map(|byte| format!("{byte:02x}")).collect();
    let line = peer.expect("material: ").to_lowercase();
    assert!(line.contains(&exported), "{line} is not {exported}");

    let mut stream = conn.stream(socket);
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

/// Returns the `openssl` of the system, and the one of `TEST_OPENSSL`, each with whether it has X25519MLKEM768.
pub(crate) fn openssls() -> Vec<(String, bool)> {
    let mut found = Vec::new();
    for program in ["openssl".to_owned()].into_iter().chain(std::env::var("TEST_OPENSSL").ok()) {
        match version_of(&program, "version") {
            Some(version) if version.starts_with("OpenSSL 3.") => {
                let minor = version[10..].split('.').next().and_then(|minor| minor.parse().ok());
                eprintln!("with {version}");
                found.push((program, minor.is_some_and(|minor: u32| minor >= 5)));
            }
            other => skipped(format_args!("{program} is not OpenSSL 3 ({other:?})")),
        }
    }
    found
}

pub(crate) fn gnutls() -> bool {
    let found = version_of("gnutls-cli", "--version").zip(version_of("gnutls-serv", "--version"));
    match &found {
        Some((version, _)) => eprintln!("with {version}"),
        None => skipped("no GnuTLS"),
    }
    found.is_some()
}

/// Says which test is left out, and why, past the harness: it would show that only beside a failure.
pub(crate) fn skipped(what: impl Display) {
    let _ = writeln!(std::io::stderr(), "skipped: {what}");
}

/// Runs `test` with every `openssl` that has X25519MLKEM768.
pub(crate) fn with_hybrid_openssl(test: impl Fn(&str)) {
    let mut any = false;
    for (program, has_group) in openssls() {
        if has_group {
            any = true;
            test(&program);
        } else {
            skipped(format_args!("{program} has no X25519MLKEM768"));
        }
    }
    if !any {
        skipped("no OpenSSL with X25519MLKEM768; TEST_OPENSSL may name one");
    }
}

pub(crate) fn file(name: &str, content: &str) -> String {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("{number}-{name}"));
    std::fs::write(&path, content).unwrap();
    path.to_str().unwrap().to_owned()
}
