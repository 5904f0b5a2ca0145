//! Samples from one peer: out of QUIC streams into the rings of stand-ins.
//!
//! The streams of a flow are read one after the other, in the order of arrival, so that its samples stay in
//! order when a successor takes over. While a ring is full, its stream is not read: QUIC's flow control then
//! holds back the peer.

mod copies;
mod delivery;
#[cfg(test)]
mod held;
mod incoming;
mod limited;
mod reading;
mod receipts;
mod short_batch;
mod stream_queue;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, HashMap, HashSet, VecDeque},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_envelope::{Kind, Route};
use axon_shm::ids::Gid;
use axon_transport::internal::log_limit::LogLimit;
use quinn_proto::{StreamId, VarInt};

use self::{
    copies::Copies,
    incoming::{IncomingStream, StreamStep},
    limited::RateLimitedStreams,
    receipts::Receipts,
    stream_queue::StreamQueue,
};
use super::quic::transport::STREAM_WINDOW;
use crate::{
    engine::{
        account::{MessageMemory, Meter},
        counters::Counters,
        limits::{Limit, RouteLimit},
        sample::stream_header::StreamHeader,
        stand_in::StandIn,
    },
    link::{CloseCode, ReceivedUpTo},
};

/// Time for which a stream may wait for its route to arrive.
const ARRIVAL: Duration = Duration::from_secs(2);
/// A message longer than this waits for memory before any byte of it is read. A shorter message takes memory
/// only if it does not arrive at once.
const LONG_MESSAGE_BYTES: usize = 32 << 10;
/// Bytes of a stream that are read before other streams have their turn.
const TURN: usize = 1 << 20;
/// Time after which a stream with a full ring tries again if no reader signals room.
const FULL_RETRY: Duration = Duration::from_millis(100);
/// The reason that is logged for samples that a link had not delivered completely.
const ENDED: &str = "the link ended before they were read";
/// The code that stops a stream without a route.
const NO_ROUTE: VarInt = VarInt::from_u32(CloseCode::OutOfOrder as u32);

/// A data stream: its connection, and its number in that connection.
type StreamKey = (u64, StreamId);

/// A protocol violation of the peer: the code that ends its link, and the reason.
pub(crate) type LinkViolation = (CloseCode, String);

/// A route that this host asked for.
pub(crate) struct RouteIn {
    /// The topic's name.
    pub(crate) topic: Arc<str>,
    /// Topic and kind, for the envelope.
    pub(crate) route: Route,
    /// The stand-ins that the samples are written to, by the GID of the remote publisher, client or server.
    pub(crate) writers: HashMap<Gid, Rc<StandIn>>,
    /// For responses: the local clients, each with the number up to which it has the responses of its flow.
    clients: HashMap<Gid, u64>,
    /// The limits on samples from the peer.
    pub(crate) limit: RouteLimit,
    /// True if all local readers are RELIABLE and KEEP_ALL.
    pub(crate) keeps_all: bool,
}

impl RouteIn {
    /// Creates a route without writers.
    pub(crate) fn new(topic: Arc<str>, route: Route, limits: Vec<Rc<Limit>>) -> Self {
        let (writers, clients) = (HashMap::new(), HashMap::new());
        Self { topic, route, writers, clients, limit: RouteLimit::new(limits), keeps_all: false }
    }

    /// Replaces the local clients that the route's responses go to.
    pub(crate) fn set_clients(&mut self, clients: impl Iterator<Item = Gid>) {
        let before = std::mem::take(&mut self.clients);
        let has = |client: Gid| (client, before.get(&client).copied().unwrap_or(0));
        self.clients = clients.map(has).collect();
    }

    fn has_flow(&self, of: &Gid) -> bool {
        match self.route.kind {
            Kind::Response => self.clients.contains_key(of),
            Kind::Topic | Kind::Request => self.writers.contains_key(of),
        }
    }
}

