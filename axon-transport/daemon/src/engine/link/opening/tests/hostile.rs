//! Tests a peer, or an owner, that violates the protocol before the proof.

use bytes::Bytes;
use quinn_proto::{ApplicationClose, VarInt};

use super::*;
use crate::wire::link::samples::{elected, messages};

const NOW: Duration = Duration::from_secs(1);
const MODES: [Option<KeyMode>; 3] = [None, Some(KeyMode::Session), Some(KeyMode::Messages10)];

#[test]
fn nothing_precedes_hello() {
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            for message in messages().iter().skip(1) {
                let mut end = End::awaiting_hello(NOW, side, key_mode);
                end.hears(NOW, message);
                let told = end.refuses(NOW, "OUT_OF_ORDER");
                assert!(told.ends_with("is not allowed before HELLO"), "{told}");
            }
        }
    }
}

#[test]
fn hello_that_differs_is_refused_and_a_server_does_not_answer_it() {
    type Change = fn(&mut LinkHello);
    let cases: [(Change, &str); 6] = [
        (|h| h.domain += 1, "DOMAIN_MISMATCH"),
        (|h| (h.protocol_min, h.protocol_max) = (9, 9), "PROTOCOL_MISMATCH"),
        (|h| h.mode ^= 1, "MODE_MISMATCH"),
        (|h| h.expects = Some(DaemonId([9; 16])), "GOODBYE"),
        (|h| h.sae = Some("sae-x".into()), "SAE_MISMATCH"),
        (|h| h.cipher = 1, "CIPHER_MISMATCH"),
    ];
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            for (change, name) in cases {
                let mut end = End::awaiting_hello(NOW, side, key_mode);
                while end.opening.poll_message().is_some() {}
                let mut theirs = theirs(side, key_mode);
                change(&mut theirs);
                end.hears(NOW, &LinkMessage::Hello(theirs));
                end.refuses(NOW, name);
                assert!(end.opening.poll_message().is_none(), "{name}");
            }
        }
    }
}

#[test]
fn own_daemon_is_refused() {
    let mut end = End::awaiting_hello(NOW, Side::Server, None);
    end.hears(NOW, &LinkMessage::Hello(ours(Side::Server, &Config::default())));
    end.refuses(NOW, "SELF");
}

#[test]
fn hello_is_due_within_five_seconds() {
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            let mut end = End::awaiting_hello(NOW, side, key_mode);
            assert_eq!(end.opening.poll_timeout(), Some(NOW + s(5)));
            let before = NOW + s(5) - ms(1);
            end.opening.handle_timeout(before, end.ring.as_mut());
            assert!(end.outcome(before).is_none());
            end.opening.handle_timeout(NOW + s(5), end.ring.as_mut());
            assert_eq!(end.refuses(NOW + s(5), "OUT_OF_ORDER"), "no HELLO within 5 s");
        }
    }
}

#[test]
fn handshake_that_agreed_on_something_else_than_the_settings_is_refused() {
    type Change = fn(&mut Handshake);
    let cases: [Change; 4] = [
        |facts| facts.negotiated = None,
        |facts| facts.negotiated.as_mut().unwrap().cipher = Cipher::Aes256Gcm,
        |facts| facts.negotiated.as_mut().unwrap().key_exchange = KeyExchange::PskDheKe,
        |facts| facts.negotiated.as_mut().unwrap().alpn = b"axon/2".to_vec(),
    ];
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            for change in cases {
                let mut facts = facts(side, key_mode);
                change(&mut facts);
                let settings = settings(side, key_mode);
                let mut end = End::with(NOW, facts, &settings, Keyring::new(&settings));
                end.refuses(NOW, "INTERNAL");
                assert!(end.opening.poll_message().is_none(), "no HELLO");
                let record = end.ring.as_mut().and_then(Keyring::poll_record);
                assert_eq!(record, None, "no key is spent");
            }
        }
    }
}

