//! Tests the proof of the client's name against peers that cannot give it, and KMEs that give no key.

use std::net::IpAddr;

use axon_tls::qkd::PskResolver;

use super::*;
use crate::{
    keys::{FailureKind, Lookup, proof},
    wire::link::samples::messages,
};

const NOW: Duration = Duration::from_secs(1);
const MODES: [KeyMode; 2] = [KeyMode::Session, KeyMode::Messages10];
/// The limit of the proof: 3 s, and four calls of 3 s.
const LIMIT: Duration = Duration::from_secs(15);
/// The READY exporter of the connection, at both ends.
const EXPORTER: [u8; 32] = [!1; 32];

/// Returns the READY of a client that has this key, on the connection with this exporter.
fn ready(key_id: &str, key: [u8; 32], exporter: [u8; 32]) -> LinkMessage {
    let (key_id, key) = (id(key_id), KmeKey::from_slice(&key).unwrap());
    let proof = proof::compute(&key, &key_id, &exporter);
    LinkMessage::Keys(KeyMessage::Ready { key_id, proof })
}

fn announce(key_ids: &[&str]) -> LinkMessage {
    LinkMessage::Keys(KeyMessage::Announce(key_ids.iter().map(|key_id| id(key_id)).collect()))
}

/// Returns `key-1` of the fake KMEs.
fn first_key() -> [u8; 32] {
    let mut key = [0; 32];
    key[3] = 1;
    key
}

/// Returns whether handshakes of sae-a from the client's address have to wait.
fn is_held_off(ring: &Keyring) -> bool {
    let resolver = ring.resolver(NOW, IpAddr::from([10, 0, 0, 1]));
    let identity = PskIdentity::new("sae-a", "another").unwrap().to_bytes();
    assert!(Arc::clone(&resolver).resolve(&identity).is_none());
    matches!(resolver.outcome(), Some(Lookup::Limited(which)) if which.contains("prove its name"))
}

/// Makes five servers in a row fail in this way. Returns whether handshakes then have to wait.
fn counts(key_mode: KeyMode, fail: impl Fn(&mut End, &mut Kmes)) -> bool {
    let settings = settings(Side::Server, Some(key_mode));
    let (mut ring, mut kmes) = (Keyring::new(&settings).unwrap(), Kmes::default());
    for number in 0..5 {
        assert!(!is_held_off(&ring), "{number}");
        let mut facts = facts(Side::Server, Some(key_mode));
        facts.negotiated = Some(psk(&format!("bootstrap-{number}")));
        let mut end = End::with(NOW, facts, &settings, Some(ring));
        end.opening.handle_recorded(NOW, true, end.ring.as_mut());
        end.hears(NOW, &LinkMessage::Hello(theirs(Side::Server, Some(key_mode))));
        fail(&mut end, &mut kmes);
        let End { opening, ring: after, .. } = end;
        drop(opening);
        ring = after.unwrap();
    }
    is_held_off(&ring)
}

#[test]
fn nothing_but_key_messages_and_keepalives_comes_during_the_proof() {
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            for message in messages() {
                let mut end = End::greeted(NOW, side, key_mode);
                end.hears(NOW, &message);
                match message {
                    LinkMessage::Keepalive => assert!(end.outcome(NOW).is_none()),
                    // An announcement of two keys, which the test below checks.
                    LinkMessage::Keys(KeyMessage::Announce(_)) if side == Side::Client => {}
                    _ => drop(end.refuses(NOW, "OUT_OF_ORDER")),
                }
            }
        }
    }
}

#[test]
fn ready_before_the_announcement_is_refused() {
    for key_mode in MODES {
        let mut end = End::greeted(NOW, Side::Server, key_mode);
        end.hears(NOW, &ready("key-1", first_key(), EXPORTER));
        end.refuses(NOW, "OUT_OF_ORDER");
    }
}

