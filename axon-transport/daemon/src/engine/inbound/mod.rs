//! Samples from one peer: out of QUIC streams into the rings of stand-ins.
//!
//! The streams of a flow are read one after the other, in the order in which they came, so that its samples stay in
//! order when a successor takes over. A stream whose ring is full is not read on: QUIC's flow control holds back the
//! peer.

mod incoming;
mod receipts;
#[cfg(test)]
mod tests;

use std::{
    borrow::Cow,
    collections::{BTreeSet, HashMap, HashSet, VecDeque},
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::{Kind, Route};
use axon_shm::{Meta, ids::Gid};
use axon_transport::internal::{log_limit::LogLimit, session::Written};
use bytes::Bytes;
use quinn_proto::{StreamId, VarInt};

pub(crate) use self::incoming::stream_header;
use self::{
    incoming::{HEADER, Incoming, Message, Piece, Step, StreamHeader},
    receipts::Receipts,
};
use super::{
    protection::{Open, writer_of},
    rings::RingError,
    stand_in::StandIn,
};
use crate::{
    engine::{
        account::Meter,
        counters::Counters,
        protection::{MAX_OVERHEAD, RefusedMessage},
    },
    link::{CloseCode, Received},
};

/// A stream may come before the route that it belongs to.
const ARRIVAL: Duration = Duration::from_secs(2);
/// A message longer than this counts against the memory for messages of the peer's identity.
const LONG: usize = 32 << 10;
/// Bytes of a stream that are read before others have their turn.
const TURN: usize = 1 << 20;
/// A stream whose ring was full tries again after this time, if no reader said that it made room.
const FULL_RETRY: Duration = Duration::from_millis(100);
/// What a stream is told whose route there is not.
const NO_ROUTE: VarInt = VarInt::from_u32(CloseCode::OutOfOrder as u32);

/// A data stream: its connection, and its number there.
type Key = (u64, StreamId);

/// The peer broke a rule: the code that ends its link, and why.
pub(crate) type Violation = (CloseCode, String);

/// A route that this host asked for.
pub(crate) struct RouteIn {
    /// The topic's name.
    pub(crate) topic: Arc<str>,
    /// Topic and kind, for the envelope.
    pub(crate) route: Route,
    /// The stand-ins that are written to, by the GID of the remote publisher, client or server.
    pub(crate) writers: HashMap<Gid, Rc<StandIn>>,
    /// Of responses: the local clients that they answer.
    pub(crate) clients: HashSet<Gid>,
}

impl RouteIn {
    /// A route without writers.
    pub(crate) fn new(topic: Arc<str>, route: Route) -> Self {
        Self { topic, route, writers: HashMap::new(), clients: HashSet::new() }
    }

    fn has_flow(&self, of: &Gid) -> bool {
        match self.route.kind {
            Kind::Response => self.clients.contains(of),
            Kind::Topic | Kind::Request => self.writers.contains_key(of),
        }
    }
}

/// The samples from one peer.
pub(crate) struct Inbound {
    routes: HashMap<u32, RouteIn>,
    streams: HashMap<Key, Incoming>,
    /// The streams of each flow, in the order in which they came.
    turns: HashMap<(u32, Gid), VecDeque<Key>>,
    ready: VecDeque<Key>,
    /// Streams that wait until a time at the latest.
    waiting: BTreeSet<(Duration, Key)>,
    /// Streams that wait for room in a ring.
    full: HashSet<Key>,
    /// Streams that wait for memory.
    without_room: VecDeque<Key>,
    /// When streams try again whose ring was full: the reader that it waited for may be gone.
    full_retry: Option<Duration>,
    /// What the memory for long messages had given back when it was looked at last.
    released: usize,
    receipts: Receipts,
    counters: Rc<Counters>,
    intake: Rc<Meter>,
    max_message: u64,
    /// CLOCK_MONOTONIC, in nanoseconds, when the engine's time was zero.
    epoch_nanos: u64,
    losses: LogLimit,
}

impl Inbound {
    /// Takes nothing yet. `intake` is the memory for long messages.
    pub(crate) fn new(
        counters: Rc<Counters>,
        intake: Rc<Meter>,
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
            without_room: VecDeque::new(),
            full_retry: None,
            released: intake.released(),
            receipts: Receipts::default(),
            counters,
            intake,
            max_message,
            epoch_nanos,
            losses: LogLimit::default(),
        }
    }

    /// The route of this number, for changes; [`handle_routes`](Self::handle_routes) has to follow.
    pub(crate) fn routes(&mut self) -> &mut HashMap<u32, RouteIn> {
        &mut self.routes
    }

    /// Routes or writers changed: streams may go on that waited for them.
    pub(crate) fn handle_routes(&mut self) {
        let waiting: Vec<_> = self.waiting.iter().map(|(_, key)| *key).collect();
        waiting.into_iter().for_each(|key| self.make_ready(key));
    }

    /// The peer opened a stream, or more of it arrived.
    pub(crate) fn handle_readable(&mut self, link: u64, stream: StreamId) {
        self.streams.entry((link, stream)).or_default();
        self.make_ready((link, stream));
    }

    fn make_ready(&mut self, key: Key) {
        if let Some(stream) = self.streams.get_mut(&key)
            && !std::mem::replace(&mut stream.is_ready, true)
        {
            self.ready.push_back(key);
        }
    }

    /// Readers made room in rings.
    pub(crate) fn handle_room(&mut self) {
        self.full_retry = None;
        for key in std::mem::take(&mut self.full) {
            self.make_ready(key);
        }
    }

    /// Lets streams go on that wait for memory, if another stream of the peer's identity gave some back.
    pub(crate) fn look_for_memory(&mut self) {
        let released = self.intake.released();
        if !self.without_room.is_empty()
            && released != std::mem::replace(&mut self.released, released)
        {
            for key in std::mem::take(&mut self.without_room) {
                self.make_ready(key);
            }
        }
    }

    /// Whether a stream waits for room in a ring.
    pub(crate) fn waits_for_room(&self) -> bool {
        !self.full.is_empty()
    }

    /// Whether there is something to read.
    pub(crate) fn has_work(&self) -> bool {
        !self.ready.is_empty()
    }

    /// Streams that have something to read.
    pub(crate) fn ready(&self) -> usize {
        self.ready.len()
    }

    /// Forgets a stream that cannot be read any more.
    pub(crate) fn forget_stream(&mut self, key: (u64, StreamId)) {
        self.forget(key);
    }

    /// The next stream that has something to read, and its link.
    pub(crate) fn next_ready(&mut self) -> Option<(u64, StreamId)> {
        let key = self.ready.pop_front()?;
        if let Some(stream) = self.streams.get_mut(&key) {
            stream.is_ready = false;
        }
        Some(key)
    }

    /// Streams of a link that are not read to their end.
    pub(crate) fn streams_of(&self, link: u64) -> usize {
        self.streams.keys().filter(|(of, _)| *of == link).count()
    }

    /// A link is over: what of its streams was not read is lost.
    pub(crate) fn link_over(&mut self, link: u64) {
        let keys: Vec<_> = self.streams.keys().filter(|(of, _)| *of == link).copied().collect();
        for key in keys {
            let stream = self.streams.get(&key);
            let lost = stream.filter(|s| matches!(s.step, Step::Ring(_) | Step::Writer(..)));
            if let Some((header, _)) = lost.and_then(|stream| stream.header) {
                self.lost("no_link", header, "the link ended before they were read");
            }
            self.forget(key);
        }
    }

    /// Reads a stream as far as it goes. Returns how many bytes that were, or became by decompression.
    ///
    /// # Errors
    /// The peer broke a rule.
    pub(crate) fn read(
        &mut self,
        key: Key,
        quic: &mut quinn_proto::Connection,
        open: &mut Open<'_>,
        now: Duration,
    ) -> Result<usize, Violation> {
        let Some(mut stream) = self.streams.remove(&key) else { return Ok(0) };
        let mut read = 0;
        loop {
            let step = self.step(key, &mut stream, quic, open, &mut read, now);
            let next = match step {
                Ok(next) => next,
                Err(violation) => {
                    self.release(&mut stream);
                    self.end_turn(key, &stream);
                    return Err(violation);
                }
            };
            match next {
                Next::Go if read < TURN => {}
                Next::Go => {
                    stream.is_ready = true;
                    self.ready.push_back(key);
                    break;
                }
                Next::Wait => break,
                Next::Over => {
                    self.end_turn(key, &stream);
                    return Ok(read);
                }
            }
        }
        self.streams.insert(key, stream);
        Ok(read)
    }

    fn step(
        &mut self,
        key: Key,
        stream: &mut Incoming,
        quic: &mut quinn_proto::Connection,
        open: &mut Open<'_>,
        read: &mut usize,
        now: Duration,
    ) -> Result<Next, Violation> {
        match std::mem::replace(&mut stream.step, Step::Length) {
            Step::Header => {
                let header = match stream.take(HEADER, key.1, quic, read) {
                    Piece::Whole(header) => header,
                    Piece::Later => return Ok(wait(stream, Step::Header)),
                    Piece::End => return Ok(Next::Over),
                };
                let header = StreamHeader::parse(&header)
                    .map_err(|reason| (CloseCode::Malformed, reason.to_owned()))?;
                stream.header = Some((header, None));
                let turns = self.turns.entry((header.route, header.of)).or_default();
                turns.push_back(key);
                self.waiting.insert((now + ARRIVAL, key));
                stream.step = Step::Turn(now + ARRIVAL);
                Ok(Next::Go)
            }
            Step::Turn(until) => Ok(self.begin(key, stream, quic, until, now)),
            Step::Length => {
                let prefix = match stream.take(4, key.1, quic, read) {
                    Piece::Whole(prefix) => prefix,
                    Piece::Later => return Ok(wait(stream, Step::Length)),
                    Piece::End => return Ok(Next::Over),
                };
                let mut bytes = [0; 4];
                bytes.copy_from_slice(&prefix);
                let length = u64::from(u32::from_be_bytes(bytes));
                let limit = self.max_message + MAX_OVERHEAD as u64;
                if length > limit {
                    let text = format!("a message of {length} bytes, at most {limit} are allowed");
                    return Err((CloseCode::TooLarge, text));
                }
                stream.step = Step::Room(length as usize);
                Ok(Next::Go)
            }
            Step::Room(length) => {
                if length > LONG {
                    // One message may always be read, however long.
                    let most = length.min(self.intake.most());
                    let Some(room) = self.intake.charge(most) else {
                        self.without_room.push_back(key);
                        return Ok(wait(stream, Step::Room(length)));
                    };
                    stream.room = Some(room);
                }
                stream.step = Step::Body(length);
                Ok(Next::Go)
            }
            Step::Body(length) => {
                let body = match stream.take(length, key.1, quic, read) {
                    Piece::Whole(body) => body,
                    Piece::Later => return Ok(wait(stream, Step::Body(length))),
                    Piece::End => {
                        self.release(stream);
                        return Ok(Next::Over);
                    }
                };
                self.open(stream, body, open, read, now)
            }
            Step::Writer(message, until) => Ok(self.deliver(key, stream, message, until, now)),
            Step::Ring(message) => Ok(self.deliver(key, stream, message, now, now)),
        }
    }

    /// Begins to read a stream once its route is there and it is its turn.
    fn begin(
        &mut self,
        key: Key,
        stream: &mut Incoming,
        quic: &mut quinn_proto::Connection,
        until: Duration,
        now: Duration,
    ) -> Next {
        let Some((header, _)) = stream.header else { return Next::Over };
        let route = self.routes.get(&header.route);
        let found = route.filter(|route| route.has_flow(&header.of));
        let Some(found) = found else {
            let until = if until == Duration::MAX { now + ARRIVAL } else { until };
            if route.is_some() && now < until {
                self.waiting.insert((until, key));
                return wait(stream, Step::Turn(until));
            }
            self.waiting.remove(&(until, key));
            self.counters.lost(&self.topic(header.route), "no_route", 1);
            let _ = quic.recv_stream(key.1).stop(NO_ROUTE);
            return Next::Over;
        };
        stream.header = Some((header, Some(found.route)));
        self.waiting.remove(&(until, key));
        let turns = self.turns.get(&(header.route, header.of));
        if turns.is_some_and(|turns| turns.front() != Some(&key)) {
            // The stream before it ends at some time, and then it is ready.
            return wait(stream, Step::Turn(Duration::MAX));
        }
        stream.step = Step::Length;
        Next::Go
    }

    /// Opens a message that has arrived.
    fn open(
        &mut self,
        stream: &mut Incoming,
        body: Bytes,
        open: &mut Open<'_>,
        read: &mut usize,
        now: Duration,
    ) -> Result<Next, Violation> {
        let Some((header, Some(route))) = stream.header else { return Ok(Next::Over) };
        let Some((opened, payload)) =
            open_body(open, body, route, self.max_message, now).map_err(refused)?
        else {
            self.lost("no_link", header, "the link ended before they were read");
            self.release(stream);
            return Ok(Next::Go);
        };
        if opened.compressed {
            *read += payload.len();
        }
        let writer = writer_of(route.kind, header.of, &opened)
            .map_err(|text| (CloseCode::Malformed, text.to_owned()))?;
        let meta = Meta {
            sequence: opened.sequence,
            source_timestamp: opened.source_timestamp,
            published: self.published(opened.age_ms, now),
        };
        stream.step = Step::Writer(Message { writer, meta, payload }, now + ARRIVAL);
        Ok(Next::Go)
    }

    /// When a sample of this age was published, in nanoseconds of this host's CLOCK_MONOTONIC.
    fn published(&self, age_ms: u32, now: Duration) -> u64 {
        let arrived = self.epoch_nanos.saturating_add(now.as_nanos() as u64);
        // Zero would say that the lifespan is infinite.
        arrived.saturating_sub(u64::from(age_ms) * 1_000_000).max(1)
    }

    /// Writes a message to its ring.
    fn deliver(
        &mut self,
        key: Key,
        stream: &mut Incoming,
        message: Message,
        until: Duration,
        now: Duration,
    ) -> Next {
        let Some((header, Some(route))) = stream.header else { return Next::Over };
        let found = self.routes.get(&header.route);
        let Some(stand_in) = found.and_then(|route| route.writers.get(&message.writer)) else {
            if found.is_some() && now < until {
                self.waiting.insert((until, key));
                return wait(stream, Step::Writer(message, until));
            }
            self.waiting.remove(&(until, key));
            self.counters.lost(&self.topic(header.route), "no_route", 1);
            self.release(stream);
            return Next::Go;
        };
        self.waiting.remove(&(until, key));
        let acknowledged = header.reliable && route.kind == Kind::Topic;
        let flow = (header.route, header.of);
        let (sequence, length) = (message.meta.sequence, message.payload.len());
        if acknowledged && stand_in.last_sequence() >= Some(sequence) {
            self.receipts.came(flow, sequence, length, now);
            self.release(stream);
            return Next::Go;
        }
        let there = match stand_in.try_write(&header.of, message.meta, &message.payload) {
            Ok(Written::Yes) => {
                self.counters.arrived(length);
                true
            }
            Ok(Written::Nobody) => {
                self.counters.lost(&self.topic(header.route), "no_client", 1);
                false
            }
            Err(RingError::Full) => {
                self.full.insert(key);
                self.full_retry.get_or_insert(now + FULL_RETRY);
                return wait(stream, Step::Ring(message));
            }
            Err(RingError::Lost(why)) => {
                self.lost("ring", header, &why);
                false
            }
        };
        match acknowledged {
            true if there => self.receipts.came(flow, sequence, length, now),
            true => self.receipts.dropped(flow, sequence, now),
            false => {}
        }
        self.release(stream);
        if header.reliable { Next::Go } else { Next::Over }
    }

    /// Gives back the memory of a message, which another stream may wait for.
    fn release(&mut self, stream: &mut Incoming) {
        if stream.room.take().is_some() {
            for key in std::mem::take(&mut self.without_room) {
                self.make_ready(key);
            }
        }
    }

    fn end_turn(&mut self, key: Key, stream: &Incoming) {
        let Some((header, _)) = stream.header else { return };
        let flow = (header.route, header.of);
        let Some(turns) = self.turns.get_mut(&flow) else { return };
        turns.retain(|other| *other != key);
        match turns.front().copied() {
            Some(next) => self.make_ready(next),
            None => {
                self.turns.remove(&flow);
            }
        }
    }

    fn forget(&mut self, key: Key) {
        let Some(mut stream) = self.streams.remove(&key) else { return };
        self.release(&mut stream);
        self.end_turn(key, &stream);
        self.full.remove(&key);
        self.without_room.retain(|other| *other != key);
        if let Step::Turn(until) | Step::Writer(_, until) = stream.step {
            self.waiting.remove(&(until, key));
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) or [`poll_receipt`](Self::poll_receipt) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let waiting = self.waiting.first().map(|(due, _)| *due);
        [waiting, self.full_retry, self.receipts.poll_timeout()].into_iter().flatten().min()
    }

    /// Lets streams go on whose wait is over.
    pub(crate) fn handle_timeout(&mut self, now: Duration) {
        if self.full_retry.is_some_and(|due| due <= now) {
            self.handle_room();
        }
        let due: Vec<_> =
            self.waiting.iter().take_while(|(at, _)| *at <= now).map(|(_, key)| *key).collect();
        due.into_iter().for_each(|key| self.make_ready(key));
    }

    /// The next acknowledgement that is due.
    pub(crate) fn poll_receipt(&mut self, now: Duration) -> Option<Received> {
        self.receipts.poll_message(now)
    }

    fn topic(&self, number: u32) -> Arc<str> {
        let route = self.routes.get(&number);
        route.map_or_else(|| "(a route that ended)".into(), |route| Arc::clone(&route.topic))
    }

    fn lost(&self, cause: &'static str, header: StreamHeader, why: &str) {
        let topic = self.topic(header.route);
        self.counters.lost(&topic, cause, 1);
        if let Some(samples) = self.losses.count(Instant::now()) {
            tracing::warn!(%topic, publisher = %header.of, why, samples, "samples from a peer are lost");
        }
    }
}