#[test]
fn host_with_unreadable_trust_file_tells_the_peer_less_than_its_log() {
    let settings = Config::default();
    let closed = Some("/etc/axon/trust: permission denied".to_owned());
    let (facts, ours) = (facts(Side::Server, None), ours(Side::Server, &settings));
    let mut opening = Opening::new(NOW, facts, ours, &settings, closed, None);
    let refused = opening.poll_outcome(NOW, None).unwrap().unwrap_err();
    assert!(refused.refusal.reason.contains("/etc/axon/trust"));
    let (code, told) = refused.close.unwrap();
    assert_eq!(code, CloseCode::NotAllowed);
    assert!(!told.contains("/etc"), "{told}");
}

#[test]
fn psk_that_completed_a_handshake_before_is_refused() {
    for key_mode in [KeyMode::Session, KeyMode::Messages10] {
        let mut first = End::awaiting_hello(NOW, Side::Server, Some(key_mode));
        let settings = settings(Side::Server, Some(key_mode));
        let facts = facts(Side::Server, Some(key_mode));
        let mut second = End::with(NOW, facts, &settings, first.ring.take());
        second.refuses(NOW, "KEY_REUSED");
    }
}

#[test]
fn psk_that_an_earlier_daemon_had_is_refused() {
    let mut end = End::new(NOW, Side::Server, Some(KeyMode::Session));
    assert!(!end.opening.reads(), "HELLO waits for the ledger");
    assert_eq!(end.opening.poll_timeout(), None);
    let record = end.ring.as_mut().unwrap().poll_record();
    assert_eq!(record, Some((LINK, "bootstrap".to_owned())));
    end.opening.handle_recorded(NOW, false, end.ring.as_mut());
    end.refuses(NOW, "KEY_REUSED");
    // A second answer of the ledger changes nothing.
    end.opening.handle_recorded(NOW, true, end.ring.as_mut());
    assert!(!end.opening.reads());
}

#[test]
fn identity_of_another_form_is_refused() {
    let settings = settings(Side::Server, Some(KeyMode::Session));
    for identity in [None, Some(b"axon-qkd-v1:sae-a".to_vec())] {
        let mut facts = facts(Side::Server, Some(KeyMode::Session));
        facts.negotiated.as_mut().unwrap().psk_identity = identity;
        End::with(NOW, facts, &settings, Keyring::new(&settings)).refuses(NOW, "INTERNAL");
    }
}

#[test]
fn qkd_without_keys_opens_nothing() {
    for key_mode in [KeyMode::Session, KeyMode::Messages10] {
        for side in [Side::Client, Side::Server] {
            let settings = settings(side, Some(key_mode));
            let mut end = End::with(NOW, facts(side, Some(key_mode)), &settings, None);
            end.refuses(NOW, "INTERNAL");

            // A peer that claims no SAE is refused too.
            let mut end = End::awaiting_hello(NOW, side, Some(key_mode));
            end.ring = None;
            let theirs = LinkHello { sae: None, ..theirs(side, Some(key_mode)) };
            end.hears(NOW, &LinkMessage::Hello(theirs));
            assert!(end.outcome(NOW).unwrap().is_err());
        }
    }
}

#[test]
fn message_that_is_read_too_early_ends_the_opening() {
    let key_mode = Some(KeyMode::Session);
    let mut end = End::new(NOW, Side::Server, key_mode);
    end.hears(NOW, &LinkMessage::Hello(theirs(Side::Server, key_mode)));
    end.refuses(NOW, "INTERNAL");

    // The message arrives after the opening succeeded, and before its owner knows.
    let mut end = End::awaiting_hello(NOW, Side::Server, None);
    end.hears(NOW, &LinkMessage::Hello(theirs(Side::Server, None)));
    end.hears(NOW, &elected());
    end.refuses(NOW, "INTERNAL");
}