#[test]
fn nothing_but_the_right_proof_opens() {
    for key_mode in MODES {
        let announced = || End::announced(NOW, key_mode, &mut Kmes::default());
        let mut end = announced();
        end.hears(NOW, &ready("key-1", first_key(), EXPORTER));
        assert!(end.outcome(NOW).unwrap().is_ok());

        for (key, exporter) in [([9; 32], EXPORTER), (first_key(), [!2; 32])] {
            let mut end = announced();
            end.hears(NOW, &ready("key-1", key, exporter));
            let RefusedConnection { refusal, close } = end.refused(NOW);
            assert_eq!(refusal.name, "PROOF_FAILED");
            assert!(refusal.reason.contains("https://kme-of-sae-b"), "{refusal}");
            let (code, told) = close.unwrap();
            assert_eq!(code, CloseCode::Proof);
            assert!(!told.contains("kme") && !told.contains("sae"), "{told}");
            assert!(end.ring.as_mut().unwrap().receiver(LINK).is_none());
        }
        let mut end = announced();
        end.hears(NOW, &ready("key-2", first_key(), EXPORTER));
        end.refuses(NOW, "OUT_OF_ORDER");
    }
}

#[test]
fn proof_is_due_within_its_limit() {
    for key_mode in MODES {
        let server = End::announced(NOW, key_mode, &mut Kmes::default());
        for mut end in [server, End::greeted(NOW, Side::Client, key_mode)] {
            assert_eq!(end.opening.poll_timeout(), Some(NOW + LIMIT));
            let before = NOW + LIMIT - ms(1);
            end.opening.handle_timeout(before, end.ring.as_mut());
            assert!(end.outcome(before).is_none());
            end.opening.handle_timeout(NOW + LIMIT, end.ring.as_mut());
            assert_eq!(end.refuses(NOW + LIMIT, "KEY_SUPPLY"), "no proof within 15s");
            assert!(end.ring.as_mut().unwrap().receiver(LINK).is_none());
        }
    }
}

#[test]
fn kme_that_does_not_answer_is_waited_for_until_the_limit() {
    for key_mode in MODES {
        let mut server = End::greeted(NOW, Side::Server, key_mode);
        assert!(server.opening.poll_request(NOW).is_some());
        let mut client = End::greeted(NOW, Side::Client, key_mode);
        client.hears(NOW, &announce(&["key-1"]));
        assert!(!client.opening.reads());
        for end in [&mut server, &mut client] {
            end.opening.handle_timeout(NOW + LIMIT, end.ring.as_mut());
            end.refuses(NOW + LIMIT, "KEY_SUPPLY");
        }
    }
}

#[test]
fn failed_proofs_make_further_handshakes_wait() {
    type Way = fn(&mut End);
    for key_mode in MODES {
        let ways: [(&str, Way); 4] = [
            ("a wrong proof", |end| {
                while end.opening.poll_message().is_some() {}
                let Some(key_id) = &end.announced else { unreachable!() };
                end.hears(NOW, &ready(&key_id.to_string(), [9; 32], EXPORTER));
                assert_eq!(end.refused(NOW).refusal.name, "PROOF_FAILED");
            }),
            ("FAILED", |end| {
                let Some(key_id) = end.announced.clone() else { unreachable!() };
                let failed = KeyMessage::Failed { key_id, reason: "no".into() };
                end.hears(NOW, &LinkMessage::Keys(failed));
                end.refuses(NOW, "KEY_SUPPLY");
            }),
            ("the connection was lost", |end| {
                end.opening.handle_lost(NOW, &ConnectionError::Reset, end.ring.as_mut());
            }),
            ("the opening was dropped", |_| {}),
        ];
        for (name, way) in ways {
            let counted = counts(key_mode, |end, kmes| {
                end.ask(NOW, kmes);
                assert!(end.outcome(NOW).is_none());
                end.announced = std::iter::from_fn(|| end.opening.poll_message()).find_map(key_of);
                way(end);
            });
            assert!(counted, "{name}, {key_mode:?}");
        }
    }
}

