use std::time::Duration;

use axon_envelope::{KeyId, KmeKey};
use secrecy::ExposeSecret;

use super::{ClientProof, ProofFailure, ProofResponder, ProofState};
use crate::keys::{
    Exporters, KeyMessage, proof,
    request::{Answer, FailureKind, Fetched, KmeRequest, RequestFailure},
};

const NOW: Duration = Duration::from_secs(5);

fn exporters() -> Exporters {
    Exporters::new([1; 32], [2; 32])
}

fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

fn key(byte: u8) -> KmeKey {
    KmeKey::from_slice(&[byte; 32]).unwrap()
}

fn given(request: KmeRequest, byte: u8) -> Answer {
    let keys = vec![(id("k1"), key(byte))];
    Answer { request, took: Duration::ZERO, outcome: Ok(Fetched::Keys(keys)) }
}

fn failed(request: KmeRequest, kind: FailureKind) -> Answer {
    let outcome = Err(RequestFailure::new(kind, "no"));
    Answer { request, took: Duration::ZERO, outcome }
}

/// Returns a server that has announced `k1`, whose key is all ones.
fn announced() -> ClientProof {
    let mut proof = ClientProof::new(NOW, "sae-a", &exporters());
    let request = proof.poll_request(NOW).unwrap();
    proof.handle_answer(NOW, given(request, 1));
    assert_eq!(proof.poll_message(), Some(KeyMessage::Announce(vec![id("k1")])));
    assert_eq!(proof.poll_message(), None);
    assert_eq!(proof.state(), ProofState::Pending);
    proof
}

#[test]
fn nothing_but_the_right_proof_will_do() {
    let right = proof::compute(&key(1), &id("k1"), exporters().ready());
    let other_key = proof::compute(&key(3), &id("k1"), exporters().ready());
    let other_connection = proof::compute(&key(1), &id("k1"), &[9; 32]);
    let ready = |key_id: &str, proof| KeyMessage::Ready { key_id: id(key_id), proof };
    for (message, code) in [
        (ready("k1", other_key), 0x20),
        (ready("k1", other_connection), 0x20),
        (ready("k2", right), 0x32),
        (KeyMessage::Announce(vec![id("k1")]), 0x32),
        (KeyMessage::Failed { key_id: id("k1"), reason: "gone".to_owned() }, 0x23),
    ] {
        let mut proof = announced();
        proof.handle_message(NOW, &message);
        let ProofState::Failed(failure) = proof.state() else { panic!("{message:?}") };
        assert_eq!(failure.code(), code, "{failure}");
        proof.handle_message(NOW, &ready("k1", right));
        assert!(matches!(proof.state(), ProofState::Failed(_)), "and it stays so");
        assert!(proof.into_key().is_none());
    }
    let mut proof = ClientProof::new(NOW, "sae-a", &exporters());
    proof.handle_message(NOW, &ready("k1", right));
    assert!(matches!(proof.state(), ProofState::Failed(_)), "before anything was announced");

    let mut proof = announced();
    proof.handle_message(NOW, &ready("k1", right));
    assert_eq!(proof.state(), ProofState::Proven);
    let (key_id, proven) = proof.into_key().unwrap();
    assert_eq!((key_id, *proven.expose_secret()), (id("k1"), [1; 32]));
}

#[test]
fn time_runs_out() {
    let mut proof = announced();
    let end = proof.poll_timeout().unwrap();
    proof.handle_timeout(end - Duration::from_millis(1));
    assert_eq!(proof.state(), ProofState::Pending);
    proof.handle_timeout(end);
    assert_eq!(proof.state(), ProofState::Failed(ProofFailure::Timeout("sae-a".to_owned())));
}

#[test]
fn enc_keys_is_repeated_only_where_no_key_can_be_lost() {
    for (kind, calls) in [
        (FailureKind::Ambiguous, 1),
        (FailureKind::Refused, 1),
        (FailureKind::Unauthorized, 1),
        (FailureKind::Unreachable, 3),
        (FailureKind::Unavailable, 3),
        (FailureKind::Busy, 3),
    ] {
        let mut proof = ClientProof::new(NOW, "sae-a", &exporters());
        let (mut now, mut made) = (NOW, 0);
        while proof.state() == ProofState::Pending {
            if let Some(request) = proof.poll_request(now) {
                made += 1;
                proof.handle_answer(now, failed(request, kind));
            }
            now += Duration::from_millis(100);
        }
        assert_eq!(made, calls, "{kind:?}");
        let ProofState::Failed(failure) = proof.state() else { panic!() };
        assert!(failure.to_string().ends_with(kind.told()), "the KME's words stay here: {failure}");
        assert_eq!(failure.code(), 0x23);
    }
}

#[test]
fn the_client_answers_one_announcement_of_one_key() {
    let mut server = announced();
    let mut client = ProofResponder::new("sae-b", &exporters());
    let retire = KeyMessage::Failed { key_id: id("k1"), reason: String::new() };
    assert!(client.handle_message(NOW, &retire).is_err());
    assert!(client.handle_message(NOW, &KeyMessage::Announce(vec![id("k1"), id("k2")])).is_err());
    client.handle_message(NOW, &KeyMessage::Announce(vec![id("k1")])).unwrap();
    assert!(client.handle_message(NOW, &KeyMessage::Announce(vec![id("k2")])).is_err());
    let request = client.poll_request(NOW).unwrap();
    assert!(matches!(&request, KmeRequest::Dec { master, .. } if master == "sae-b"));
    assert_eq!(client.answered(), None);
    client.handle_answer(NOW, given(request, 1));
    assert_eq!(client.answered(), Some(Ok(())));
    server.handle_message(NOW, &client.poll_message().unwrap());
    assert_eq!(server.state(), ProofState::Proven);
}

#[test]
fn a_client_without_the_key_says_so() {
    let mut server = announced();
    let mut client = ProofResponder::new("sae-b", &exporters());
    client.handle_message(NOW, &KeyMessage::Announce(vec![id("k1")])).unwrap();
    let request = client.poll_request(NOW).unwrap();
    let outcome = Err(RequestFailure::new(FailureKind::Refused, "kme.lan:8443 says 400"));
    client.handle_answer(NOW, Answer { request, took: Duration::ZERO, outcome });
    assert_eq!(client.answered(), Some(Err("kme.lan:8443 says 400".to_owned())), "for the log");
    let message = client.poll_message().unwrap();
    assert!(!format!("{message:?}").contains("kme.lan"), "not for the peer: {message:?}");
    server.handle_message(NOW, &message);
    let ProofState::Failed(failure) = server.state() else { panic!() };
    assert!(matches!(failure, ProofFailure::ClientHasNoKey { .. }), "{failure}");
}
