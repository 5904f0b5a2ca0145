use std::{
    collections::{HashMap, HashSet},
    time::Duration,
};

use axon_envelope::{Delivery, IndexMask, KeyId, Kind, KmeKey, OpenError, Route, TopicHash};
use proptest::prelude::*;

use super::{NoKey, Receiver, Sender, SupplyError};
use crate::keys::{
    Exporters, KeyMessage, Violation,
    request::{Answer, Failure, FailureKind, Fetched, Request, Stock},
};

const ROUTE: Route = Route { kind: Kind::Topic, topic: TopicHash([7; 16]) };

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn id(text: &str) -> KeyId {
    KeyId::new(text).unwrap()
}

/// The exporters of connection `conn`, the same at both ends.
fn exporters(conn: u64) -> Exporters {
    Exporters::new([conn as u8; 32], [!conn as u8; 32])
}

/// Two KMEs with one store between them. A key is given to the slave once, as most KMEs do.
#[derive(Default)]
struct Kmes {
    issued: u32,
    stored: HashMap<KeyId, [u8; 32]>,
    stock: u64,
    /// Keys left to give; `None`: any number.
    left: Option<u32>,
    /// How the next calls fail.
    failures: Vec<FailureKind>,
}

impl Kmes {
    fn answer(&mut self, request: Request) -> Answer {
        let failure = |kind| Err(Failure { kind, text: format!("{kind:?}") });
        let outcome = match (&request, self.failures.pop()) {
            (_, Some(kind)) => failure(kind),
            (Request::Status { .. }, _) => {
                Ok(Fetched::Stock(Stock { stored_key_count: self.stock, max_key_per_request: 128 }))
            }
            (Request::Enc { number, .. }, _) => {
                if self.left.is_some_and(|left| left < *number) {
                    failure(FailureKind::Unavailable)
                } else {
                    self.left = self.left.map(|left| left - number);
                    Ok(Fetched::Keys((0..*number).map(|_| self.issue()).collect()))
                }
            }
            (Request::Dec { key_ids, .. }, _) => {
                if key_ids.iter().all(|id| self.stored.contains_key(id)) {
                    let take = |id: &KeyId| {
                        let bytes = self.stored.remove(id).unwrap();
                        (id.clone(), KmeKey::from_slice(&bytes).unwrap())
                    };
                    Ok(Fetched::Keys(key_ids.iter().map(take).collect()))
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
}

struct Pair {
    now: Duration,
    kmes: Kmes,
    sender: Sender,
    receiver: Receiver,
    conn: u64,
    /// What was said in either direction.
    log: Vec<KeyMessage>,
}

impl Pair {
    fn new() -> Self {
        let mut pair = Self {
            now: ms(0),
            kmes: Kmes::default(),
            sender: Sender::new("sae-a", "sae-b").unwrap(),
            receiver: Receiver::new("sae-b", "sae-a").unwrap(),
            conn: 0,
            log: Vec::new(),
        };
        pair.connect();
        pair
    }

    /// The next connection; the one before stays open until `close` of it.
    fn connect(&mut self) {
        self.conn += 1;
        let owed = self.sender.attach(self.now, self.conn, &exporters(self.conn)).unwrap();
        self.receiver.attach(self.now, self.conn, &exporters(self.conn)).unwrap();
        for message in owed {
            self.receiver.on_message(self.now, self.conn - 1, &message).unwrap();
            self.log.push(message);
        }
    }

    fn close(&mut self, conn: u64) {
        self.sender.detach(self.now, conn);
        self.receiver.detach(self.now, conn);
    }

    /// Lets everything happen that can happen now.
    fn run(&mut self) {
        loop {
            if let Some(request) = self.sender.poll_request(self.now) {
                if let Request::Enc { number, .. } = request {
                    assert!(number <= 8, "a lost call loses at most eight keys");
                }
                let answer = self.kmes.answer(request);
                self.sender.on_answer(self.now, answer);
            } else if let Some(request) = self.receiver.poll_request(self.now) {
                let answer = self.kmes.answer(request);
                self.receiver.on_answer(self.now, answer);
            } else if let Some((conn, message)) = self.sender.poll_message(self.now) {
                if conn == self.conn {
                    self.receiver.on_message(self.now, conn, &message).unwrap();
                }
                self.log.push(message);
            } else if let Some((conn, message)) = self.receiver.poll_message() {
                self.sender.on_message(self.now, conn, &message).unwrap();
                self.log.push(message);
            } else {
                return;
            }
        }
    }

    fn seal(&mut self, delivery: Delivery) -> Result<Vec<u8>, NoKey> {
        let mut out = vec![0; 5 + self.sender.overhead()];
        let slot = self.sender.slot(self.now, delivery)?;
        let len = slot.seal_into(ROUTE, &[b"hello"], &mut out).unwrap();
        out.truncate(len);
        Ok(out)
    }

    fn open(&mut self, mut envelope: Vec<u8>) -> Result<(), OpenError> {
        let opener = self.receiver.opener(self.conn).expect("attached");
        opener.open_in_place(self.now, ROUTE, &mut envelope).map(|text| assert_eq!(text, b"hello"))
    }

    fn announced(&self) -> usize {
        let count = |m: &KeyMessage| match m {
            KeyMessage::Announce(key_ids) => key_ids.len(),
            _ => 0,
        };
        self.log.iter().map(count).sum()
    }

    fn failures(&self) -> usize {
        self.log.iter().filter(|m| matches!(m, KeyMessage::Failed { .. })).count()
    }
}

#[test]
fn nothing_is_sealed_before_ready() {
    let mut pair = Pair::new();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
    while let Some(request) = pair.sender.poll_request(pair.now) {
        let answer = pair.kmes.answer(request);
        pair.sender.on_answer(pair.now, answer);
    }
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None), "keys held, none announced");
    let (_, announce) = pair.sender.poll_message(pair.now).unwrap();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None), "announced, none READY");
    pair.receiver.on_message(pair.now, 1, &announce).unwrap();
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_wrong_proof_ends_the_link_and_readies_nothing() {
    let mut pair = Pair::new();
    while let Some(request) = pair.sender.poll_request(pair.now) {
        let answer = pair.kmes.answer(request);
        pair.sender.on_answer(pair.now, answer);
    }
    let (_, KeyMessage::Announce(key_ids)) = pair.sender.poll_message(pair.now).unwrap() else {
        panic!()
    };
    for proof in [[0; 32], [0xff; 32]] {
        let ready = KeyMessage::Ready { key_id: key_ids[0].clone(), proof };
        let refused = pair.sender.on_message(pair.now, 1, &ready);
        assert!(matches!(refused, Err(SupplyError::Violation(Violation::WrongProof(_)))));
    }
    let unknown = KeyMessage::Ready { key_id: id("nobody's"), proof: [0; 32] };
    pair.sender.on_message(pair.now, 1, &unknown).unwrap();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
    for unexpected in [KeyMessage::Announce(vec![id("k")]), retire("k", 0, 0)] {
        assert!(pair.sender.on_message(pair.now, 1, &unexpected).is_err());
    }
}

fn retire(key_id: &str, used: u16, reliable: u16) -> KeyMessage {
    let mask = |bits| IndexMask::from_bits(bits).unwrap();
    KeyMessage::Retire { key_id: id(key_id), used: mask(used), reliable: mask(reliable) }
}

#[test]
fn the_last_keys_are_kept_for_reliable() {
    let mut pair = Pair::new();
    pair.kmes.left = Some(4);
    pair.run();
    let mut best_effort = 0;
    while pair.seal(Delivery::BestEffort).is_ok() {
        best_effort += 1;
    }
    assert_eq!(best_effort, 20, "two keys of four");
    assert_eq!(pair.sender.available(pair.now, Delivery::BestEffort), 0);
    assert_eq!(pair.sender.available(pair.now, Delivery::Reliable), 20);
    assert_eq!(pair.seal(Delivery::BestEffort), Err(NoKey::Reserved));
    let mut reliable = 0;
    while pair.seal(Delivery::Reliable).is_ok() {
        reliable += 1;
    }
    assert_eq!(reliable, 20);
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
}

#[test]
fn an_empty_store_is_asked_for_less_and_less_often() {
    let mut pair = Pair::new();
    pair.kmes.left = Some(0);
    pair.sender.demand(pair.now, 10_000);
    let mut asked = Vec::new();
    for _ in 0..10_000 {
        while let Some(request) = pair.sender.poll_request(pair.now) {
            if let Request::Enc { number, .. } = request {
                asked.push(number);
            }
            let answer = pair.kmes.answer(request);
            pair.sender.on_answer(pair.now, answer);
        }
        pair.now += ms(10);
    }
    assert!(asked.len() < 80, "{} calls in 100 s", asked.len());
    assert_eq!(asked[0], 8);
    assert_eq!(asked.last(), Some(&1));
    pair.kmes.left = Some(3);
    pair.now += ms(2000);
    pair.run();
    assert_eq!(pair.announced(), 3, "what there is, is had");
}

#[test]
fn a_call_that_may_have_lost_keys_is_not_repeated_at_once() {
    let mut pair = Pair::new();
    pair.sender.poll_request(pair.now).map(|status| pair.kmes.answer(status)).unwrap();
    let request = pair.sender.poll_request(pair.now).unwrap();
    pair.kmes.failures = vec![FailureKind::Ambiguous];
    let answer = pair.kmes.answer(request);
    pair.sender.on_answer(pair.now, answer);
    assert!(pair.sender.poll_request(pair.now + ms(999)).is_none());
    assert!(pair.sender.poll_request(pair.now + ms(1000)).is_some());
}

#[test]
fn a_batch_with_an_unknown_key_is_fetched_one_by_one() {
    let mut pair = Pair::new();
    let known: Vec<KeyId> = (0..3).map(|_| pair.kmes.issue().0).collect();
    let announce = KeyMessage::Announce(vec![known[0].clone(), id("lost"), known[1].clone()]);
    pair.receiver.on_message(pair.now, 1, &announce).unwrap();
    let mut said = Vec::new();
    while let Some(request) = pair.receiver.poll_request(pair.now) {
        let answer = pair.kmes.answer(request);
        pair.receiver.on_answer(pair.now, answer);
    }
    while let Some((_, message)) = pair.receiver.poll_message() {
        said.push(message);
    }
    assert_eq!(said.len(), 3);
    let failed = said
        .iter()
        .filter(|m| matches!(m, KeyMessage::Failed { key_id, .. } if *key_id == id("lost")));
    assert_eq!(failed.count(), 1);
}

#[test]
fn dec_keys_is_tried_three_times_with_the_same_ids() {
    let mut pair = Pair::new();
    let (key_id, _) = pair.kmes.issue();
    pair.kmes.failures = vec![FailureKind::Ambiguous, FailureKind::Unreachable];
    pair.receiver.on_message(pair.now, 1, &KeyMessage::Announce(vec![key_id])).unwrap();
    let mut tries = 0;
    for _ in 0..10 {
        while let Some(request) = pair.receiver.poll_request(pair.now) {
            tries += 1;
            let answer = pair.kmes.answer(request);
            pair.receiver.on_answer(pair.now, answer);
        }
        pair.now += ms(1000);
    }
    assert_eq!(tries, 3);
    assert!(matches!(pair.receiver.poll_message(), Some((1, KeyMessage::Ready { .. }))));

    pair.kmes.failures = vec![FailureKind::Unreachable; 9];
    pair.receiver.on_message(pair.now, 1, &KeyMessage::Announce(vec![id("k")])).unwrap();
    for _ in 0..10 {
        while let Some(request) = pair.receiver.poll_request(pair.now) {
            let answer = pair.kmes.answer(request);
            pair.receiver.on_answer(pair.now, answer);
        }
        pair.now += ms(1000);
    }
    assert_eq!(pair.kmes.failures.len(), 6);
    assert!(matches!(pair.receiver.poll_message(), Some((1, KeyMessage::Failed { .. }))));
}

#[test]
fn unused_keys_move_to_the_next_connection_without_another_dec_keys() {
    let mut pair = Pair::new();
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    let announced = pair.announced();
    let stored = pair.kmes.stored.len();
    pair.connect();
    assert!(matches!(pair.log.last(), Some(KeyMessage::Retire { .. })), "the begun one ends");
    pair.run();
    assert_eq!(pair.failures(), 0);
    assert_eq!(pair.kmes.stored.len(), stored, "nothing was fetched twice");
    assert_eq!(pair.announced(), announced + 3 + 1, "three move, one is new");
    // What was sealed on the old connection opens there, and there only.
    let mut copy = envelope.clone();
    assert!(pair.open(envelope).is_err());
    let old = pair.receiver.opener(1).unwrap();
    old.open_in_place(pair.now, ROUTE, &mut copy).unwrap();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn unused_keys_survive_a_lost_connection() {
    let mut pair = Pair::new();
    pair.run();
    pair.seal(Delivery::Reliable).unwrap();
    pair.close(1);
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::Detached));
    pair.now += ms(60_000);
    pair.connect();
    pair.run();
    assert_eq!(pair.failures(), 0);
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_restarted_receiver_costs_the_keys_and_no_more() {
    let mut pair = Pair::new();
    pair.run();
    pair.close(1);
    pair.receiver = Receiver::new("sae-b", "sae-a").unwrap();
    pair.connect();
    pair.run();
    assert_eq!(pair.failures(), 4, "the KME gave them to the receiver before");
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_key_in_use_ends_after_an_hour() {
    let mut pair = Pair::new();
    pair.run();
    pair.seal(Delivery::Reliable).unwrap();
    pair.now += Duration::from_secs(3599);
    pair.run();
    assert!(!pair.log.iter().any(|m| matches!(m, KeyMessage::Retire { .. })));
    pair.now += Duration::from_secs(1);
    pair.run();
    let retire = pair.log.iter().find_map(|m| match m {
        KeyMessage::Retire { used, reliable, .. } => Some((used.bits(), reliable.bits())),
        _ => None,
    });
    assert_eq!(retire, Some((1, 1)));
    pair.seal(Delivery::Reliable).unwrap();
}

#[test]
fn an_announcement_that_nobody_answers_is_dropped() {
    let mut pair = Pair::new();
    while let Some(request) = pair.sender.poll_request(pair.now) {
        let answer = pair.kmes.answer(request);
        pair.sender.on_answer(pair.now, answer);
    }
    assert!(matches!(pair.sender.poll_message(pair.now), Some((1, KeyMessage::Announce(_)))));
    assert_eq!(pair.sender.statistics(pair.now).announced, 4);
    pair.now += ms(60_000);
    assert!(matches!(pair.sender.poll_message(pair.now), Some((1, KeyMessage::Retire { .. }))));
    assert_eq!(pair.sender.statistics(pair.now).announced, 0);
}

#[test]
fn a_peer_that_only_announces_is_stopped_at_the_cap() {
    let mut pair = Pair::new();
    for i in 0..600 {
        let key_ids = (0..16).map(|j| id(&format!("flood-{i}-{j}"))).collect();
        pair.receiver.on_message(pair.now, 1, &KeyMessage::Announce(key_ids)).unwrap();
    }
    assert_eq!(pair.receiver.statistics().fetching, 4096);
    assert_eq!(pair.receiver.statistics().failed, 600 * 16 - 4096);
    let mut in_flight = 0;
    while pair.receiver.poll_request(pair.now).is_some() {
        in_flight += 1;
    }
    assert_eq!(in_flight, 4);
}

#[test]
fn contradicting_masks_end_the_link() {
    let mut pair = Pair::new();
    pair.run();
    let first = pair.log.iter().find_map(|m| match m {
        KeyMessage::Ready { key_id, .. } => Some(key_id.to_string()),
        _ => None,
    });
    let key_id = first.unwrap();
    assert!(pair.receiver.on_message(pair.now, 1, &retire(&key_id, 1, 2)).is_err());
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
    assert!(
        pair.receiver.on_message(pair.now, 1, &retire(&key_id, 0, 0)).is_err(),
        "index 0 opened"
    );
    pair.receiver.on_message(pair.now, 1, &retire("never-seen", 3, 1)).unwrap();
    assert!(pair.receiver.on_message(pair.now, 9, &retire(&key_id, 1, 1)).is_err(), "no such link");
}

#[derive(Clone, Debug)]
enum Step {
    Seal { reliable: bool, arrives: bool },
    Pass(u32),
    Run,
    Fail(u8),
    Connect,
    Lose,
    Dry(Option<u32>),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        20 => (any::<bool>(), any::<bool>())
            .prop_map(|(reliable, arrives)| Step::Seal { reliable, arrives }),
        2 => (0u32..5_000).prop_map(Step::Pass),
        1 => (0u32..4_000_000).prop_map(Step::Pass),
        6 => Just(Step::Run),
        2 => any::<u8>().prop_map(Step::Fail),
        1 => Just(Step::Connect),
        1 => Just(Step::Lose),
        1 => proptest::option::of(0u32..20).prop_map(Step::Dry),
    ];
    proptest::collection::vec(step, 1..300)
}

proptest! {
    /// No key seals an eleventh message, none is sealed under that is not READY on this very
    /// connection, none on two connections, and whatever is sealed opens.
    #[test]
    fn keys_are_used_as_they_should(steps in steps()) {
        let mut pair = Pair::new();
        let mut used: HashMap<String, (u64, u32)> = HashMap::new();
        let mut seen_indexes = HashSet::new();
        for step in steps {
            match step {
                Step::Seal { reliable, arrives } => {
                    let delivery = if reliable { Delivery::Reliable } else { Delivery::BestEffort };
                    pair.sender.demand(pair.now, 1);
                    let Ok(envelope) = pair.seal(delivery) else { continue };
                    let (header, _) = axon_envelope::Header::parse(&envelope).unwrap();
                    let name = String::from_utf8(header.key_id.to_vec()).unwrap();
                    prop_assert!(seen_indexes.insert((name.clone(), header.index)), "an index twice");
                    let (conn, messages) = used.entry(name.clone()).or_insert((pair.conn, 0));
                    *messages += 1;
                    prop_assert!(*messages <= 10, "an eleventh message");
                    prop_assert_eq!(*conn, pair.conn, "one key on two connections");
                    let said = |m: &KeyMessage| matches!(m, KeyMessage::Ready { key_id, .. } if key_id.as_bytes() == name.as_bytes());
                    prop_assert!(pair.log.iter().any(said), "not READY");
                    if arrives || reliable {
                        pair.open(envelope).unwrap();
                    }
                }
                Step::Pass(millis) => pair.now += ms(millis.into()),
                Step::Run => pair.run(),
                Step::Fail(n) => {
                    let kinds = [FailureKind::Ambiguous, FailureKind::Unavailable, FailureKind::Refused, FailureKind::Busy];
                    pair.kmes.failures = vec![kinds[n as usize % 4]; n as usize / 32];
                }
                Step::Connect => { pair.connect(); let conn = pair.conn - 1; pair.run(); pair.close(conn); }
                Step::Lose => { let conn = pair.conn; pair.close(conn); pair.connect(); }
                Step::Dry(left) => pair.kmes.left = left,
            }
            pair.receiver.expire(pair.now);
            let s = pair.sender.statistics(pair.now);
            prop_assert!(s.ready + s.announced + s.asked <= 4096);
        }
    }
}
