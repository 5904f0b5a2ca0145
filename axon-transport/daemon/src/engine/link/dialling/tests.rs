//! Tests dials against every outcome of a handshake, on a clock that the test moves.

use axon_tls::qkd::Psk;
use axon_transport::config::{Config, KeyMode, QkdPeers, Security};
use quinn_proto::{ConnectionClose, TransportErrorCode};

use super::*;
use crate::{
    engine::{
        keyring::{
            Answered,
            tests::{Kmes, config, id, keyring, ms, s},
        },
        refusal::RefusedBy,
    },
    keys::{FailureKind, KmeAnswer},
};

fn address(number: u8) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, number], 61300))
}

fn target(sae: Option<&str>, addresses: u8) -> DialTarget {
    DialTarget {
        daemon: None,
        sae: sae.map(Into::into),
        addresses: (1..=addresses).map(address).collect(),
        listed: false,
        standing: None,
        replaces: None,
        beside: None,
    }
}

/// Returns the error of a handshake that the peer, or this side, ended with a TLS alert.
fn alert(code: u8) -> ConnectionError {
    ConnectionError::ConnectionClosed(ConnectionClose {
        error_code: TransportErrorCode::crypto(code),
        frame_type: None,
        reason: Default::default(),
    })
}

/// A dial with its clock.
struct Dialled {
    now: Duration,
    dial: Dialling,
    ring: Option<Keyring>,
    kmes: Kmes,
}

impl Dialled {
    fn classic(addresses: u8) -> Self {
        let dial = Dialling::new(s(0), target(None, addresses), None);
        Self { now: s(0), dial, ring: None, kmes: Kmes::default() }
    }

    fn qkd(sae: Option<&str>, addresses: u8) -> Self {
        let ring = keyring("sae-a", KeyMode::Session);
        let dial = Dialling::new(s(0), target(sae, addresses), Some(&ring));
        Self { now: s(0), dial, ring: Some(ring), kmes: Kmes::default() }
    }

    /// Returns the next action at this time.
    fn poll(&mut self) -> Option<DialAction> {
        loop {
            let action = self.dial.poll_action(self.now, self.ring.as_mut());
            let Some(ring) = &mut self.ring else { return action };
            let Some((origin, request)) = ring.poll_request(self.now) else { return action };
            assert!(action.is_none());
            let answer = self.kmes.answer(request);
            let answered = ring.handle_answer(self.now, KmeAnswer { origin, answer });
            assert!(matches!(answered, Answered::Dialler));
            self.dial.handle_key();
        }
    }

    /// Returns the next action, and moves the clock to it.
    fn next(&mut self) -> DialAction {
        for _ in 0..1000 {
            if let Some(action) = self.poll() {
                return action;
            }
            let due = self.dial.poll_timeout().expect("the dial goes on");
            assert!(due > self.now, "the timer does not spin");
            self.now = due;
        }
        panic!("no action")
    }

    fn connects(&mut self) -> (SocketAddr, Option<Arc<DialKey>>) {
        match self.next() {
            DialAction::Connect { address, attempt } => (address, attempt),
            other => panic!("{other:?}"),
        }
    }

    fn abandons(&mut self) {
        match self.next() {
            DialAction::Close { code: CloseCode::Goodbye, reason: "" } => {}
            other => panic!("{other:?}"),
        }
    }

