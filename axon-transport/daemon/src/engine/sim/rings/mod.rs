//! Models of a host's rings: publishers, subscriptions, relays and stand-ins, without shared memory.

mod reader;

use std::{
    cell::{Cell, RefCell},
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    rc::Rc,
    sync::Arc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use axon_shm::{
    Meta,
    ids::{Gid, SessionId},
    internal::MemoryBudget,
    qos::{Durability, History, Qos, Reliability},
};
use axon_transport::{
    EndpointSpec, MessageInfo,
    graph::{Endpoint, EndpointKind},
    internal::{
        OWNER, SessionKey,
        graph::{Pairing, pairing},
        session::Written,
    },
};

use self::reader::SimReader;
use crate::engine::rings::{RingError, RingReader, RingWriter, Rings};

/// Minimum capacity of a publisher's ring in samples; a larger depth extends it.
const RING: usize = 256;

/// A local publisher.
struct Publisher {
    endpoint: Arc<Endpoint>,
    published: u64,
    /// Publishes that found no room.
    refused: u64,
    history: VecDeque<(u64, Vec<u8>)>,
}

/// A local subscription, and all samples that reached it.
struct Subscription {
    endpoint: Arc<Endpoint>,
    /// The samples of each publisher, as they came.
    received: BTreeMap<Gid, Vec<u64>>,
    /// Samples that it takes before its ring is full; `None` takes all.
    room: Option<usize>,
}

#[derive(Default)]
struct State {
    publishers: BTreeMap<Gid, Publisher>,
    subscriptions: BTreeMap<Gid, Subscription>,
    readers: HashMap<String, Vec<Rc<Cursors>>>,
    /// The publishers and subscriptions of each topic.
    topics: HashMap<String, BTreeSet<Gid>>,
    /// Relays whose publishers have news for them.
    active: Vec<(Gid, Gid)>,
    /// Samples that were published while a relay stood for a subscription of a peer, by publisher and subscription.
    promised: BTreeMap<(Gid, Gid), Vec<u64>>,
    /// How often the engine asked a relay whether it has samples.
    looks: u64,
    /// Samples of each publisher up to this number are past their lifespan.
    expired: BTreeMap<Gid, u64>,
    /// Number of samples given up, by publisher.
    given_up: BTreeMap<Gid, u64>,
    /// Samples that came damaged.
    damaged: u64,
    /// Stand-ins that wrote samples and did not wake their readers.
    unannounced: BTreeSet<Gid>,
    /// RELIABLE samples that a stand-in wrote after a newer one, or twice.
    disordered: u64,
    next: u32,
    waits_for_room: bool,
    /// No relay and no stand-in can be opened.
    fails: bool,
    /// The daemon's process is ending without a word.
    is_killed: bool,
}

/// The positions up to which a relay has read and acknowledged each publisher.
struct Cursors {
    gid: Gid,
    spec: EndpointSpec,
    /// The subscriptions of a peer for which it reads.
    stands_for: RefCell<Vec<Gid>>,
    read: RefCell<HashMap<Gid, u64>>,
    /// Samples of each publisher that newer ones replaced before they were read, or that were passed over.
    lost: RefCell<HashMap<Gid, u64>>,
    acknowledged: RefCell<HashMap<Gid, u64>>,
    closed: Cell<bool>,
}

/// The rings of one host. Clones share them.
#[derive(Clone)]
pub(crate) struct SimRings {
    session: SessionId,
    key: Arc<SessionKey>,
    state: Rc<RefCell<State>>,
    /// The host's wall clock, which stamps samples.
    pub(super) wall: Rc<Cell<SystemTime>>,
}

/// The wall clock of a new host, since 1970: a day in 2026.
const TODAY: Duration = Duration::from_secs(1_790_000_000);
/// The first bytes of GIDs of a raw peer's endpoints. The rings do not check their samples.
pub(super) const FOREIGN: [u8; 12] = [0xaa; 12];

/// Returns the key that the run's seed determines.
pub(super) fn session_key(seed: &[u8; 32]) -> SessionKey {
    let packet = [&[OWNER, 0xa1, 0x00, 0x58, 0x20], &seed[..]].concat();
    SessionKey::from_packet(&packet).unwrap()
}

/// Returns the payload of a sample: its number, its publisher and filling, so that damage shows.
pub(super) fn payload(of: Gid, sequence: u64, length: usize) -> Vec<u8> {
    let mut payload = Vec::with_capacity(24 + length);
    payload.extend_from_slice(&of.0);
    payload.extend_from_slice(&sequence.to_be_bytes());
    let mut state = sequence ^ u64::from(of.0[15]) << 32 | 1;
    while payload.len() < 24 + length {
        // Xorshift: no compressor makes that shorter.
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let left = (24 + length - payload.len()).min(8);
        payload.extend_from_slice(&state.to_be_bytes()[..left]);
    }
    payload
}

/// Samples of topics whose names begin so become about a third as long when they are compressed. Others do not.
pub(super) const COMPRESSIBLE: &str = "/text";

/// Returns the sample of this number of a publisher.
fn payload_of(publisher: &Endpoint, sequence: u64, length: usize) -> Vec<u8> {
    let mut payload = payload(publisher.gid, sequence, length);
    if !publisher.topic.starts_with(COMPRESSIBLE) {
        return payload;
    }
    payload[24..].chunks_mut(48).for_each(|chunk| {
        let same = chunk[0];
        chunk.iter_mut().skip(16).for_each(|byte| *byte = same);
    });
    payload
}

impl SimRings {
    /// Creates the rings of a host whose sessions have this number.
    pub(crate) fn new(host: usize) -> Self {
        let mut seed = [0x51; 32];
        seed[24..].copy_from_slice(&(host as u64).to_be_bytes());
        let key = Arc::new(session_key(&seed));
        let wall = Rc::new(Cell::new(UNIX_EPOCH + TODAY));
        Self { session: key.id(), key, state: Rc::default(), wall }
    }

    /// Returns the key of the session that has the endpoints.
    pub(super) fn key(&self) -> Arc<SessionKey> {
        Arc::clone(&self.key)
    }

    fn endpoint(&self, kind: EndpointKind, topic: &str, qos: Qos) -> Endpoint {
        let mut state = self.state.borrow_mut();
        state.next += 1;
        Endpoint::new(Gid::new(self.session, state.next), kind, topic, "T")
            .with_qos(qos)
            .with_node("node", "/")
    }

    /// Creates a publisher.
    pub(super) fn create_publisher(&self, topic: &str, qos: Qos) -> Gid {
        let endpoint = Arc::new(self.endpoint(EndpointKind::Publisher, topic, qos));
        let gid = endpoint.gid;
        let publisher = Publisher { endpoint, published: 0, refused: 0, history: VecDeque::new() };
        let state = &mut *self.state.borrow_mut();
        state.publishers.insert(gid, publisher);
        state.topics.entry(topic.into()).or_default().insert(gid);
        gid
    }

    /// Creates a subscription that takes all samples, or `room` of them.
    pub(super) fn create_subscription(&self, topic: &str, qos: Qos, room: Option<usize>) -> Gid {
        let endpoint = Arc::new(self.endpoint(EndpointKind::Subscription, topic, qos));
        let gid = endpoint.gid;
        let subscription = Subscription { endpoint, received: BTreeMap::new(), room };
        let state = &mut *self.state.borrow_mut();
        state.subscriptions.insert(gid, subscription);
        state.topics.entry(topic.into()).or_default().insert(gid);
        gid
    }

    /// Creates a server or client, which takes all requests or responses. Calls of its own it makes none.
    pub(super) fn create_of_service(&self, kind: EndpointKind, name: &str) -> Gid {
        let gid = self.create_subscription(name, Qos::keep_all(), None);
        let state = &mut *self.state.borrow_mut();
        let of_service = state.subscriptions.get_mut(&gid).expect("just created");
        Arc::make_mut(&mut of_service.endpoint).kind = kind;
        gid
    }

    /// Ends a publisher or subscription. The samples of an ended publisher stay in its ring.
    pub(super) fn end(&self, gid: Gid) {
        let mut state = self.state.borrow_mut();
        state.subscriptions.remove(&gid);
        if let Some(publisher) = state.publishers.get_mut(&gid) {
            let mut ended = Endpoint::clone(&publisher.endpoint);
            ended.node = "ended".into();
            publisher.endpoint = Arc::new(ended);
        }
    }

    /// Lets a subscription take all samples from now on.
    pub(super) fn make_room(&self, subscription: Gid) {
        if let Some(subscription) = self.state.borrow_mut().subscriptions.get_mut(&subscription) {
            subscription.room = None;
        }
    }

    /// Publishes a sample with `length` bytes of filling. Returns `false` if a KEEP_ALL reader has no room for it.
    pub(super) fn publish(&self, publisher: Gid, length: usize) -> bool {
        let state = &mut *self.state.borrow_mut();
        let Some(of) = state.publishers.get_mut(&publisher) else { return false };
        let readers = state.readers.entry(of.endpoint.topic.clone()).or_default();
        readers.retain(|reader| !reader.closed.get());
        let holds = readers.iter().filter(|reader| {
            reader.reads(&of.endpoint)
                && reader.spec.qos.history == History::KeepAll
                && reader.spec.qos.reliability == Reliability::Reliable
        });
        let oldest = holds
            .map(|reader| reader.acknowledged.borrow().get(&publisher).copied().unwrap_or(0))
            .min();
        let most = match of.endpoint.qos.history {
            History::KeepAll => RING,
            History::KeepLast => RING.max(of.endpoint.qos.depth as usize),
        };
        if of.history.len() >= most {
            let first = of.history.front().map_or(0, |(sequence, _)| *sequence);
            if oldest.is_some_and(|oldest| oldest < first) {
                of.refused += 1;
                return false;
            }
            of.history.pop_front();
        }
        of.published += 1;
        let sequence = of.published;
        of.history.push_back((sequence, payload_of(&of.endpoint, sequence, length)));
        for reader in readers.iter().filter(|reader| reader.reads(&of.endpoint)) {
            state.active.push((reader.gid, publisher));
            for subscription in reader.stands_for.borrow().iter() {
                state.promised.entry((publisher, *subscription)).or_default().push(sequence);
            }
        }
        true
    }

    /// Ends the lifespan of all samples of a publisher.
    pub(super) fn expire(&self, publisher: Gid) {
        let state = &mut *self.state.borrow_mut();
        let published = state.publishers.get(&publisher).map_or(0, |p| p.published);
        state.expired.insert(publisher, published);
    }

    /// Sets whether opening a relay or stand-in fails from now on.
    pub(super) fn set_fails(&self, fails: bool) {
        self.state.borrow_mut().fails = fails;
    }

    /// Ends the daemon's process, in which `end` drops the relays. Publishers give up what these did not acknowledge, as
    /// nobody will: they find a dead process. A relay that a living daemon drops reports its losses itself.
    pub(super) fn kill(&self, end: impl FnOnce()) {
        self.state.borrow_mut().is_killed = true;
        end();
        self.state.borrow_mut().is_killed = false;
    }

    /// Returns the endpoints that the host shows.
    pub(super) fn endpoints(&self) -> Vec<Arc<Endpoint>> {
        let state = self.state.borrow();
        let publishers = state.publishers.values().map(|p| &p.endpoint);
        let publishers = publishers.filter(|endpoint| endpoint.node != "ended");
        let subscriptions = state.subscriptions.values().map(|s| &s.endpoint);
        publishers.chain(subscriptions).cloned().collect()
    }

    /// Returns the numbers of a publisher's samples that reached a subscription, in order of arrival.
    pub(super) fn received(&self, subscription: Gid, publisher: Gid) -> Vec<u64> {
        let state = self.state.borrow();
        let received = state.subscriptions.get(&subscription).map(|s| &s.received);
        received.and_then(|r| r.get(&publisher)).cloned().unwrap_or_default()
    }

    /// Returns how many samples a publisher published.
    pub(super) fn published(&self, publisher: Gid) -> u64 {
        self.state.borrow().publishers.get(&publisher).map_or(0, |p| p.published)
    }

    /// Returns whether readers still sleep although a stand-in wrote a sample for them.
    pub(super) fn has_unannounced(&self) -> bool {
        !self.state.borrow().unannounced.is_empty()
    }

    /// Returns the number of a publisher's samples that relays gave up.
    pub(super) fn given_up(&self, publisher: Gid) -> u64 {
        self.state.borrow().given_up.get(&publisher).copied().unwrap_or(0)
    }

    /// Returns the number of samples that were damaged on their way.
    pub(super) fn damaged(&self) -> u64 {
        self.state.borrow().damaged
    }

    /// Returns the number of RELIABLE samples that came twice, or after a newer one.
    pub(super) fn disordered(&self) -> u64 {
        self.state.borrow().disordered
    }

    /// Returns the publishers of a topic that have not ended.
    pub(super) fn publishers(&self, topic: &str) -> Vec<Gid> {
        let state = self.state.borrow();
        let of = state
            .publishers
            .iter()
            .filter(|(_, p)| p.endpoint.topic == topic && p.endpoint.node != "ended");
        of.map(|(gid, _)| *gid).collect()
    }

    /// Returns the samples that a publisher published while a relay stood for a subscription of a peer.
    pub(super) fn promised(&self, publisher: Gid, subscription: Gid) -> Vec<u64> {
        self.state.borrow().promised.get(&(publisher, subscription)).cloned().unwrap_or_default()
    }

    /// Returns each RELIABLE and KEEP_ALL subscription with each publisher of which it received a sample, and the
    /// numbers of the samples.
    pub(super) fn complete(&self) -> Vec<(Gid, Gid, Vec<u64>)> {
        let state = self.state.borrow();
        let keeping = state.subscriptions.iter().filter(|(_, s)| {
            let qos = &s.endpoint.qos;
            qos.history == History::KeepAll && qos.reliability == Reliability::Reliable
        });
        let of = keeping.flat_map(|(gid, subscription)| {
            let came = subscription.received.iter().filter(|(_, received)| !received.is_empty());
            came.map(|(publisher, received)| (*gid, *publisher, received.clone()))
        });
        of.collect()
    }

    /// Returns a publisher's QoS, if it has not ended.
    pub(super) fn publisher(&self, gid: Gid) -> Option<Qos> {
        let state = self.state.borrow();
        let publisher = state.publishers.get(&gid)?;
        let ended = publisher.endpoint.node == "ended";
        (!ended).then_some(publisher.endpoint.qos)
    }

    /// Relays that are open.
    pub(super) fn relays(&self) -> usize {
        let state = self.state.borrow();
        state.readers.values().flatten().filter(|reader| !reader.closed.get()).count()
    }

    /// Pairs of a relay and a publisher that it may read.
    pub(super) fn lanes(&self) -> usize {
        let state = self.state.borrow();
        let open = state.readers.values().flatten().filter(|reader| !reader.closed.get());
        let of = |reader: &Rc<Cursors>| {
            let all = state.publishers_of(&reader.spec.topic);
            all.filter(|(_, p)| p.endpoint.node != "ended" && reader.reads(&p.endpoint)).count()
        };
        open.map(of).sum()
    }

    /// Returns how often the engine asked a relay whether it has samples.
    pub(super) fn looks(&self) -> u64 {
        self.state.borrow().looks
    }

    /// Returns whether the engine waits for room.
    pub(super) fn waits_for_room(&self) -> bool {
        self.state.borrow().waits_for_room
    }
}

impl State {
    fn publishers_of(&self, topic: &str) -> impl Iterator<Item = (&Gid, &Publisher)> {
        let members = self.topics.get(topic).into_iter().flatten();
        members.filter_map(|gid| Some((gid, self.publishers.get(gid)?)))
    }
}

impl Cursors {
    fn reads(&self, publisher: &Endpoint) -> bool {
        publisher.topic == self.spec.topic && publisher.type_name == self.spec.type_name
    }
}

/// A stand-in.
struct SimWriter {
    rings: SimRings,
    endpoint: Endpoint,
    last: Cell<u64>,
}

impl RingWriter for SimWriter {
    fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    fn partners(&self) -> Vec<Gid> {
        let state = self.rings.state.borrow();
        let members = state.topics.get(&self.endpoint.topic).into_iter().flatten();
        let matching = members
            .filter_map(|gid| Some((gid, state.subscriptions.get(gid)?)))
            .filter(|(_, s)| pairing(&self.endpoint, &s.endpoint) == Pairing::Match);
        matching.map(|(gid, _)| *gid).collect()
    }

    fn try_write(&self, _client: &Gid, meta: Meta, bytes: &[u8]) -> Result<Written, RingError> {
        let state = &mut *self.rings.state.borrow_mut();
        let publisher = self.endpoint.gid;
        let foreign = publisher.0.starts_with(&FOREIGN);
        let length = bytes.len().saturating_sub(24);
        if !foreign && bytes != payload_of(&self.endpoint, meta.sequence, length) {
            state.damaged += 1;
        }
        let mut readers: Vec<_> = state
            .subscriptions
            .values_mut()
            .filter(|s| pairing(&self.endpoint, &s.endpoint) == Pairing::Match)
            .collect();
        let keeps = |s: &Subscription| {
            let qos = &s.endpoint.qos;
            qos.history == History::KeepAll && qos.reliability == Reliability::Reliable
        };
        if readers.iter().any(|s| keeps(s) && s.room == Some(0)) {
            return Err(RingError::Full);
        }
        // For BEST_EFFORT readers alone, streams of one sample each may overtake each other.
        let reliable = readers.iter().any(|s| s.endpoint.qos.reliability == Reliability::Reliable);
        if reliable && !foreign && meta.sequence <= self.last.replace(meta.sequence) {
            state.disordered += 1;
        }
        state.unannounced.insert(publisher);
        for subscription in &mut readers {
            let received = subscription.received.entry(publisher).or_default();
            // A sample that is not newer is dropped, as in a session.
            if received.last().is_some_and(|last| *last >= meta.sequence) {
                continue;
            }
            if let Some(room) = &mut subscription.room {
                *room = room.saturating_sub(1);
            }
            received.push(meta.sequence);
        }
        Ok(Written::Yes)
    }

    fn announce(&self) {
        self.rings.state.borrow_mut().unannounced.remove(&self.endpoint.gid);
    }

    fn assert_alive(&self) {}

    fn with_calls(&self) -> Vec<Gid> {
        Vec::new()
    }

    fn reads_calls_of(&self, _client: &Gid) -> bool {
        false
    }

    fn take_call_of(&self, _client: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        None
    }
}

impl Rings for SimRings {
    fn open_reader(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String> {
        let mut state = self.state.borrow_mut();
        if state.fails {
            return Err("no memory".into());
        }
        state.next += 1;
        let late_join = spec.qos.durability == Durability::TransientLocal;
        // A volatile reader gets samples that are published later; all samples of an ended publisher are old.
        let known = state.publishers_of(&spec.topic).map(|(gid, p)| {
            let depth = u64::from(p.endpoint.qos.depth);
            let skip = if late_join { p.published.saturating_sub(depth) } else { p.published };
            (*gid, skip)
        });
        let known: HashMap<_, _> = known.collect();
        let cursors = Rc::new(Cursors {
            gid: Gid::new(self.session, state.next),
            spec,
            stands_for: RefCell::new(stands_for),
            acknowledged: RefCell::new(known.clone()),
            read: RefCell::new(known),
            lost: RefCell::default(),
            closed: Cell::new(false),
        });
        let State { readers, topics, active, .. } = &mut *state;
        let topic = &cursors.spec.topic;
        readers.entry(topic.clone()).or_default().push(Rc::clone(&cursors));
        // Existing publishers may have history.
        let members = topics.get(topic).into_iter().flatten();
        active.extend(members.map(|member| (cursors.gid, *member)));
        drop(state);
        Ok(Rc::new(SimReader { rings: self.clone(), cursors }))
    }

    fn open_writer(
        &self,
        remote: &Endpoint,
        _held: &Arc<MemoryBudget>,
    ) -> Result<Rc<dyn RingWriter>, String> {
        if self.state.borrow().fails {
            return Err("no memory".into());
        }
        Ok(Rc::new(SimWriter { rings: self.clone(), endpoint: remote.clone(), last: Cell::new(0) }))
    }

    fn take_active(&self, found: &mut Vec<(Gid, Gid)>) {
        found.append(&mut self.state.borrow_mut().active);
    }

    fn set_waiting_for_room(&self, waiting: bool) {
        self.state.borrow_mut().waits_for_room = waiting;
    }
}