/// The samples from one peer.
pub(crate) struct Inbound {
    routes: HashMap<u32, RouteIn>,
    streams: HashMap<StreamKey, IncomingStream>,
    /// The streams of each flow, in order of arrival.
    turns: HashMap<(u32, Gid), VecDeque<StreamKey>>,
    ready: VecDeque<StreamKey>,
    /// Streams that wait, each with the time at which its wait ends.
    waiting: BTreeSet<(Duration, StreamKey)>,
    /// Streams that wait for room in a ring.
    full: HashSet<StreamKey>,
    /// Streams that wait for memory.
    without_room: StreamQueue,
    limited: RateLimitedStreams,
    copies: Copies,
    /// Streams whose link is not elected, and that are no copies.
    parked: BTreeSet<StreamKey>,
    /// Memory for one short message if the identity has none left. Complete messages are then read one after
    /// the other.
    spare: Rc<Meter>,
    /// The time at which streams with a full ring try again, since the reader that they wait for may be gone.
    full_retry: Option<Duration>,
    /// The link whose peer had more long messages in flight than permitted.
    exceeded: Option<u64>,
    /// Bytes that the memory for messages had released at the last check.
    released: usize,
    receipts: Receipts,
    /// The stand-in whose subscriptions were not woken yet for the written samples.
    written: Option<Rc<StandIn>>,
    /// The buffer in which a short message's envelope is opened.
    envelope: Vec<u8>,
    counters: Rc<Counters>,
    intake: MessageMemory,
    max_message: u64,
    /// CLOCK_MONOTONIC, in nanoseconds, at the engine's time zero.
    epoch_nanos: u64,
    losses: LogLimit,
}

impl Inbound {
    /// Creates an inbound side without routes. `intake` is the memory for messages.
    pub(crate) fn new(
        counters: Rc<Counters>,
        intake: MessageMemory,
        max_message: u64,
        epoch_nanos: u64,
    ) -> Self {
        Self {
            routes: HashMap::new(),
            streams: HashMap::new(),
            turns: HashMap::new(),
            ready: VecDeque::new(),
            waiting: BTreeSet::new(),
            full: HashSet::new(),
            without_room: StreamQueue::default(),
            limited: RateLimitedStreams::default(),
            copies: Copies::default(),
            parked: BTreeSet::new(),
            spare: Meter::new(LONG_MESSAGE_BYTES),
            full_retry: None,
            exceeded: None,
            released: intake.released(),
            receipts: Receipts::default(),
            written: None,
            envelope: Vec::new(),
            counters,
            intake,
            max_message,
            epoch_nanos,
            losses: LogLimit::default(),
        }
    }

    /// Returns the routes, for changes. Call [`handle_routes`](Self::handle_routes) afterwards.
    pub(crate) fn routes(&mut self) -> &mut HashMap<u32, RouteIn> {
        &mut self.routes
    }

    /// Continues streams that waited for a route or writer, after these changed.
    pub(crate) fn handle_routes(&mut self) {
        let waiting: Vec<_> = self.waiting.iter().map(|(_, key)| *key).collect();
        waiting.into_iter().for_each(|key| self.make_ready(key));
    }

    /// Handles a new stream of the peer, or more data on a stream.
    pub(crate) fn handle_readable(&mut self, link: u64, stream: StreamId) {
        self.streams.entry((link, stream)).or_default();
        self.make_ready((link, stream));
    }

    /// Continues the streams of a link that waited for its election.
    pub(crate) fn handle_elected(&mut self, link: u64) {
        // In the order in which the peer opened them.
        let elected: Vec<_> = self.parked.iter().filter(|key| key.0 == link).copied().collect();
        for key in elected {
            self.parked.remove(&key);
            self.make_ready(key);
        }
    }

    fn make_ready(&mut self, key: StreamKey) {
        if let Some(stream) = self.streams.get_mut(&key)
            && !std::mem::replace(&mut stream.is_ready, true)
        {
            self.ready.push_back(key);
        }
    }

    /// Continues streams that wait for room, after readers made some.
    pub(crate) fn handle_room(&mut self) {
        self.full_retry = None;
        for key in std::mem::take(&mut self.full) {
            self.make_ready(key);
        }
    }

    /// Continues streams that wait for memory, if another stream of the peer's identity released some.
    pub(crate) fn look_for_memory(&mut self) {
        let released = self.intake.released();
        if !self.without_room.is_empty()
            && released != std::mem::replace(&mut self.released, released)
        {
            self.try_without_room();
        }
    }

    fn try_without_room(&mut self) {
        for key in self.without_room.take() {
            self.make_ready(key);
        }
    }

    /// Returns how many bytes of this link's long messages wait for memory, if the peer may not have that
    /// many in flight. Reports each link once.
    pub(crate) fn find_excess(&mut self, link: u64, most: u64) -> Option<u64> {
        if self.without_room.is_empty() || self.exceeded == Some(link) {
            return None;
        }
        let streams = self.without_room.iter().filter(|key| key.0 == link);
        let lengths = streams.filter_map(|key| match self.streams.get(key)?.step {
            StreamStep::Room(length) => Some((length as u64).min(STREAM_WINDOW.1)),
            _ => None,
        });
        let waits: u64 = lengths.sum();
        // While little is in flight, one more sample of any length may be.
        if waits <= most.max(most / 4 + STREAM_WINDOW.1) {
            return None;
        }
        self.exceeded = Some(link);
        Some(waits)
    }

