//! Tests random histories of a link against a model that is simple enough to be checked by reading.
//!
//! The model knows no cryptography. For every envelope it records how it was sealed, and for every opener which (key,
//! index) pairs have opened. The crate must agree with the model after any interleaving of sealing, loss, duplication,
//! reordering, forgery, RETIRE, time, restart and change of connection.

mod common;

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use axon_envelope::{
    Channel, Delivery, Header, IndexMask, KeyId, Kind, KmeKey, Opener, RefusalCause, RetireOutcome,
    Route, Sealer, TopicHash,
};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;

const GRACE: Duration = Duration::from_secs(5);
const OPENER_AGE: Duration = Duration::from_secs(3660);
const SEALER_AGE: Duration = Duration::from_secs(3600);

#[derive(Debug, Clone)]
enum Step {
    /// Both ends get the next key of their KMEs.
    NewKey,
    Seal {
        route: u8,
        reliable: bool,
        len: u16,
    },
    /// An envelope of any time arrives: again, late, early, or never if no step names it.
    Deliver {
        envelope: usize,
        route: Option<u8>,
    },
    /// An envelope arrives with one byte changed.
    Tampered {
        envelope: usize,
        at: usize,
        xor: u8,
    },
    /// The sender stops using its key and says so.
    Retire,
    /// RETIRE of an earlier key arrives again.
    RepeatRetire {
        key: usize,
    },
    Pass {
        millis: u32,
    },
    Expire,
    /// A new connection: new context; unused keys move on, begun ones end.
    Reconnect,
    /// The receiver restarts and gets the present key again, on a new connection.
    ReceiverRestart,
}

fn step() -> impl Strategy<Value = Step> {
    let any_envelope = any::<prop::sample::Index>().prop_map(|index| index.index(1 << 16));
    prop_oneof![
        2 => Just(Step::NewKey),
        16 => (0..6_u8, any::<bool>(), 0..200_u16)
            .prop_map(|(route, reliable, len)| Step::Seal { route, reliable, len }),
        16 => (any_envelope.clone(), prop::option::weighted(0.1, 0..6_u8))
            .prop_map(|(envelope, route)| Step::Deliver { envelope, route }),
        4 => (any_envelope, any::<usize>(), 1..=255_u8)
            .prop_map(|(envelope, at, xor)| Step::Tampered { envelope, at, xor }),
        2 => Just(Step::Retire),
        1 => (0..8_usize).prop_map(|key| Step::RepeatRetire { key }),
        3 => pass().prop_map(|millis| Step::Pass { millis }),
        2 => Just(Step::Expire),
        1 => Just(Step::Reconnect),
        1 => Just(Step::ReceiverRestart),
    ]
}

/// Generates milliseconds, including times right before, at and after each time limit.
fn pass() -> impl Strategy<Value = u32> {
    let edge = |limit: Duration| {
        let limit = limit.as_millis() as u32;
        prop::sample::select(vec![limit - 1, limit, limit + 1])
    };
    prop_oneof![
        3 => 0..4_000_u32,
        1 => edge(GRACE),
        1 => 60_000..3_000_000_u32,
        1 => edge(SEALER_AGE),
        2 => edge(OPENER_AGE),
        1 => 4_000_000..8_000_000_u32,
    ]
}

fn route(number: u8) -> Route {
    let kind = [Kind::Topic, Kind::Request, Kind::Response][usize::from(number % 3)];
    Route { kind, topic: TopicHash([number / 3; 16]) }
}

/// An envelope as it went out, and what it was.
struct Sent {
    bytes: Vec<u8>,
    plaintext: Vec<u8>,
    route: Route,
    key: u32,
    index: u8,
    connection: u8,
}

/// The model's view of a key that the opener holds or held.
#[derive(Default)]
struct Held {
    opened: HashSet<u8>,
    first: Option<Duration>,
    retire: Option<(Duration, IndexMask, IndexMask)>,
}

impl Held {
    fn may_open(&self, index: u8, now: Duration) -> bool {
        let in_time = match (self.retire, self.first) {
            (Some((at, used, _)), _) if now - at < GRACE => used.contains(index),
            (Some((at, _, reliable)), _) => now - at < OPENER_AGE && reliable.contains(index),
            (None, Some(first)) => now - first < OPENER_AGE,
            (None, None) => true,
        };
        in_time && !self.opened.contains(&index)
    }

    fn is_live(&self, now: Duration) -> bool {
        (0..10).any(|index| self.may_open(index, now))
    }
}

/// A rule about time or repetition that decided over an authentic envelope.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Edge {
    Replayed,
    OtherConnection,
    AgedWithoutRetire,
    BestEffortInGrace,
    BestEffortAfterGrace,
    ReliableAfterGrace,
    /// In the last minute of the 61.
    ReliableInTime,
    ReliableOverTime,
}