/// What a step says.
enum Next {
    /// Take the next one.
    Go,
    /// Nothing more can be done now.
    Wait,
    /// The stream is at its end.
    Over,
}

fn wait(stream: &mut Incoming, step: Step) -> Next {
    stream.step = step;
    Next::Wait
}

fn refused(error: RefusedMessage) -> Violation {
    let code = match error {
        RefusedMessage::Envelope { .. } => CloseCode::Envelope,
        RefusedMessage::Malformed(_) => CloseCode::Malformed,
    };
    (code, error.to_string())
}

/// Opens a body. The payload shares its memory, unless it was compressed.
fn open_body(
    open: &mut Open<'_>,
    body: Bytes,
    route: Route,
    most: u64,
    now: Duration,
) -> Result<Option<(axon_envelope::inner::Header, Bytes)>, RefusedMessage> {
    // An envelope is opened in place, so in memory of its own.
    let body = match open {
        Open::Link => body,
        Open::Envelope { .. } => {
            let mut own = body.try_into_mut().unwrap_or_else(|shared| shared.as_ref().into());
            let start = own.as_ptr().addr();
            let Some(opened) = open.open(&mut own, route, now)? else { return Ok(None) };
            let header = opened.header;
            let payload = match opened.payload(most)? {
                Cow::Owned(payload) => payload.into(),
                Cow::Borrowed(payload) => {
                    let at = payload.as_ptr().addr() - start;
                    let range = at..at + payload.len();
                    own.freeze().slice(range)
                }
            };
            return Ok(Some((header, payload)));
        }
    };
    let opened = super::protection::Opened::plain(&body)?;
    let (header, payload) = (opened.header, opened.payload(most)?);
    let payload = match payload {
        Cow::Owned(payload) => payload.into(),
        Cow::Borrowed(payload) => body.slice_ref(payload),
    };
    Ok(Some((header, payload)))
}
