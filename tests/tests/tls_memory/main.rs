//! Which secrets of a TLS connection are left in the memory of the process that had it.
//!
//! A child process derives a pre-shared key from a QKD key and connects to itself over QUIC, as two
//! daemons do. This process knows the QKD key, is told the handshake messages, computes every secret
//! of the key schedule by RFC 8446 section 7 by itself, and looks for each of them in all writable
//! memory of the child: stacks, heap, and what was freed.

mod child;
mod memory;
mod schedule;

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use axon_tls::{Cipher, PskKex};
use memory::Needles;
use schedule::{Schedule, Secret};

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
    fn start(cipher: Cipher, kex: PskKex, key: &[u8; 32]) -> Self {
        let mut process = Command::new(std::env::current_exe().unwrap())
            .args(["child", "--exact", "--nocapture", "--test-threads=1"])
            .env(child::ASKED, format!("{cipher} {kex}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut to = process.stdin.take().unwrap();
        let from = BufReader::new(process.stdout.take().unwrap());
        to.write_all(key).unwrap();
        Self { process, to, from }
    }

    /// Waits until the child is at a step, and gives what it says there.
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

    /// What of `secrets` is in the memory of the child by now.
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
fn the_search_finds_what_was_freed_and_what_is_held() {
    let key = random();
    let mut examined = Examined::start(Cipher::default(), PskKex::PskKe, &key);
    examined.at(child::CONNECTED);
    examined.go_on();
    examined.at(child::DROPPED);
    let [held, freed] = child::marks(&key);
    let marks = [Secret::new("held", &held), Secret::new("freed", &freed)];
    assert_eq!(examined.left(&marks), ["held", "freed"]);
}

fn nothing_is_left_of(cipher: Cipher, kex: PskKex) {
    let key = random();
    let mut examined = Examined::start(cipher, kex, &key);
    let transcript = unhex(&examined.at(child::CONNECTED));
    let schedule = Schedule::new(cipher, kex, &key, &transcript);
    let early = examined.left(&schedule.used_up());
    examined.go_on();
    examined.at(child::DROPPED);
    let late = examined.left(&schedule.all());
    assert!(
        early.is_empty() && late.is_empty(),
        "{cipher}, {kex}: while connected {early:?}, at the end {late:?}"
    );
}

#[test]
fn nothing_is_left_of_psk_ke() {
    for cipher in Cipher::ALL {
        nothing_is_left_of(cipher, PskKex::PskKe);
    }
}

/// The secrets before the key exchange comes in are those that this process can compute.
#[test]
fn nothing_is_left_of_psk_dhe_ke() {
    for cipher in Cipher::ALL {
        nothing_is_left_of(cipher, PskKex::PskDheKe);
    }
}
