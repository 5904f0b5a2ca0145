//! Models of a host's rings: publishers, subscriptions, relays and stand-ins, without shared memory.

use std::{
    cell::{Cell, RefCell},
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::{
    Meta,
    ids::{Gid, SessionId},
    qos::{Durability, History, Qos, Reliability},
};
use axon_transport::{
    EndpointSpec, MessageInfo,
    graph::{Endpoint, EndpointKind},
    internal::{
        OWNER, SessionKey,
        graph::{Pairing, pairing},
        session::{TakeLimit, Written},
    },
};
use bytes::Bytes;

use crate::engine::rings::{RingError, RingReader, RingWriter, Rings};

/// Samples that a publisher's ring holds.
const RING: usize = 256;

/// A local publisher.
struct Publisher {
    endpoint: Arc<Endpoint>,
    published: u64,
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
    /// How often a relay was asked whether it has samples.
    looks: u64,
    /// Samples of each publisher up to this number are past their lifespan.
    expired: BTreeMap<Gid, u64>,
    /// What was given up of each publisher.
    given_up: BTreeMap<Gid, u64>,
    /// Samples that came damaged.
    damaged: u64,
    /// Stand-ins that wrote samples and did not wake their readers.
    unannounced: BTreeSet<Gid>,
    /// RELIABLE samples that a stand-in wrote after a newer one, or twice.
    disordered: u64,
    next: u32,
    waits_for_room: bool,
}

/// How far a relay has read and acknowledged each publisher.
struct Cursors {
    gid: Gid,
    spec: EndpointSpec,
    read: RefCell<HashMap<Gid, u64>>,
    /// Samples of each publisher that newer ones replaced before they were read, or that were passed over.
    lost: RefCell<HashMap<Gid, u64>>,
    acknowledged: RefCell<HashMap<Gid, u64>>,
    closed: Cell<bool>,
}

/// The rings of one host. Clones share them.
#[derive(Clone)]
pub(super) struct SimRings {
    session: SessionId,
    key: Arc<SessionKey>,
    state: Rc<RefCell<State>>,
}

/// Samples that one take passes over since they do not count, as a session does.
const PASSED_OVER: usize = 64;

/// GIDs of endpoints of a peer without an engine begin with this. Nobody vouches for their samples.
pub(super) const FOREIGN: [u8; 12] = [0xaa; 12];

/// The payload of a sample: its number, its publisher and filling, so that damage shows.
pub(super) fn payload(of: Gid, sequence: u64, length: usize) -> Vec<u8> {
    let mut payload = of.0.to_vec();
    payload.extend_from_slice(&sequence.to_be_bytes());
    let filling = (sequence as u8).wrapping_mul(31).wrapping_add(of.0[15]);
    payload.resize(24 + length, filling);
    payload
}

impl SimRings {
    /// The rings of a host whose sessions have this number.
    pub(super) fn new(host: usize) -> Self {
        let mut packet = vec![OWNER, 0xa1, 0x00, 0x58, 0x20];
        packet.extend_from_slice(&[0x51; 24]);
        packet.extend_from_slice(&(host as u64).to_be_bytes());
        let key = Arc::new(SessionKey::from_packet(&packet).unwrap());
        Self { session: key.id(), key, state: Rc::default() }
    }

    /// The key of the session that has the endpoints.
    pub(super) fn key(&self) -> Arc<SessionKey> {
        Arc::clone(&self.key)
    }

    fn endpoint(&self, kind: EndpointKind, topic: &str, qos: Qos) -> Endpoint {
        let mut state = self.state.borrow_mut();
        state.next += 1;
        Endpoint {
            gid: Gid::new(self.session, state.next),
            kind,
            topic: topic.into(),
            type_name: "T".into(),
            type_hash: Vec::new(),
            qos,
            node: "node".into(),
            namespace: "/".into(),
            enclave: String::new(),
        }
    }

    /// Creates a publisher.
    pub(super) fn create_publisher(&self, topic: &str, qos: Qos) -> Gid {
        let endpoint = Arc::new(self.endpoint(EndpointKind::Publisher, topic, qos));
        let gid = endpoint.gid;
        let publisher = Publisher { endpoint, published: 0, history: VecDeque::new() };
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

    /// Ends a publisher or subscription. What a publisher left stays in its ring.
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

    /// Publishes a sample with so many bytes of filling. `false`: a KEEP_ALL reader has no room for it.
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
        if of.history.len() >= RING {
            let first = of.history.front().map_or(0, |(sequence, _)| *sequence);
            if oldest.is_some_and(|oldest| oldest < first) {
                return false;
            }
            of.history.pop_front();
        }
        of.published += 1;
        let sequence = of.published;
        of.history.push_back((sequence, payload(publisher, sequence, length)));
        let reading = readers.iter().filter(|reader| reader.reads(&of.endpoint));
        state.active.extend(reading.map(|reader| (reader.gid, publisher)));
        true
    }

    /// The lifespan of all samples of a publisher is over.
    pub(super) fn expire(&self, publisher: Gid) {
        let state = &mut *self.state.borrow_mut();
        let published = state.publishers.get(&publisher).map_or(0, |p| p.published);
        state.expired.insert(publisher, published);
    }

    /// The endpoints that the host shows.
    pub(super) fn endpoints(&self) -> Vec<Arc<Endpoint>> {
        let state = self.state.borrow();
        let publishers = state.publishers.values().map(|p| &p.endpoint);
        let publishers = publishers.filter(|endpoint| endpoint.node != "ended");
        let subscriptions = state.subscriptions.values().map(|s| &s.endpoint);
        publishers.chain(subscriptions).cloned().collect()
    }

    /// The numbers of the samples of a publisher that reached a subscription, as they came.
    pub(super) fn received(&self, subscription: Gid, publisher: Gid) -> Vec<u64> {
        let state = self.state.borrow();
        let received = state.subscriptions.get(&subscription).map(|s| &s.received);
        received.and_then(|r| r.get(&publisher)).cloned().unwrap_or_default()
    }

    /// How many samples a publisher published.
    pub(super) fn published(&self, publisher: Gid) -> u64 {
        self.state.borrow().publishers.get(&publisher).map_or(0, |p| p.published)
    }

    /// Whether readers sleep though a stand-in wrote a sample for them.
    pub(super) fn has_unannounced(&self) -> bool {
        !self.state.borrow().unannounced.is_empty()
    }

    /// Samples of a publisher that relays gave up.
    pub(super) fn given_up(&self, publisher: Gid) -> u64 {
        self.state.borrow().given_up.get(&publisher).copied().unwrap_or(0)
    }

    /// Samples that were damaged on their way.
    pub(super) fn damaged(&self) -> u64 {
        self.state.borrow().damaged
    }

    /// RELIABLE samples that came twice, or after a newer one.
    pub(super) fn disordered(&self) -> u64 {
        self.state.borrow().disordered
    }

    /// The publishers of a topic that have not ended.
    pub(super) fn publishers(&self, topic: &str) -> Vec<Gid> {
        let state = self.state.borrow();
        let of = state
            .publishers
            .iter()
            .filter(|(_, p)| p.endpoint.topic == topic && p.endpoint.node != "ended");
        of.map(|(gid, _)| *gid).collect()
    }

    /// For each RELIABLE and KEEP_ALL subscription, and each publisher of which it received a sample: the first
    /// number, and how many came.
    pub(super) fn complete(&self) -> Vec<(Gid, Gid, u64, u64)> {
        let state = self.state.borrow();
        let keeping = state.subscriptions.iter().filter(|(_, s)| {
            let qos = &s.endpoint.qos;
            qos.history == History::KeepAll && qos.reliability == Reliability::Reliable
        });
        let of = keeping.flat_map(|(gid, subscription)| {
            subscription.received.iter().filter_map(|(publisher, received)| {
                Some((*gid, *publisher, *received.first()?, received.len() as u64))
            })
        });
        of.collect()
    }

    /// A publisher's QoS, and how many samples it published, if it has not ended.
    pub(super) fn publisher(&self, gid: Gid) -> Option<(Qos, u64)> {
        let state = self.state.borrow();
        let publisher = state.publishers.get(&gid)?;
        let ended = publisher.endpoint.node == "ended";
        (!ended).then_some((publisher.endpoint.qos, publisher.published))
    }

    /// Relays that are open.
    pub(super) fn relays(&self) -> usize {
        let state = self.state.borrow();
        state.readers.values().flatten().filter(|reader| !reader.closed.get()).count()
    }

    /// How often the engine asked a relay whether it has samples.
    pub(super) fn looks(&self) -> u64 {
        self.state.borrow().looks
    }

    /// Whether the engine waits for room.
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

/// A relay.
struct SimReader {
    rings: SimRings,
    cursors: Rc<Cursors>,
}

impl Drop for SimReader {
    fn drop(&mut self) {
        self.cursors.closed.set(true);
        // A relay that ends gives up what is not acknowledged.
        if self.cursors.spec.qos.reliability == Reliability::Reliable {
            for (publisher, samples) in self.unacknowledged() {
                self.give_up(publisher, samples);
            }
        }
    }
}

impl SimReader {
    /// The next sample of a publisher after this reader's cursor.
    fn peek(&self, publisher: &Gid) -> Option<(u64, Vec<u8>)> {
        let state = self.rings.state.borrow();
        let of = state.publishers.get(publisher)?;
        let read = self.cursors.read.borrow().get(publisher).copied().unwrap_or(0);
        let qos = &self.cursors.spec.qos;
        let skip = match (qos.reliability, qos.history) {
            (Reliability::Reliable, History::KeepAll) => 0,
            _ => of.published.saturating_sub(u64::from(qos.depth)),
        };
        let next = of.history.iter().find(|(sequence, _)| *sequence > read.max(skip));
        next.cloned()
    }
}

impl SimReader {
    /// Passes over the samples up to this number.
    fn pass_to(&self, publisher: &Gid, number: u64) {
        let mut read = self.cursors.read.borrow_mut();
        let read = read.entry(*publisher).or_default();
        *self.cursors.lost.borrow_mut().entry(*publisher).or_default() +=
            number.saturating_sub(*read);
        *read = number.max(*read);
    }
}

impl RingReader for SimReader {
    fn gid(&self) -> Gid {
        self.cursors.gid
    }

    fn with_data(&self) -> Vec<Gid> {
        self.matched().into_iter().filter(|publisher| self.has_data_of(publisher)).collect()
    }

    fn has_data_of(&self, publisher: &Gid) -> bool {
        self.rings.state.borrow_mut().looks += 1;
        self.peek(publisher).is_some()
    }

    fn reads(&self, publisher: &Gid) -> bool {
        let state = self.rings.state.borrow();
        state.publishers.get(publisher).is_some_and(|p| self.cursors.reads(&p.endpoint))
    }

    fn matched(&self) -> Vec<Gid> {
        let state = self.rings.state.borrow();
        let of = state.publishers_of(&self.cursors.spec.topic);
        of.filter(|(_, p)| self.cursors.reads(&p.endpoint)).map(|(gid, _)| *gid).collect()
    }

    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize {
        let expired = self.rings.state.borrow().expired.get(publisher).copied();
        let (mut samples, mut bytes, mut passed_over) = (0, 0, 0);
        while samples < most.samples
            && passed_over < PASSED_OVER
            && let Some((sequence, payload)) = self.peek(publisher)
            && (samples == 0 || bytes + payload.len() <= most.bytes)
        {
            self.pass_to(publisher, sequence - 1);
            self.cursors.read.borrow_mut().insert(*publisher, sequence);
            if Some(sequence) <= expired {
                passed_over += 1;
                continue;
            }
            (samples, bytes) = (samples + 1, bytes + payload.len());
            each(MessageInfo::of(*publisher, sequence), payload.into());
        }
        samples
    }

    fn retry_of(&self, publisher: &Gid) -> Option<Duration> {
        self.peek(publisher).map(|_| Duration::ZERO)
    }

    fn skip_of(&self, publisher: &Gid, depth: u64) {
        let state = self.rings.state.borrow();
        let published = state.publishers.get(publisher).map_or(0, |of| of.published);
        self.pass_to(publisher, published.saturating_sub(depth));
    }

    fn lost_of(&self, publisher: &Gid) -> u64 {
        // A look finds the losses, as with a ring in memory.
        if let Some((next, _)) = self.peek(publisher) {
            self.pass_to(publisher, next - 1);
        }
        self.cursors.lost.borrow().get(publisher).copied().unwrap_or(0)
    }

    fn acknowledge_of(&self, publisher: &Gid, sequence: u64) {
        let mut acknowledged = self.cursors.acknowledged.borrow_mut();
        let known = acknowledged.entry(*publisher).or_default();
        *known = sequence.max(*known);
    }

    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        let state = self.rings.state.borrow();
        let acknowledged = self.cursors.acknowledged.borrow();
        let of = state.publishers_of(&self.cursors.spec.topic);
        let of = of.filter(|(_, p)| self.cursors.reads(&p.endpoint));
        let left = of.map(|(gid, publisher)| {
            let done = acknowledged.get(gid).copied().unwrap_or(0);
            (*gid, publisher.published.saturating_sub(done))
        });
        left.filter(|(_, left)| *left > 0).collect()
    }

    fn give_up(&self, publisher: Gid, samples: u64) {
        *self.rings.state.borrow_mut().given_up.entry(publisher).or_default() += samples;
    }

    fn assertions(&self) -> Vec<(Gid, u64)> {
        Vec::new()
    }

    fn set_stands_for(&self, _gids: Vec<Gid>) {}
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
        if !foreign && bytes != payload(publisher, meta.sequence, bytes.len().saturating_sub(24)) {
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
            // As a session does: a sample that is not newer is dropped.
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
        _stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String> {
        let mut state = self.state.borrow_mut();
        state.next += 1;
        let late_join = spec.qos.durability == Durability::TransientLocal;
        // A volatile reader gets what is published after it; an ended publisher's are all old.
        let known = state.publishers_of(&spec.topic).map(|(gid, p)| {
            let depth = u64::from(p.endpoint.qos.depth);
            let skip = if late_join { p.published.saturating_sub(depth) } else { p.published };
            (*gid, skip)
        });
        let known: HashMap<_, _> = known.collect();
        let cursors = Rc::new(Cursors {
            gid: Gid::new(self.session, state.next),
            spec,
            acknowledged: RefCell::new(known.clone()),
            read: RefCell::new(known),
            lost: RefCell::default(),
            closed: Cell::new(false),
        });
        let State { readers, topics, active, .. } = &mut *state;
        let topic = &cursors.spec.topic;
        readers.entry(topic.clone()).or_default().push(Rc::clone(&cursors));
        // Those that are there may have history.
        let members = topics.get(topic).into_iter().flatten();
        active.extend(members.map(|member| (cursors.gid, *member)));
        drop(state);
        Ok(Rc::new(SimReader { rings: self.clone(), cursors }))
    }

    fn open_writer(&self, remote: &Endpoint) -> Result<Rc<dyn RingWriter>, String> {
        Ok(Rc::new(SimWriter { rings: self.clone(), endpoint: remote.clone(), last: Cell::new(0) }))
    }

    fn take_active(&self, found: &mut Vec<(Gid, Gid)>) {
        found.append(&mut self.state.borrow_mut().active);
    }

    fn set_waiting_for_room(&self, waiting: bool) {
        self.state.borrow_mut().waits_for_room = waiting;
    }
}
