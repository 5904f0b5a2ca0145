//! Tests which secrets of a TLS connection stay in the memory of its process.
//!
//! A child process derives a pre-shared key from a QKD key and connects to itself over QUIC, as two daemons do. This
//! process knows the QKD key, and gets the handshake messages from the child. It computes every secret of the key
//! schedule by RFC 8446 section 7 itself. It searches for each secret in all writable memory of the child: stacks,
//! heap, and freed memory.
//!
//! With a key exchange, the child has one end, and this process the other: a key exchange group of the test gets the
//! shared secret there.

#[path = "../../../axon-tls/tests/common/anybody.rs"]
mod anybody;
mod certificates;
mod child;
mod erase;
mod groups;
mod memory;
mod quic;
mod tapped;
mod transcript;

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use axon_tests::schedule::{Mode, Schedule, Secret};
use axon_tls::{Cipher, PskKex};
use child::Has;
use memory::Needles;
use tapped::{Learnt, TappedEnd, Terms};

/// The process that is looked at.
#[test]
fn child() {
    child::run_if_asked();
}

struct Examined {
    process: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

impl Examined {
    fn start(cipher: Cipher, mode: Mode, has: Has, key: &[u8; 32]) -> Self {
        let mut process = Command::new(std::env::current_exe().unwrap())
            .args(["child", "--exact", "--nocapture", "--test-threads=1"])
            .env(child::ASKED, format!("{cipher} {mode} {has}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut to = process.stdin.take().unwrap();
        let from = BufReader::new(process.stdout.take().unwrap());
        to.write_all(key).unwrap();
        Self { process, to, from }
    }

    /// Waits until the child is at a step, and returns the text that it prints there.
    fn at(&mut self, step: &str) -> String {
        let mut line = String::new();
        loop {
            line.clear();
            assert!(self.from.read_line(&mut line).unwrap() > 0, "the child ended before {step}");
            if let Some((_, said)) = line.split_once(step) {
                return said.trim().to_owned();
            }
        }
    }

    fn go_on(&mut self) {
        self.to.write_all(&[1]).unwrap();
    }

    /// Returns which of `secrets` are in the memory of the child now.
    fn left(&self, secrets: &[Secret]) -> Vec<String> {
        Needles::of(secrets).found_in(self.process.id())
    }
}

impl Drop for Examined {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn random() -> [u8; 32] {
    let mut bytes = [0; 32];
    std::fs::File::open("/dev/urandom").unwrap().read_exact(&mut bytes).unwrap();
    bytes
}

fn unhex(text: &str) -> Vec<u8> {
    let byte = |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap();
    (0..text.len()).step_by(2).map(byte).collect()
}

/// Without this the other tests would show nothing: the child frees a block with the key in it, and
/// holds another, and both are found.
#[test]
fn the_memory_search_finds_held_and_freed_secrets() {
    let key = random();
    let mut examined =
        Examined::start(Cipher::default(), Mode::Psk(PskKex::PskKe), Has::Both, &key);
    examined.at(child::CONNECTED);
    examined.go_on();
    examined.at(child::DROPPED);
    let [held, freed] = child::marks(&key);
    let marks = [Secret::new("held", &held), Secret::new("freed", &freed)];
    assert_eq!(examined.left(&marks), ["held", "freed"]);
}

fn nothing_is_left_of(cipher: Cipher, kex: PskKex) {
    let key = random();
    let mode = Mode::Psk(kex);
    let mut examined = Examined::start(cipher, mode, Has::Both, &key);
    let transcript = unhex(&examined.at(child::CONNECTED));
    let schedule = Schedule::new(child::terms(cipher, mode, &key), &transcript, None);
    nothing_is_left_behind(&mut examined, &schedule, &format!("{cipher}, {mode}"));
}

/// Secrets that rustls as released holds by value, out of the reach of a provider: it copies them as it moves them, and
/// erases the last copy alone.
const HELD_BY_RUSTLS: [&str; 6] = [
    "client handshake traffic secret",
    "server handshake traffic secret",
    "client traffic secret 0",
    "server traffic secret 0",
    "exporter secret",
    "resumption secret",
];

fn nothing_is_left_behind(examined: &mut Examined, schedule: &Schedule, case: &str) {
    nothing_is_left_but(examined, schedule, case, &[]);
}

/// Looks while the connection is there, after traffic, and when it is gone.
fn nothing_is_left_but(examined: &mut Examined, schedule: &Schedule, case: &str, allowed: &[&str]) {
    let but = |found: Vec<String>| -> Vec<String> {
        found.into_iter().filter(|name| !allowed.contains(&name.as_str())).collect()
    };
    let mut used_up = schedule.used_up().to_vec();
    let mut all = schedule.all();
    if let Some([of_label, _]) = schedule.export(child::EXPORTER) {
        let of_label = Secret::new("secret of one exporter label", &of_label);
        used_up.push(of_label.clone());
        all.push(of_label);
    }
    let early = but(examined.left(&used_up));
    examined.go_on();
    examined.at(child::DROPPED);
    let late = but(examined.left(&all));
    assert!(
        early.is_empty() && late.is_empty(),
        "{case}: while connected {early:?}, at the end {late:?}"
    );
}

#[test]
fn nothing_is_left_of_psk_ke() {
    for cipher in Cipher::ALL {
        nothing_is_left_of(cipher, PskKex::PskKe);
    }
}

/// The secrets before the key exchange comes in, where one process has both ends.
#[test]
fn nothing_is_left_of_psk_dhe_ke() {
    for cipher in Cipher::ALL {
        nothing_is_left_of(cipher, PskKex::PskDheKe);
    }
}

/// Checks each secret of a connection whose other end is in this process.
fn nothing_is_left_of_one_end(mode: Mode, is_client: bool) {
    for cipher in Cipher::ALL {
        let key = random();
        let shared_terms = child::terms(cipher, mode, &key);
        let psk = Schedule::psk(shared_terms);
        let terms = Terms { cipher, mode, psk: &psk };
        let (mut examined, end, (connection, learnt));
        if is_client {
            let port;
            (end, port) = TappedEnd::server(terms);
            examined = Examined::start(cipher, mode, Has::Client(port), &key);
            (connection, learnt) = end.accept();
        } else {
            end = TappedEnd::client(terms);
            examined = Examined::start(cipher, mode, Has::Server, &key);
            let port = unhex(&examined.at(child::LISTENS));
            (connection, learnt) = end.dial(u16::from_be_bytes([port[0], port[1]]));
        }
        examined.at(child::CONNECTED);
        let Learnt { transcript, shared } = learnt;
        let schedule = Schedule::new(shared_terms, &transcript, Some(&shared));
        let mut exported = [0; 32];
        connection.export_keying_material(&mut exported, child::EXPORTER.as_bytes(), b"").unwrap();
        let [_, computed] = schedule.export(child::EXPORTER).unwrap();
        assert_eq!(computed, exported, "these are the secrets of the connection");
        let side = if is_client { "client" } else { "server" };
        let allowed = if mode == Mode::Hybrid { &HELD_BY_RUSTLS[..] } else { &[] };
        let case = format!("{cipher}, {mode}, {side}");
        nothing_is_left_but(&mut examined, &schedule, &case, allowed);
        drop((connection, end));
    }
}

#[test]
fn nothing_is_left_of_a_client_in_psk_dhe_ke() {
    nothing_is_left_of_one_end(Mode::Psk(PskKex::PskDheKe), true);
}

#[test]
fn nothing_is_left_of_a_server_in_psk_dhe_ke() {
    nothing_is_left_of_one_end(Mode::Psk(PskKex::PskDheKe), false);
}

/// The shared secret, and the secrets extracted from it and expanded for the next step, are not in memory.
#[test]
fn a_hybrid_client_leaves_only_secrets_that_rustls_holds() {
    nothing_is_left_of_one_end(Mode::Hybrid, true);
}

#[test]
fn a_hybrid_server_leaves_only_secrets_that_rustls_holds() {
    nothing_is_left_of_one_end(Mode::Hybrid, false);
}