#[test]
fn bytes_that_are_no_frame_end_the_opening() {
    for (error, name) in [
        (FrameError::TooLarge { length: 5000, limit: 4096 }, "TOO_LARGE"),
        (FrameError::Empty, "MALFORMED"),
    ] {
        let mut end = End::awaiting_hello(NOW, Side::Server, None);
        end.opening.handle_unreadable(NOW, error, None);
        end.refuses(NOW, name);
    }
}

#[test]
fn control_stream_that_ends_closes_the_connection() {
    let mut end = End::awaiting_hello(NOW, Side::Client, None);
    end.opening.handle_ended(NOW, "stream finished early", None);
    let RefusedConnection { refusal, close } = end.refused(NOW);
    assert_eq!((refusal.by, &*refusal.name), (RefusedBy::Network, "unreachable"));
    assert_eq!(refusal.reason, "the control stream ended: stream finished early");
    assert!(matches!(close, Some((CloseCode::Internal, _))));
}

#[test]
fn connection_that_the_peer_closed_is_not_closed_again() {
    let closed = ConnectionError::ApplicationClosed(ApplicationClose {
        error_code: VarInt::from_u32(CloseCode::Domain.code()),
        reason: Bytes::from_static(b"another domain"),
    });
    for key_mode in MODES {
        for side in [Side::Client, Side::Server] {
            let mut end = End::new(NOW, side, key_mode);
            end.opening.handle_lost(NOW, &closed, end.ring.as_mut());
            let RefusedConnection { refusal, close } = end.refused(NOW);
            assert_eq!((refusal.by, &*refusal.name), (RefusedBy::Peer, "DOMAIN_MISMATCH"));
            assert_eq!((&*refusal.reason, close), ("another domain", None));
        }
    }
}

#[test]
fn events_after_the_end_change_nothing() {
    let mut end = End::greeted(NOW, Side::Server, KeyMode::Session);
    end.opening.handle_lost(NOW, &ConnectionError::Reset, end.ring.as_mut());
    assert_eq!(end.refused(NOW).refusal.name, "reset");
    for message in messages() {
        end.hears(NOW, &message);
    }
    end.opening.handle_recorded(NOW, true, end.ring.as_mut());
    end.opening.handle_timeout(NOW + s(100), end.ring.as_mut());
    end.opening.handle_unreadable(NOW, FrameError::Empty, end.ring.as_mut());
    end.opening.handle_lost(NOW, &ConnectionError::Reset, end.ring.as_mut());
    let request = KmeRequest::Status { slave: "sae-a".to_owned() };
    end.opening.handle_answer(NOW, Kmes::default().answer(request), end.ring.as_mut());
    assert!(end.outcome(NOW).is_none());
}

#[test]
fn certificate_must_name_the_host_in_ca() {
    let chain = |name: &str| {
        let made = rcgen::generate_simple_self_signed([name.to_owned()]).unwrap();
        vec![made.cert.der().clone()]
    };
    let mut settings = Config::default();
    let Security::Classic(classic) = &mut settings.security else { unreachable!() };
    classic.auth = ClassicAuth::Ca;
    for side in [Side::Client, Side::Server] {
        for (chain, good) in [
            (Vec::new(), false),
            (chain("robot-9"), false),
            (chain("*.lan"), false),
            (chain("robot-1.lan"), true),
        ] {
            let facts = Handshake { chain, ..facts(side, None) };
            let mut end = End::with(NOW, facts, &settings, None);
            let theirs = LinkHello { host: "Robot-1.LAN".into(), ..ours(side.peer(), &settings) };
            end.hears(NOW, &LinkMessage::Hello(theirs));
            if good {
                assert!(end.outcome(NOW).unwrap().is_ok());
            } else {
                let told = end.refuses(NOW, "NOT_ALLOWED");
                assert!(told.contains("\"Robot-1.LAN\""), "{told}");
            }
        }
    }
}
