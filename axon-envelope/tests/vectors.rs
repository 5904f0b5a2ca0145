//! The published vectors, and the Python implementation as a foreign peer.

mod common;

use std::io::Write;
use std::process::{Command, Stdio};

use axon_envelope::aead::{Aead, DefaultAead};
use axon_envelope::{
    Channel, Delivery, HeaderError, KeyId, Kind, KmeKey, Limits, OpenError, Opener, RefusalCause,
    Route, Sealer, TopicHash,
};
use common::{START, hex, unhex};
use serde::{Deserialize, Serialize};

#[derive(Deserialize)]
struct Vectors {
    accept: Vec<Case>,
    refuse: Vec<Case>,
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(default)]
struct Case {
    name: String,
    kme_key: String,
    key_id: String,
    sender: String,
    receiver: String,
    context: String,
    domain: u32,
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    topic_hash: String,
    kind: u8,
    index: u8,
    nonce_prefix: String,
    plaintext: String,
    header: String,
    envelope: String,
    opened_before: Vec<String>,
    malformed: Option<String>,
    refused: Option<String>,
}

impl Case {
    fn channel(&self) -> Channel {
        Channel::new(&self.sender, &self.receiver, unhex(&self.context)).unwrap()
    }

    fn route(&self) -> Route {
        let kind = [Kind::Topic, Kind::Request, Kind::Response][usize::from(self.kind)];
        Route { kind, topic: TopicHash(unhex(&self.topic_hash).try_into().unwrap()) }
    }

    fn key(&self) -> (KeyId, KmeKey) {
        let key = KmeKey::from_slice(&unhex(&self.kme_key)).unwrap();
        (KeyId::new(&self.key_id).unwrap(), key)
    }

    fn opener<A: Aead>(&self) -> Opener<A> {
        let mut opener = Opener::with_limits(self.channel(), Limits::default()).unwrap();
        let (id, key) = self.key();
        opener.add_key(id, key).unwrap();
        opener
    }

    /// Seals as the case says, using up the indexes before.
    fn seal<A: Aead>(&self) -> Vec<u8> {
        let (id, key) = self.key();
        let prefix = unhex(&self.nonce_prefix).try_into().unwrap();
        let mut sealer = Sealer::<A>::with_nonce_prefix(&self.channel(), id, key, prefix);
        for _ in 0..self.index {
            let slot = sealer.slot(START, Delivery::BestEffort).unwrap();
            slot.seal_into(self.route(), &[], &mut [0; 600]).unwrap();
        }
        let plaintext = unhex(&self.plaintext);
        let mut out = vec![0; sealer.overhead() + plaintext.len()];
        let slot = sealer.slot(START, Delivery::Reliable).unwrap();
        slot.seal_into(self.route(), &[&plaintext], &mut out).unwrap();
        out
    }

    fn open<A: Aead>(&self) -> Result<Vec<u8>, OpenError> {
        let mut opener = self.opener::<A>();
        for earlier in &self.opened_before {
            opener.open_in_place(START, self.route(), &mut unhex(earlier)).unwrap();
        }
        let mut envelope = unhex(&self.envelope);
        opener.open_in_place(START, self.route(), &mut envelope).map(|plain| plain.to_vec())
    }
}

fn vectors() -> Vectors {
    serde_json::from_str(include_str!("vectors/axqkd001.json")).unwrap()
}

fn header_error(error: &HeaderError) -> &'static str {
    match error {
        HeaderError::Truncated { .. } => "truncated",
        HeaderError::Magic => "magic",
        HeaderError::Kind(_) => "kind",
        HeaderError::Flags(_) => "flags",
        HeaderError::EmptySender => "empty_sender",
        HeaderError::EmptyKeyId => "empty_key_id",
        HeaderError::NonceIndex => "nonce_index",
        other => panic!("no vector for {other}"),
    }
}

fn cause(cause: RefusalCause) -> &'static str {
    match cause {
        RefusalCause::WrongSender => "wrong_sender",
        RefusalCause::WrongRoute => "wrong_route",
        RefusalCause::IndexOutOfRange => "index_out_of_range",
        RefusalCause::UnknownKey => "unknown_key",
        RefusalCause::Retired => "retired",
        RefusalCause::Replayed => "replayed",
        RefusalCause::Unauthentic => "unauthentic",
        other => panic!("no vector for {other}"),
    }
}