    #[track_caller]
    fn fails(&mut self) -> Refusal {
        match self.next() {
            DialAction::Failed(refusal) => {
                assert!(self.poll().is_none(), "a dial fails once");
                assert_eq!(self.dial.poll_timeout(), None);
                refusal
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn dial_without_an_address_fails() {
    let refusal = Dialled::classic(0).fails();
    assert_eq!((refusal.by, &*refusal.reason), (RefusedBy::Network, "no address to dial"));
}

#[test]
fn each_address_has_five_seconds_and_the_last_reason_counts() {
    let mut dialled = Dialled::classic(2);
    assert_eq!(dialled.connects().0, address(1));
    dialled.now = s(5) - ms(1);
    assert!(dialled.poll().is_none());
    dialled.abandons();
    assert_eq!(dialled.now, s(5));
    assert_eq!(dialled.connects().0, address(2));
    dialled.dial.handle_failed(&ConnectionError::TimedOut);
    let refusal = dialled.fails();
    assert_eq!(refusal.reason, "10.0.0.2:61300 does not answer");
    assert_eq!(dialled.now, s(5), "what QUIC gave up is not waited for");
}

#[test]
fn unreachable_addresses_are_passed_over() {
    let mut dialled = Dialled::classic(2);
    dialled.connects();
    dialled.dial.handle_unreachable(None);
    assert_eq!(dialled.connects().0, address(2));
    dialled.dial.handle_unreachable(Some(&ConnectError::CidsExhausted));
    let refusal = dialled.fails();
    assert!(refusal.reason.starts_with("10.0.0.2:61300: "), "{refusal}");

    let mut dialled = Dialled::classic(1);
    dialled.connects();
    dialled.dial.handle_unreachable(None);
    assert!(dialled.fails().reason.contains("AXON_BIND_ADDRS"));
}

#[test]
fn peer_that_refuses_at_one_address_is_not_dialled_at_the_next() {
    let mut dialled = Dialled::classic(2);
    dialled.connects();
    dialled.dial.handle_failed(&alert(120));
    let refusal = dialled.fails();
    assert_eq!((refusal.by, refusal.alert), (RefusedBy::Peer, Some(120)));
}

#[test]
fn whole_dial_ends_after_twenty_seconds() {
    let mut dialled = Dialled::classic(9);
    for number in 1..=4 {
        assert_eq!(dialled.connects().0, address(number));
        dialled.abandons();
    }
    assert_eq!(dialled.fails().reason, "no answer within 20s");
    assert_eq!(dialled.now, s(20));

    // The limit is reached during a handshake.
    let mut dialled = Dialled::classic(9);
    dialled.connects();
    dialled.now = s(3);
    dialled.dial.handle_failed(&ConnectionError::TimedOut);
    for _ in 0..3 {
        dialled.connects();
        dialled.abandons();
    }
    dialled.connects();
    dialled.abandons();
    assert_eq!(dialled.now, s(20));
    assert_eq!(dialled.fails().reason, "no answer within 20s");
}

#[test]
fn events_of_a_connection_that_was_given_up_are_ignored() {
    let mut dialled = Dialled::classic(2);
    dialled.dial.handle_connected();
    dialled.dial.handle_failed(&alert(40));
    dialled.connects();
    dialled.abandons();
    dialled.dial.handle_connected();
    dialled.dial.handle_failed(&alert(40));
    dialled.dial.handle_unreachable(None);
    dialled.dial.handle_key();
    assert_eq!(dialled.connects().0, address(2));
    dialled.dial.handle_connected();
    dialled.dial.handle_failed(&alert(40));
    assert!(matches!(dialled.next(), DialAction::Open));
    dialled.dial.handle_failed(&alert(40));
    assert!(dialled.poll().is_none());
    assert_eq!(dialled.dial.poll_timeout(), None);
}

#[test]
fn settings_that_make_no_client_end_the_dial() {
    let mut dialled = Dialled::classic(2);
    dialled.connects();
    dialled.dial.handle_unusable("no suite");
    let refusal = dialled.fails();
    assert_eq!((&*refusal.name, &*refusal.reason), ("INTERNAL", "no suite"));
}

#[test]
fn peer_without_an_sae_id_and_unlisted_saes_are_not_dialled() {
    let refusal = Dialled::qkd(None, 1).fails();
    assert_eq!(refusal.name, "MODE_MISMATCH");

    let mut settings = config("sae-a", KeyMode::Session);
    if let Security::Qkd(qkd) = &mut settings.security {
        qkd.peers = QkdPeers::Listed(["sae-c".to_owned()].into());
    }
    for sae in ["sae-a", "sae-b"] {
        let mut dialled = Dialled::qkd(Some(sae), 1);
        dialled.ring = Keyring::new(&settings);
        assert_eq!(dialled.fails().name, "NOT_ALLOWED", "{sae}");
        assert!(dialled.kmes.asked.is_empty(), "{sae}");
    }
}

#[test]
fn dial_is_given_up_when_the_kme_is_in_its_backoff() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    dialled.kmes.failures = vec![FailureKind::Unavailable; 3];
    let refusal = dialled.fails();
    assert_eq!(refusal.name, "KEY_SUPPLY");
    assert!(refusal.reason.starts_with("enc_keys: "), "{refusal}");
    assert_eq!((dialled.kmes.asked.len(), dialled.now), (3, s(3)), "asked after 1 s and 2 s more");
}

#[test]
fn dial_whose_kme_does_not_answer_ends_with_its_limit() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    let mut polls = 0;
    while dialled.dial.poll_action(dialled.now, dialled.ring.as_mut()).is_none() {
        dialled.now = dialled.dial.poll_timeout().unwrap();
        polls += 1;
    }
    assert_eq!(dialled.now, s(26), "20 s and two calls of 3 s");
    assert!(polls <= 27, "{polls}");
}

#[test]
fn peer_that_has_no_key_yet_is_dialled_again_with_the_same_key() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    let (mut times, mut keys) = (Vec::new(), Vec::new());
    for _ in 0..4 {
        let (_, attempt) = dialled.connects();
        times.push(dialled.now);
        keys.push(attempt.unwrap().key_id.clone());
        dialled.dial.handle_failed(&alert(UNKNOWN_PSK_IDENTITY));
    }
    assert_eq!(times, [ms(0), ms(50), ms(150), ms(350)]);
    assert!(keys.iter().all(|key_id| *key_id == keys[0]));
    let (_, attempt) = dialled.connects();
    let psk: Arc<Psk> = Arc::clone(&attempt.unwrap().psk);
    assert!(!psk.is_erased());
    dialled.dial.handle_connected();
    assert!(matches!(dialled.next(), DialAction::Open));
    assert!(psk.is_erased(), "spent");
    assert_eq!(dialled.kmes.asked.len(), 1);
}

#[test]
fn key_that_the_peer_never_gets_is_given_up() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    while dialled.connects().1.unwrap().key_id == id("key-1") {
        dialled.dial.handle_failed(&alert(UNKNOWN_PSK_IDENTITY));
    }
    // Ten seconds of refusals, at most one more wait, and a second of backoff.
    assert!((s(11)..s(13)).contains(&dialled.now), "{:?}", dialled.now);
    assert_eq!(dialled.kmes.asked.len(), 2);
}

