//! Tests keyrings with two KMEs between them, and a clock that stands still.

use axon_envelope::{Delivery, Kind, Route, TopicHash};
use axon_tls::qkd::{PskIdentity, PskResolver};
use axon_transport::config::QkdPeers;

use super::*;
use crate::keys::{FailureKind, Fetched, KeyPurpose, Lookup, NoKey, RequestFailure};

const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };

pub(crate) fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

pub(crate) fn s(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

/// Returns the settings of SAE `sae`, which links with every other SAE.
pub(crate) fn config(sae: &str, key_mode: KeyMode) -> Config {
    let mut config = Config::default();
    let kme = format!("https://kme-of-{sae}");
    let mut qkd = QkdConfig::new(sae, QkdPeers::Any, kme, "ca", "cert", "key");
    (qkd.key_mode, qkd.kme_connect_timeout, qkd.kme_answer_timeout) = (key_mode, s(3), s(3));
    config.security = Security::Qkd(qkd);
    config
}

pub(crate) fn keyring(sae: &str, key_mode: KeyMode) -> Keyring {
    Keyring::new(&config(sae, key_mode)).unwrap()
}

/// Returns exporters of connection `number`, the same at both ends.
pub(crate) fn exporters(number: u8) -> Exporters {
    Exporters::new([number; 32], [!number; 32])
}

pub(crate) fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

/// Two KMEs with one store between them. A key is given to the slave once, as most KMEs do.
#[derive(Default)]
pub(crate) struct Kmes {
    issued: u32,
    stored: HashMap<KeyId, [u8; 32]>,
    /// The failures of the next calls, the last element first.
    pub(crate) failures: Vec<FailureKind>,
    /// Whether `dec_keys` gives other keys than `enc_keys` did.
    pub(crate) disagree: bool,
    /// All requests that were answered.
    pub(crate) asked: Vec<KmeRequest>,
}

impl Kmes {
    pub(crate) fn answer(&mut self, request: KmeRequest) -> Answer {
        self.asked.push(request.clone());
        let failure = |kind| Err(RequestFailure::new(kind, format!("{kind:?}")));
        let outcome = match (&request, self.failures.pop()) {
            (_, Some(kind)) => failure(kind),
            (KmeRequest::Status { .. }, None) => failure(FailureKind::Unavailable),
            (KmeRequest::Enc { number, .. }, None) => {
                Ok(Fetched::Keys((0..*number).map(|_| self.issue()).collect()))
            }
            (KmeRequest::Dec { key_ids, .. }, None) => {
                if key_ids.iter().all(|key_id| self.stored.contains_key(key_id)) {
                    Ok(Fetched::Keys(key_ids.iter().map(|key_id| self.take(key_id)).collect()))
                } else {
                    failure(FailureKind::Refused)
                }
            }
        };
        Answer { request, took: ms(10), outcome }
    }

    fn issue(&mut self) -> (KeyId, KmeKey) {
        self.issued += 1;
        let mut bytes = [0; 32];
        bytes[..4].copy_from_slice(&self.issued.to_be_bytes());
        let key_id = id(&format!("key-{}", self.issued));
        self.stored.insert(key_id.clone(), bytes);
        (key_id, KmeKey::take(&mut bytes))
    }

    fn take(&mut self, key_id: &KeyId) -> (KeyId, KmeKey) {
        let mut bytes = self.stored.remove(key_id).unwrap();
        bytes[31] ^= u8::from(self.disagree);
        (key_id.clone(), KmeKey::take(&mut bytes))
    }
}

/// Two keyrings of SAEs that have a connection, on which each message arrives.
struct Pair {
    now: Duration,
    kmes: Kmes,
    rings: [Keyring; 2],
    /// The messages that the keyrings sent, with the index of the sender.
    said: Vec<(usize, u64, KeyMessage)>,
}

impl Pair {
    fn new() -> Self {
        let rings = ["sae-a", "sae-b"].map(|sae| keyring(sae, KeyMode::Messages10));
        Self { now: s(1), kmes: Kmes::default(), rings, said: Vec::new() }
    }

    /// Opens connection `number` at both ends and elects it.
    fn connect(&mut self, number: u8) {
        for (at, peer) in [(0, "sae-b"), (1, "sae-a")] {
            let (ring, connection) = (&mut self.rings[at], u64::from(number));
            ring.attach_receiver(self.now, connection, peer, &exporters(number)).unwrap();
            ring.attach_sender(self.now, connection, &exporters(number), None).unwrap();
        }
    }

    /// Lets everything happen that can happen now.
    fn run(&mut self) {
        loop {
            let mut quiet = true;
            for at in [0, 1] {
                while let Some((origin, request)) = self.rings[at].poll_request(self.now) {
                    let event = KmeAnswer { origin, answer: self.kmes.answer(request) };
                    assert!(matches!(
                        self.rings[at].handle_answer(self.now, event),
                        Answered::Here
                    ));
                    quiet = false;
                }
                while let Some((connection, message)) = self.rings[at].poll_message(self.now) {
                    self.rings[1 - at].handle_message(self.now, connection, &message).unwrap();
                    self.said.push((at, connection, message));
                    quiet = false;
                }
            }
            if quiet {
                return;
            }
        }
    }

    fn seal(&mut self, at: usize, connection: u64) -> Result<Vec<u8>, NoKey> {
        let now = self.now;
        let sender = self.rings[at].sender(connection).ok_or(NoKey::Detached)?;
        let mut out = vec![0; 5 + sender.overhead()];
        let slot = sender.slot(now, Delivery::Reliable)?;
        let length = slot.seal_into(ROUTE, &[b"hello"], &mut out).unwrap();
        out.truncate(length);
        Ok(out)
    }

    fn open(&mut self, at: usize, connection: u64, envelope: &mut [u8]) -> bool {
        let receiver = self.rings[at].receiver(connection).unwrap();
        let opener = receiver.opener(connection).unwrap();
        opener.open_in_place(self.now, ROUTE, envelope).is_ok_and(|text| text == b"hello")
    }

    fn changed(&mut self, at: usize) -> Vec<u64> {
        let now = self.now;
        std::iter::from_fn(|| self.rings[at].poll_changed(now)).collect()
    }
}

fn identity(sae: &str, key_id: &str) -> Vec<u8> {
    PskIdentity::new(sae, key_id).unwrap().to_bytes()
}

#[test]
fn message_on_a_connection_without_a_receiver_is_refused() {
    let mut pair = Pair::new();
    pair.connect(1);
    let key_id = id("k");
    for message in [
        KeyMessage::Announce(vec![key_id.clone()]),
        KeyMessage::Ready { key_id: key_id.clone(), proof: [0; 32] },
        KeyMessage::Failed { key_id, reason: String::new() },
    ] {
        let result = pair.rings[0].handle_message(pair.now, 2, &message);
        assert!(matches!(result, Err(SupplyError::Unattached(2))), "{message:?}");
    }
    pair.rings[0].forget_connection(pair.now, 1);
    let announce = KeyMessage::Announce(vec![id("k")]);
    assert!(pair.rings[0].handle_message(pair.now, 1, &announce).is_err());
    assert!(pair.rings[0].attach_sender(pair.now, 1, &exporters(1), None).is_err());
    assert!(pair.rings[0].sender(1).is_none() && pair.rings[0].receiver(1).is_none());
    assert!(pair.rings[0].poll_request(pair.now).is_none(), "no key is fetched for it");
}

#[test]
fn own_sae_id_makes_no_channel() {
    let mut ring = keyring("sae-a", KeyMode::Messages10);
    assert!(ring.attach_receiver(s(0), 1, "sae-a", &exporters(1)).is_err());
    assert!(ring.receiver(1).is_none());
}

#[test]
fn psk_is_spent_once_and_its_key_id_is_recorded_once() {
    let mut ring = keyring("sae-b", KeyMode::Session);
    let bytes = identity("sae-a", "k1");
    assert_eq!(ring.spent(s(0), 7, &bytes, "k1"), Completion::First);
    assert_eq!(ring.spent(s(0), 8, &bytes, "k1"), Completion::Reused);
    assert_eq!(ring.spent(s(0), 9, b"junk", "k1"), Completion::Reused);
    assert_eq!(ring.poll_record(), Some((7, "k1".to_owned())));
    assert_eq!(ring.poll_record(), None);
}

#[test]
fn answer_for_an_unknown_peer_is_ignored() {
    let mut ring = keyring("sae-a", KeyMode::Messages10);
    for origin in [RequestOrigin::Sender(0), RequestOrigin::Receiver(u64::MAX)] {
        let request = KmeRequest::Status { slave: "sae-b".to_owned() };
        let answer = Kmes::default().answer(request);
        assert!(matches!(ring.handle_answer(s(0), KmeAnswer { origin, answer }), Answered::Here));
    }
}

#[test]
fn answers_reach_the_machine_that_asked() {
    let (mut ring, mut kmes) = (keyring("sae-b", KeyMode::Session), Kmes::default());
    // A handshake under a key that is not at hand, and a dial.
    kmes.issue();
    let resolver = ring.resolver(s(0), [10, 0, 0, 1].into());
    let bytes = identity("sae-a", "key-1");
    assert!(Arc::clone(&resolver).resolve(&bytes).is_none());
    assert!(matches!(ring.dial(s(0), "sae-c"), DialDecision::Wait { .. }));
    let mut origins = Vec::new();
    while let Some((origin, request)) = ring.poll_request(s(0)) {
        let answer = kmes.answer(request);
        let answered = ring.handle_answer(s(0), KmeAnswer { origin, answer });
        origins.push((origin, matches!(answered, Answered::Dialler)));
    }
    assert_eq!(origins, [(RequestOrigin::Acceptor, false), (RequestOrigin::Dialler, true)]);
    assert!(resolver.resolve(&bytes).is_some());
    assert!(matches!(ring.dial(s(0), "sae-c"), DialDecision::Attempt(_)));

    let request = KmeRequest::Enc { slave: "sae-a".into(), number: 1, purpose: KeyPurpose::Proof };
    for origin in [RequestOrigin::Proof(5), RequestOrigin::Responder(5)] {
        let event = KmeAnswer { origin, answer: kmes.answer(request.clone()) };
        assert!(matches!(ring.handle_answer(s(0), event), Answered::Opening(5, _)));
    }
}

#[test]
fn acceptor_has_the_time_of_the_engine_which_never_goes_back() {
    let (mut ring, mut kmes) = (keyring("sae-b", KeyMode::Session), Kmes::default());
    let (key_id, _) = kmes.issue();
    let bytes = identity("sae-a", &key_id.to_string());
    let resolver = ring.resolver(s(100), [10, 0, 0, 1].into());
    assert!(Arc::clone(&resolver).resolve(&bytes).is_none());
    let (origin, request) = ring.poll_request(s(50)).unwrap();
    let _ = ring.handle_answer(s(100), KmeAnswer { origin, answer: kmes.answer(request) });
    ring.handle_timeout(s(159));
    let psk = Arc::clone(&resolver).resolve(&bytes).expect("kept for a minute");
    assert_eq!(resolver.outcome(), Some(Lookup::Found));
    // The timer of the keyring erases it.
    let due = ring.poll_timeout();
    assert!(due <= s(160));
    ring.handle_timeout(due);
    assert!(psk.is_erased());
}

#[test]
fn keys_are_fetched_announced_and_used_in_both_directions() {
    let mut pair = Pair::new();
    pair.connect(1);
    assert_eq!(pair.seal(0, 1), Err(NoKey::None));
    pair.changed(0);
    pair.run();
    assert_eq!(pair.changed(0), [1], "said once, however many keys are READY");
    for (from, to) in [(0, 1), (1, 0)] {
        let mut envelope = pair.seal(from, 1).unwrap();
        let mut copy = envelope.clone();
        assert!(pair.open(to, 1, &mut envelope));
        assert!(!pair.open(to, 1, &mut copy), "an envelope opens once");
    }
}

#[test]
fn keys_move_to_the_successor_and_retires_go_to_the_old_connection() {
    let mut pair = Pair::new();
    pair.connect(1);
    pair.run();
    let old = pair.seal(0, 1).unwrap();
    pair.said.clear();
    pair.connect(2);
    assert_eq!(pair.seal(0, 1), Err(NoKey::Detached), "sealed for 2 it opens nowhere on 1");
    pair.run();
    let retires = |(at, connection, message): &(usize, u64, KeyMessage)| {
        (*at, *connection) == (0, 1) && matches!(message, KeyMessage::Retire { .. })
    };
    assert!(pair.said.iter().any(retires), "the begun key is retired where it was used");
    assert!(pair.open(1, 1, &mut old.clone()), "what was sent on it still opens");
    let mut new = pair.seal(0, 2).unwrap();
    assert!(!pair.open(1, 1, &mut new.clone()));
    assert!(pair.open(1, 2, &mut new));
}

#[test]
fn nothing_is_said_on_a_connection_that_ended() {
    let mut pair = Pair::new();
    pair.connect(1);
    pair.run();
    pair.seal(0, 1).unwrap();
    pair.connect(2);
    pair.rings[0].forget_connection(pair.now, 1);
    pair.rings[0].forget_connection(pair.now, 1);
    while let Some((connection, _)) = pair.rings[0].poll_message(pair.now) {
        assert_eq!(connection, 2);
    }
}

#[test]
fn adopted_key_seals_before_any_other_key_comes() {
    let mut pair = Pair::new();
    let (key_id, key) = pair.kmes.issue();
    let announce = KeyMessage::Announce(vec![key_id.clone()]);
    for (at, peer) in [(0, "sae-b"), (1, "sae-a")] {
        pair.rings[at].attach_receiver(pair.now, 1, peer, &exporters(1)).unwrap();
    }
    pair.rings[1].handle_message(pair.now, 1, &announce).unwrap();
    let (origin, request) = pair.rings[1].poll_request(pair.now).unwrap();
    let event = KmeAnswer { origin, answer: pair.kmes.answer(request) };
    let _ = pair.rings[1].handle_answer(pair.now, event);
    assert_eq!(pair.changed(1), [1], "the key came");
    pair.rings[0].attach_sender(pair.now, 1, &exporters(1), Some((key_id, key))).unwrap();
    assert_eq!(pair.changed(0), [1]);
    let mut envelope = pair.seal(0, 1).unwrap();
    assert!(pair.open(1, 1, &mut envelope));
}

#[test]
fn failed_call_is_repeated_by_the_timer() {
    let mut ring = keyring("sae-b", KeyMode::Messages10);
    let mut kmes = Kmes { failures: vec![FailureKind::Unreachable], ..Kmes::default() };
    let (key_id, _) = kmes.issue();
    // Between two of the ticks that poll every machine.
    let mut now = ms(300);
    ring.attach_receiver(now, 1, "sae-a", &exporters(1)).unwrap();
    ring.handle_message(now, 1, &KeyMessage::Announce(vec![key_id])).unwrap();
    let mut times = Vec::new();
    for _ in 0..1000 {
        if let Some((origin, request)) = ring.poll_request(now) {
            times.push(now);
            let _ = ring.handle_answer(now, KmeAnswer { origin, answer: kmes.answer(request) });
            continue;
        }
        if matches!(ring.poll_message(now), Some((1, KeyMessage::Ready { .. }))) {
            break;
        }
        let due = ring.poll_timeout();
        assert!(due > now, "the timer does not spin");
        now = due;
        ring.handle_timeout(now);
    }
    assert_eq!(times, [ms(300), ms(2300)]);
}

#[test]
fn keys_that_the_kmes_disagree_about_are_never_used() {
    let mut pair = Pair::new();
    pair.kmes.disagree = true;
    pair.connect(1);
    pair.run();
    assert_eq!(pair.seal(0, 1), Err(NoKey::None));
    let status = pair.rings[0].status(pair.now, &Statistics::default(), &used());
    assert!(status["peers"]["sae-b"]["sending"]["disagreed"].as_u64().unwrap() > 0, "{status}");
}

#[test]
fn status_names_each_peer_the_kme_and_the_ledger() {
    let mut pair = Pair::new();
    pair.connect(1);
    pair.run();
    let status = pair.rings[1].status(pair.now, &Statistics::default(), &used());
    assert!(status["peers"]["sae-a"]["sending"]["ready"].as_u64().unwrap() > 0, "{status}");
    assert!(status["peers"]["sae-a"]["receiving"]["held"].as_u64().unwrap() > 0, "{status}");
    assert_eq!(status["kme"]["keys_proof"], 0);
    assert_eq!(status["used_keys"]["key_ids"], 0);
}

fn used() -> UsedStatistics {
    crate::keys::UsedKeys::in_memory().statistics()
}

#[test]
fn classic_has_no_keyring() {
    assert!(Keyring::new(&Config::default()).is_none());
}

/// Sends a message between two keyrings every 20 ms. All calls of the keyring `hangs` that begin within five seconds of
/// `begin` are given up after the answer limit. Returns the longest time without a message, and the number of these
/// calls.
fn longest_pause(hangs: usize, begin: Duration) -> (Duration, usize) {
    const ANSWER_LIMIT: Duration = Duration::from_secs(3);
    let mut pair = Pair::new();
    pair.connect(1);
    pair.run();
    let hang = begin..begin + s(5);
    let (mut given_up, mut last, mut longest) = (0, pair.now, Duration::ZERO);
    let mut answers: Vec<(Duration, usize, KmeAnswer)> = Vec::new();
    while pair.now < hang.end + s(20) {
        let now = pair.now;
        for at in [0, 1] {
            if pair.rings[at].poll_timeout() <= now {
                pair.rings[at].handle_timeout(now);
            }
        }
        for (_, at, event) in answers.extract_if(.., |(due, ..)| *due <= now) {
            let _ = pair.rings[at].handle_answer(now, event);
        }
        let mut quiet = false;
        while !mem::replace(&mut quiet, true) {
            for at in [0, 1] {
                while let Some((origin, request)) = pair.rings[at].poll_request(now) {
                    let mut due = now + ms(10);
                    if at == hangs && hang.contains(&now) {
                        due = now + ANSWER_LIMIT;
                        given_up += 1;
                        pair.kmes.failures.push(FailureKind::Unavailable);
                    }
                    answers.push((
                        due,
                        at,
                        KmeAnswer { origin, answer: pair.kmes.answer(request) },
                    ));
                    quiet = false;
                }
                while let Some((connection, message)) = pair.rings[at].poll_message(now) {
                    pair.rings[1 - at].handle_message(now, connection, &message).unwrap();
                    quiet = false;
                }
            }
        }
        if let Ok(mut envelope) = pair.seal(0, 1) {
            assert!(pair.open(1, 1, &mut envelope));
            (longest, last) = (longest.max(now - last), now);
        }
        pair.now += ms(20);
    }
    (longest.max(pair.now - last), given_up)
}

#[test]
fn messages_go_on_when_a_kme_does_within_the_answer_limit() {
    // The sender's KME gives new keys, the receiver's gives them by name.
    for hangs in [0, 1] {
        for phase in 0..25 {
            let (longest, given_up) = longest_pause(hangs, s(10) + ms(phase * 40));
            assert!(given_up > 0, "a call hangs");
            assert!(longest <= s(5) + s(3), "KME {hangs}, phase {phase}: {longest:?}");
        }
    }
}