fn check_vectors<A: Aead>() {
    let vectors = vectors();
    assert!(vectors.refuse.len() > 30 && vectors.accept.len() > 10, "vectors are missing");
    for case in &vectors.refuse {
        let error = case.open::<A>().expect_err(&case.name);
        match (&error, &case.malformed, &case.refused) {
            (OpenError::Header(error), Some(expected), None) => {
                assert_eq!(header_error(error), expected, "{}", case.name);
            }
            (OpenError::Refused(refusal), None, Some(expected)) => {
                assert_eq!(cause(refusal.cause()), expected, "{}", case.name);
                assert_eq!(format!("{error} {error:?}"), "envelope refused Refused(Refusal)");
            }
            other => panic!("{}: {other:?}", case.name),
        }
    }
    for case in &vectors.accept {
        let topic = TopicHash::new(case.domain, &case.topic, &case.type_name).unwrap();
        assert_eq!(topic.to_string(), case.topic_hash, "{}", case.name);
        let envelope = case.seal::<A>();
        assert!(hex(&envelope).starts_with(&case.header), "{}", case.name);
        assert_eq!(hex(&envelope), case.envelope, "{}", case.name);
        assert_eq!(hex(&case.open::<A>().unwrap()), case.plaintext, "{}", case.name);
    }
}

#[test]
fn the_default_aead_agrees_with_the_vectors() {
    check_vectors::<DefaultAead>();
}

#[cfg(feature = "rust-crypto")]
#[test]
fn rust_crypto_agrees_with_the_vectors() {
    check_vectors::<axon_envelope::aead::RustCrypto>();
}

/// Says why, past the harness, which would show it only beside a failure.
fn skipped<T>(why: &str) -> Option<T> {
    let _ = writeln!(std::io::stderr(), "skipped: {why}");
    None
}

/// Runs the Python implementation; `None` if this machine cannot.
fn python(command: &str, input: &[u8]) -> Option<Vec<u8>> {
    let probe = Command::new("python3").args(["-c", "import cryptography"]).output();
    match probe {
        Ok(output) if output.status.success() => {}
        Ok(_) => return skipped("python3 has no `cryptography` (pip install cryptography)"),
        Err(error) => return skipped(&format!("python3 does not run: {error}")),
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/python/axqkd001.py");
    let mut child = Command::new("python3")
        .args([script, command])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let input = input.to_vec();
    let writer = std::thread::spawn(move || stdin.write_all(&input));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success(), "python3 {script} {command} failed: {}", output.status);
    Some(output.stdout)
}

/// Returns messages of every kind, index and a range of lengths, each under a channel of its own.
fn cases() -> Vec<Case> {
    let lengths = [0, 1, 15, 16, 17, 64, 1_000, 70_000];
    let mut cases = Vec::new();
    for (number, length) in (0_u8..40).zip(lengths.into_iter().cycle()) {
        let plaintext: Vec<u8> = (0..length).map(|at: usize| at as u8 ^ number).collect();
        cases.push(Case {
            name: format!("case {number}"),
            kme_key: hex(&[number; 32]),
            key_id: format!("{number:08x}-7d60-487f-adc1-4ddcc177c139"),
            sender: "s".repeat(usize::from(number) * 6 + 1),
            receiver: format!("receiver-{number}"),
            context: hex(&vec![number; usize::from(number)]),
            topic_hash: hex(&[number ^ 0xff; 16]),
            kind: number % 3,
            index: number % 10,
            nonce_prefix: hex(&[number ^ 0x55; 8]),
            plaintext: hex(&plaintext),
            ..Case::default()
        });
    }
    cases
}

#[test]
fn python_agrees_with_the_vectors() {
    let Some(output) = python("check", include_bytes!("vectors/axqkd001.json")) else { return };
    eprintln!("python: {}", String::from_utf8_lossy(&output));
}

#[test]
fn stored_vectors_match_the_python_output() {
    let Some(output) = python("vectors", b"") else { return };
    assert!(output == include_bytes!("vectors/axqkd001.json"), "regenerate tests/vectors");
}

#[test]
fn python_opens_envelopes_sealed_by_rust_and_refuses_tampered_envelopes() {
    let mut cases = cases();
    let mut expected = Vec::new();
    for (number, case) in cases.iter_mut().enumerate() {
        let mut envelope = case.seal::<DefaultAead>();
        if number % 4 == 3 {
            *envelope.last_mut().unwrap() ^= 0x80;
            expected.push(serde_json::json!({"refused": "unauthentic"}));
        } else {
            expected.push(serde_json::json!({"plaintext": case.plaintext}));
        }
        case.envelope = hex(&envelope);
    }
    let Some(output) = python("open", &serde_json::to_vec(&cases).unwrap()) else { return };
    let opened: Vec<serde_json::Value> = serde_json::from_slice(&output).unwrap();
    assert_eq!(opened, expected);
}

#[test]
fn rust_opens_envelopes_sealed_by_python() {
    let mut cases = cases();
    let Some(output) = python("seal", &serde_json::to_vec(&cases).unwrap()) else { return };
    let envelopes: Vec<String> = serde_json::from_slice(&output).unwrap();
    assert_eq!(envelopes.len(), cases.len());
    for (case, envelope) in cases.iter_mut().zip(envelopes) {
        assert_eq!(hex(&case.seal::<DefaultAead>()), envelope, "{}", case.name);
        case.envelope = envelope;
        assert_eq!(hex(&case.open::<DefaultAead>().unwrap()), case.plaintext, "{}", case.name);
    }
}