struct World {
    now: Duration,
    connection: u8,
    keys_made: u32,
    sealer: Option<(u32, Sealer, Option<Duration>)>,
    opener: Opener,
    held: HashMap<u32, Held>,
    sent: Vec<Sent>,
    retired: Vec<(u32, IndexMask, IndexMask)>,
    /// Over the whole history, restarts included.
    nonces: HashSet<(u32, u8, [u8; 12])>,
    opened_ever: HashSet<usize>,
    edges: HashSet<Edge>,
}

fn channel(connection: u8) -> Channel {
    Channel::new("alice", "bob", [connection; 32]).unwrap()
}

fn key_id(key: u32) -> KeyId {
    KeyId::new(format!("key-{key}")).unwrap()
}

fn kme_key(key: u32) -> KmeKey {
    let mut bytes = [0; 32];
    bytes[..4].copy_from_slice(&key.to_be_bytes());
    KmeKey::take(&mut bytes)
}

impl World {
    fn new() -> Self {
        Self {
            now: Duration::from_secs(1),
            connection: 0,
            keys_made: 0,
            sealer: None,
            opener: Opener::new(channel(0)).unwrap(),
            held: HashMap::new(),
            sent: Vec::new(),
            retired: Vec::new(),
            nonces: HashSet::new(),
            opened_ever: HashSet::new(),
            edges: HashSet::new(),
        }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::NewKey => self.new_key(),
            Step::Seal { route: number, reliable, len } => self.seal(route(number), reliable, len),
            Step::Deliver { envelope, route: expected } => self.deliver(envelope, expected),
            Step::Tampered { envelope, at, xor } => self.tampered(envelope, at, xor),
            Step::Retire => self.retire(),
            Step::RepeatRetire { key } => {
                if let Some(&(key, used, reliable)) = self.retired.get(key) {
                    self.retire_arrives(key, used, reliable);
                }
            }
            Step::Pass { millis } => self.now += Duration::from_millis(millis.into()),
            Step::Expire => {
                self.opener.expire(self.now);
                let live = self.held.values().filter(|held| held.is_live(self.now)).count();
                assert_eq!(self.opener.key_count(), live);
            }
            Step::Reconnect => self.reconnect(),
            Step::ReceiverRestart => self.receiver_restart(),
        }
    }

    fn new_key(&mut self) {
        self.retire();
        let key = self.keys_made;
        self.keys_made += 1;
        let channel = channel(self.connection);
        let sealer = Sealer::new(&channel, key_id(key), kme_key(key)).unwrap();
        self.sealer = Some((key, sealer, None));
        self.opener.add_key(key_id(key), kme_key(key)).unwrap();
        self.held.insert(key, Held::default());
    }

    fn seal(&mut self, route: Route, reliable: bool, len: u16) {
        let Some((key, sealer, first)) = &mut self.sealer else { return };
        let delivery = if reliable { Delivery::Reliable } else { Delivery::BestEffort };
        let number = sealer.mask_used().len();
        let too_old = first.is_some_and(|first| self.now - first >= SEALER_AGE);
        let plaintext: Vec<u8> = (0..len).map(|at| at as u8 ^ self.sent.len() as u8).collect();
        let mut bytes = vec![0; sealer.overhead() + plaintext.len()];
        let slot = match sealer.slot(self.now, delivery) {
            Ok(slot) => {
                assert!(number < 10 && !too_old, "sealed too often or too long");
                slot
            }
            Err(_) => {
                assert!(number == 10 || too_old, "refused to seal for no reason");
                return;
            }
        };
        let index = slot.index();
        match number % 3 {
            0 => {
                slot.seal_into(route, &[&plaintext], &mut bytes).unwrap();
            }
            1 => {
                let (head, tail) = plaintext.split_at(plaintext.len() / 3);
                slot.seal_into(route, &[head, tail], &mut bytes).unwrap();
            }
            _ => {
                let at = bytes.len() - 16 - plaintext.len();
                bytes[at..][..plaintext.len()].copy_from_slice(&plaintext);
                slot.seal_in_place(route, &mut bytes).unwrap();
            }
        }
        assert_eq!(usize::from(index), number);
        assert_eq!(sealer.mask_reliable().contains(index), reliable);
        first.get_or_insert(self.now);

        let (header, _) = Header::parse(&bytes).unwrap();
        assert!(self.nonces.insert((*key, self.connection, header.nonce)), "a nonce twice");
        let (key, connection) = (*key, self.connection);
        self.sent.push(Sent { bytes, plaintext, route, key, index, connection });
    }

    /// Returns the model's result for an authentic envelope under the route for which it was sealed.
    fn expected(&self, sent: &Sent) -> Result<(), &'static [RefusalCause]> {
        match self.held.get(&sent.key) {
            None => Err(&[RefusalCause::UnknownKey]),
            Some(held) if !held.is_live(self.now) => {
                Err(&[RefusalCause::Retired, RefusalCause::Replayed])
            }
            Some(held) if held.opened.contains(&sent.index) => Err(&[RefusalCause::Replayed]),
            Some(held) if !held.may_open(sent.index, self.now) => Err(&[RefusalCause::Retired]),
            Some(_) if sent.connection != self.connection => Err(&[RefusalCause::Unauthentic]),
            Some(_) => Ok(()),
        }
    }

    fn edge(&self, sent: &Sent) -> Option<Edge> {
        let held = self.held.get(&sent.key)?;
        if held.opened.contains(&sent.index) {
            return Some(Edge::Replayed);
        }
        if sent.connection != self.connection {
            return held.may_open(sent.index, self.now).then_some(Edge::OtherConnection);
        }
        let Some((at, _, reliable)) = held.retire else {
            let too_old = held.first.is_some_and(|first| self.now - first >= OPENER_AGE);
            return too_old.then_some(Edge::AgedWithoutRetire);
        };
        let age = self.now - at;
        Some(match (reliable.contains(sent.index), age < GRACE) {
            (false, true) => Edge::BestEffortInGrace,
            (false, false) => Edge::BestEffortAfterGrace,
            (true, _) if age >= OPENER_AGE => Edge::ReliableOverTime,
            (true, _) if age >= SEALER_AGE => Edge::ReliableInTime,
            (true, false) => Edge::ReliableAfterGrace,
            (true, true) => return None,
        })
    }

    fn deliver(&mut self, envelope: usize, expected_route: Option<u8>) {
        if self.sent.is_empty() {
            return;
        }
        let number = envelope % self.sent.len();
        let sent = &self.sent[number];
        let edge = self.edge(sent);
        let expected_route = expected_route.map_or(sent.route, route);
        let expected = if expected_route == sent.route {
            self.expected(sent)
        } else {
            Err(&[RefusalCause::WrongRoute][..])
        };
        if expected_route == sent.route {
            self.edges.extend(edge);
        }
        let mut out = vec![0xaa; sent.plaintext.len()];
        let result = if number.is_multiple_of(2) {
            self.opener.open_into(self.now, expected_route, &sent.bytes, &mut out)
        } else {
            let mut bytes = sent.bytes.clone();
            self.opener.open_in_place(self.now, expected_route, &mut bytes).map(|plaintext| {
                out.copy_from_slice(plaintext);
                plaintext.len()
            })
        };
        match (result, expected) {
            (Ok(len), Ok(())) => {
                assert_eq!((len, &out), (sent.plaintext.len(), &sent.plaintext));
                assert!(self.opened_ever.insert(number), "a message opened twice");
                let held = self.held.get_mut(&sent.key).unwrap();
                held.opened.insert(sent.index);
                held.first.get_or_insert(self.now);
            }
            (Err(error), Err(causes)) => {
                let cause = error.cause().expect("the header is well formed");
                assert!(causes.contains(&cause), "{cause:?} instead of {causes:?}");
            }
            (result, expected) => panic!("{result:?} where the model says {expected:?}"),
        }
    }

    fn tampered(&mut self, envelope: usize, at: usize, xor: u8) {
        if self.sent.is_empty() {
            return;
        }
        let sent = &self.sent[envelope % self.sent.len()];
        let mut bytes = sent.bytes.clone();
        let at = at % bytes.len();
        bytes[at] ^= xor;
        let route = Header::parse(&bytes).map_or(sent.route, |(header, _)| header.route);
        assert!(self.opener.open_in_place(self.now, route, &mut bytes).is_err(), "byte {at}");
    }

    fn retire(&mut self) {
        let Some((key, sealer, _)) = self.sealer.take() else { return };
        let retirement = sealer.retire();
        self.retired.push((key, retirement.used, retirement.reliable));
        self.retire_arrives(key, retirement.used, retirement.reliable);
    }

    fn retire_arrives(&mut self, key: u32, used: IndexMask, reliable: IndexMask) {
        let id = key_id(key);
        let result = self.opener.retire(self.now, id.as_bytes(), used, reliable).unwrap();
        match self.held.get_mut(&key) {
            Some(held) if held.is_live(self.now) => {
                held.retire.get_or_insert((self.now, used, reliable));
                match result {
                    RetireOutcome::Waiting(mask) => {
                        let can = (0..10).filter(|i| held.may_open(*i, self.now)).count();
                        assert_eq!(mask.len(), can);
                    }
                    _ => assert!(result == RetireOutcome::Erased && !held.is_live(self.now)),
                }
            }
            _ => assert_eq!(result, RetireOutcome::NotHeld),
        }
    }

    fn reconnect(&mut self) {
        self.connection += 1;
        let unused = self.sealer.take().and_then(|(key, sealer, _)| match sealer.into_unused() {
            Ok((id, bytes)) => Some((key, id, bytes)),
            Err(sealer) => {
                assert!(!sealer.mask_used().is_empty());
                None
            }
        });
        let mut next: Opener = Opener::new(channel(self.connection)).unwrap();
        self.held.clear();
        if let Some((key, id, bytes)) = unused {
            let (theirs, theirs_bytes) = self.opener.take_unused(id.as_bytes()).unwrap();
            assert_eq!(theirs, id);
            next.add_key(theirs, theirs_bytes).unwrap();
            self.held.insert(key, Held::default());
            let sealer = Sealer::new(&channel(self.connection), id, bytes).unwrap();
            self.sealer = Some((key, sealer, None));
        }
        self.opener = next;
    }

    /// Makes the receiver lose all memory. Even the keys that it is given again must not open earlier messages.
    fn receiver_restart(&mut self) {
        self.connection += 1;
        self.sealer = None;
        self.opener = Opener::new(channel(self.connection)).unwrap();
        self.held.clear();
        for key in 0..self.keys_made {
            self.opener.add_key(key_id(key), kme_key(key)).unwrap();
            self.held.insert(key, Held::default());
        }
    }
}