/// Returns the key that a message announces.
fn key_of(message: LinkMessage) -> Option<KeyId> {
    match message {
        LinkMessage::Keys(KeyMessage::Announce(key_ids)) => key_ids.into_iter().next(),
        _ => None,
    }
}

#[test]
fn a_failed_proof_without_key_consumption_is_not_counted() {
    for key_mode in MODES {
        let counted = counts(key_mode, |end, kmes| {
            kmes.failures = vec![FailureKind::Refused];
            end.ask(NOW, kmes);
            let told = end.refuses(NOW, "KEY_SUPPLY");
            assert!(told.contains("its KME refused the request"), "{told}");
        });
        assert!(!counted, "{key_mode:?}");
    }
}

#[test]
fn client_takes_one_announcement() {
    let mut end = End::greeted(NOW, Side::Client, KeyMode::Session);
    end.hears(NOW, &announce(&["k1", "k2"]));
    end.refuses(NOW, "OUT_OF_ORDER");

    for key_mode in MODES {
        let mut end = End::greeted(NOW, Side::Client, key_mode);
        end.hears(NOW, &announce(&["k1"]));
        assert!(!end.opening.reads(), "the next message waits in the stream");
        end.hears(NOW, &announce(&["k2"]));
        end.refuses(NOW, "INTERNAL");
    }
}

#[test]
fn client_whose_kme_has_no_key_says_so() {
    for key_mode in MODES {
        let mut pair = Pair::new(Some(key_mode));
        // The server's enc_keys succeeds, and the client's dec_keys fails.
        while pair.kmes.asked.is_empty() {
            pair.pass();
        }
        pair.kmes.failures = vec![FailureKind::Refused];
        pair.run();
        assert!(pair.said.contains(&(Side::Client, "FAILED")), "{:?}", pair.said);
        let server = pair.server.outcome.take().unwrap().unwrap_err();
        assert_eq!(server.refusal.name, "KEY_SUPPLY");
        assert!(server.refusal.reason.contains("its KME refused the request"), "{server:?}");
        match (key_mode, pair.client.outcome.take()) {
            (KeyMode::Session, Some(Err(client))) => assert_eq!(client.refusal.name, "KEY_SUPPLY"),
            // The client waits for the server to close, at most until its limit.
            (KeyMode::Messages10, None) => {
                assert_eq!(pair.client.opening.poll_timeout(), Some(pair.now + LIMIT));
            }
            (_, outcome) => panic!("{outcome:?}"),
        }
    }
}

#[test]
fn kmes_that_disagree_prove_nothing() {
    for key_mode in MODES {
        let mut pair = Pair::new(Some(key_mode));
        pair.kmes.disagree = true;
        pair.run();
        let server = pair.server.outcome.take().unwrap().unwrap_err();
        assert_eq!(server.refusal.name, "PROOF_FAILED");
    }
}

#[test]
fn call_that_cost_no_key_is_made_again() {
    for key_mode in MODES {
        let mut pair = Pair::new(Some(key_mode));
        pair.kmes.failures = vec![FailureKind::Unavailable; 2];
        pair.run_on();
        pair.client.opened();
        pair.server.opened();
        assert_eq!(pair.now, s(2), "half a second after each failure");
    }
}

#[test]
fn connection_without_exporters_is_refused() {
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            let settings = settings(side, Some(key_mode));
            let facts = Handshake { exporters: None, ..facts(side, Some(key_mode)) };
            let mut end = End::with(NOW, facts, &settings, Keyring::new(&settings));
            end.opening.handle_recorded(NOW, true, end.ring.as_mut());
            end.hears(NOW, &LinkMessage::Hello(theirs(side, Some(key_mode))));
            assert_eq!(end.refuses(NOW, "INTERNAL"), "no TLS exporter");
        }
    }
}