    /// Returns whether a stream waits for room in a ring.
    pub(crate) fn waits_for_room(&self) -> bool {
        !self.full.is_empty()
    }

    /// Returns whether a stream has data to read.
    pub(crate) fn has_work(&self) -> bool {
        !self.ready.is_empty()
    }

    /// Counts the streams that have data to read.
    pub(crate) fn ready(&self) -> usize {
        self.ready.len()
    }

    /// Forgets a stream that cannot be read any more.
    pub(crate) fn forget_stream(&mut self, key: (u64, StreamId)) {
        self.forget(key);
    }

    /// Returns the next stream with data to read, and its link.
    pub(crate) fn next_ready(&mut self) -> Option<(u64, StreamId)> {
        let key = self.ready.pop_front()?;
        if let Some(stream) = self.streams.get_mut(&key) {
            stream.is_ready = false;
        }
        Some(key)
    }

    /// Counts the streams of a link that are not read to their end.
    pub(crate) fn streams_of(&self, link: u64) -> usize {
        self.streams.keys().filter(|(of, _)| *of == link).count()
    }

    /// Handles the end of a link: the unread data of its streams is lost.
    pub(crate) fn link_over(&mut self, link: u64, now: Duration) {
        let keys: Vec<_> = self.streams.keys().filter(|(of, _)| *of == link).copied().collect();
        for key in keys {
            let stream = self.streams.get(&key);
            let lost = stream.filter(|s| {
                matches!(
                    s.step,
                    StreamStep::Ring(_) | StreamStep::Writer(..) | StreamStep::Unpack(..)
                )
            });
            if let Some((header, _)) = lost.and_then(|stream| stream.header) {
                self.lost("no_link", header, ENDED, now);
            }
            self.forget(key);
        }
    }

    fn forget(&mut self, key: StreamKey) {
        let Some(mut stream) = self.streams.remove(&key) else { return };
        self.release(&mut stream);
        self.end_turn(key, &stream);
        self.full.remove(&key);
        self.without_room.remove(&key);
        self.limited.forget(&key);
        if let StreamStep::Turn(until) | StreamStep::Writer(_, until) = stream.step {
            self.waiting.remove(&(until, key));
        }
        self.parked.remove(&key);
        self.forget_copy(key, &stream);
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) or [`poll_receipt`](Self::poll_receipt) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let waiting = self.waiting.first().map(|(due, _)| *due);
        let limited = self.limited.poll_timeout();
        let parts = [waiting, self.full_retry, self.receipts.poll_timeout(), limited];
        parts.into_iter().flatten().min()
    }

    /// Continues streams whose wait is over.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        if self.full_retry.is_some_and(|due| due <= now) {
            self.handle_room();
        }
        let due: Vec<_> =
            self.waiting.iter().take_while(|(at, _)| *at <= now).map(|(_, key)| *key).collect();
        due.into_iter().for_each(|key| self.make_ready(key));
        self.handle_limits_due(now);
    }

    /// Returns the next acknowledgement that is due.
    pub(crate) fn poll_receipt(&mut self, now: Duration) -> Option<ReceivedUpTo> {
        self.receipts.poll_message(now)
    }

    fn topic(&self, number: u32) -> Arc<str> {
        let route = self.routes.get(&number);
        route.map_or_else(|| "(a route that ended)".into(), |route| Arc::clone(&route.topic))
    }

    /// Wakes the subscriptions of a stand-in at the end of the turn, once for all that was written.
    fn announce_later(&mut self, stand_in: &Rc<StandIn>) {
        let before = self.written.as_ref();
        if before.is_none_or(|before| !Rc::ptr_eq(before, stand_in))
            && let Some(before) = self.written.replace(Rc::clone(stand_in))
        {
            before.announce();
        }
    }

    fn lost(&self, cause: &'static str, header: StreamHeader, why: &str, now: Duration) {
        let topic = self.topic(header.route);
        self.counters.lost(&topic, cause, 1);
        if let Some(samples) = self.losses.count(now) {
            tracing::warn!(%topic, publisher = %header.of, why, samples, "samples from a peer are lost");
        }
    }
}