fn histories() -> impl Strategy<Value = Vec<Step>> {
    prop::collection::vec(step(), 1..300)
}

fn live_through(steps: &[Step]) -> World {
    let mut world = World::new();
    world.new_key();
    for step in steps {
        world.step(step);
    }
    world
}

/// Random steps prove nothing about a rule that none of them comes near.
#[test]
fn the_histories_come_to_every_rule() {
    let mut runner = TestRunner::deterministic();
    let histories = histories();
    let mut reached = HashMap::new();
    for _ in 0..300 {
        let steps = histories.new_tree(&mut runner).unwrap().current();
        for edge in live_through(&steps).edges {
            *reached.entry(edge).or_insert(0) += 1;
        }
    }
    for edge in [
        Edge::Replayed,
        Edge::OtherConnection,
        Edge::AgedWithoutRetire,
        Edge::BestEffortInGrace,
        Edge::BestEffortAfterGrace,
        Edge::ReliableAfterGrace,
        Edge::ReliableInTime,
        Edge::ReliableOverTime,
    ] {
        let histories = reached.get(&edge).copied().unwrap_or(0);
        assert!(histories >= 5, "{edge:?} in {histories} of 300 histories: {reached:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn every_history_goes_as_the_model_says(steps in histories()) {
        live_through(&steps);
    }

    #[test]
    fn no_bytes_make_the_opener_panic_or_open(
        prefix in prop::sample::select(vec![&b""[..], b"AXQKD001", b"AXQKD001\0\0\0"]),
        noise in prop::collection::vec(any::<u8>(), 0..700),
    ) {
        let mut bytes = [prefix, &noise].concat();
        let route = Header::parse(&bytes).map_or(common::ROUTE, |(header, used)| {
            assert!(used <= bytes.len());
            header.route
        });
        let mut opener = common::opener("key", 1);
        let mut out = vec![0; bytes.len()];
        prop_assert!(opener.open_into(common::START, route, &bytes, &mut out).is_err());
        prop_assert!(opener.open_in_place(common::START, route, &mut bytes).is_err());
        let _ = axon_envelope::inner::Header::decode(&noise);
    }

    #[test]
    fn each_parsed_header_has_one_encoding(
        sender in prop::collection::vec(any::<u8>(), 1..=255),
        id in prop::collection::vec(any::<u8>(), 1..=255),
        number in 0..6_u8,
    ) {
        prop_assume!(sender != b"bob");
        let channel = Channel::new(&sender, "bob", []).unwrap();
        let mut sealer = Sealer::new(&channel, KeyId::new(&id).unwrap(), kme_key(1)).unwrap();
        let mut envelope = vec![0; sealer.overhead()];
        let slot = sealer.slot(common::START, Delivery::Reliable).unwrap();
        slot.seal_in_place(route(number), &mut envelope).unwrap();
        let (header, used) = Header::parse(&envelope).unwrap();
        prop_assert_eq!(used, sealer.header_len());
        prop_assert_eq!((header.sender, header.key_id), (&sender[..], &id[..]));
        prop_assert_eq!((header.route, header.index), (route(number), 0));
    }
}