#[test]
fn key_that_the_peer_holds_differently_is_given_up_at_the_fourth_alert() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    for _ in 0..4 {
        let (_, attempt) = dialled.connects();
        assert_eq!(attempt.unwrap().key_id, id("key-1"));
        dialled.dial.handle_failed(&alert(DECRYPT_ERROR));
    }
    let (_, attempt) = dialled.connects();
    assert_eq!(attempt.unwrap().key_id, id("key-2"));
}

#[test]
fn silence_and_other_refusals_end_the_dial_and_keep_the_key() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 2);
    dialled.connects();
    dialled.dial.handle_failed(&ConnectionError::TimedOut);
    dialled.connects();
    dialled.abandons();
    assert!(dialled.fails().reason.contains("does not answer"));

    dialled.dial = Dialling::new(dialled.now, target(Some("sae-b"), 2), dialled.ring.as_ref());
    let (_, attempt) = dialled.connects();
    assert_eq!(attempt.unwrap().key_id, id("key-1"));
    dialled.dial.handle_failed(&alert(40));
    assert_eq!(dialled.fails().alert, Some(40));
    assert_eq!(dialled.kmes.asked.len(), 1);
}

#[test]
fn time_in_which_the_peer_is_silent_does_not_count_against_the_key() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    for _ in 0..10 {
        dialled.connects();
        dialled.dial.handle_failed(&alert(UNKNOWN_PSK_IDENTITY));
        let (_, attempt) = dialled.connects();
        assert_eq!(attempt.unwrap().key_id, id("key-1"));
        dialled.dial.handle_failed(&ConnectionError::Reset);
        assert_eq!(dialled.fails().name, "reset");
        dialled.now += s(4);
        dialled.dial = Dialling::new(dialled.now, target(Some("sae-b"), 1), dialled.ring.as_ref());
    }
}

#[test]
fn second_handshake_under_one_key_is_closed() {
    let mut dialled = Dialled::qkd(Some("sae-b"), 1);
    let mut other = Dialling::new(s(0), target(Some("sae-b"), 1), dialled.ring.as_ref());
    dialled.connects();
    let action = other.poll_action(dialled.now, dialled.ring.as_mut());
    assert!(matches!(action, Some(DialAction::Connect { attempt: Some(_), .. })), "{action:?}");
    other.handle_connected();
    assert!(matches!(
        other.poll_action(dialled.now, dialled.ring.as_mut()),
        Some(DialAction::Open)
    ));

    dialled.dial.handle_connected();
    match dialled.next() {
        DialAction::Close { code: CloseCode::KeyReused, reason } => assert!(!reason.is_empty()),
        other => panic!("{other:?}"),
    }
    assert_eq!(dialled.fails().name, "KEY_REUSED");
}

#[test]
fn classic_dial_opens_at_the_first_address_that_answers() {
    let mut dialled = Dialled::classic(3);
    assert!(dialled.connects().1.is_none());
    dialled.dial.handle_failed(&ConnectionError::TimedOut);
    assert_eq!(dialled.connects().0, address(2));
    dialled.dial.handle_connected();
    // The handshake completed in time, although the poll is late.
    dialled.now = s(100);
    assert!(matches!(dialled.next(), DialAction::Open));
    assert_eq!(dialled.dial.target().addresses.len(), 3);
    assert!(Keyring::new(&Config::default()).is_none());
}
