mod copies;
mod limited;

use std::{
    cell::{Cell, RefCell},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_envelope::{Kind, Route, TopicHash, inner};
use axon_shm::{Meta, ids::Gid, internal::MemoryBudget, qos::Qos};
use axon_transport::{
    EndpointSpec, MessageInfo,
    graph::{Endpoint, EndpointKind},
    internal::session::Written,
};
use bytes::Bytes;
use quinn_proto::{Dir, Side, StreamId};

use super::{
    Inbound, RouteIn,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::StepOutcome,
};
use crate::engine::sample::stream_header::StreamHeader;
use crate::{
    engine::{
        account::{Accounts, MessageMemory},
        rings::{RingError, RingReader, RingWriter, Rings},
        sample::{
            protection::Open,
            short_header::{ShortHeader, ShortHeaders},
        },
        stand_in::StandIns,
    },
    link::{CloseCode, ReceivedOf},
};

const PUBLISHER: Gid = Gid([1; 16]);
const ROUTE: u32 = 7;
const NOW: Duration = Duration::from_secs(1);

/// A ring that takes so many samples.
struct Ring {
    endpoint: Endpoint,
    room: Cell<usize>,
    /// Others have the memory for samples of at least this length.
    short_from: Cell<usize>,
    samples: RefCell<Vec<(u64, Bytes)>>,
    /// Samples that no reader was woken for.
    quiet: Cell<usize>,
}

impl RingWriter for Ring {
    fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    fn partners(&self) -> Vec<Gid> {
        Vec::new()
    }

    fn try_write(&self, _client: &Gid, meta: Meta, payload: &[u8]) -> Result<Written, RingError> {
        if payload.len() >= self.short_from.get() {
            return Err(RingError::Short("others have it".into()));
        }
        let Some(left) = self.room.get().checked_sub(1) else { return Err(RingError::Full) };
        self.room.set(left);
        self.quiet.set(self.quiet.get() + 1);
        self.samples.borrow_mut().push((meta.sequence, Bytes::copy_from_slice(payload)));
        Ok(Written::Yes)
    }

    fn announce(&self) {
        self.quiet.set(0);
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

/// A host with one ring.
struct One(Rc<Ring>);

impl Rings for One {
    fn open_reader(
        &self,
        _spec: EndpointSpec,
        _stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String> {
        Err("it has no readers".into())
    }

    fn open_writer(
        &self,
        _remote: &Endpoint,
        _held: &Arc<MemoryBudget>,
    ) -> Result<Rc<dyn RingWriter>, String> {
        Ok(Rc::clone(&self.0) as Rc<dyn RingWriter>)
    }

    fn take_active(&self, _found: &mut Vec<(Gid, Gid)>) {}

    fn set_waiting_for_room(&self, _waiting: bool) {}
}

/// A stream of a publisher that is read.
struct Way {
    ring: Rc<Ring>,
    inbound: Inbound,
    stream: IncomingStream,
    written: ShortHeaders,
}

impl Way {
    fn new(kind: Kind, short: bool, room: usize) -> Self {
        let endpoint =
            Endpoint::new(PUBLISHER, EndpointKind::Publisher, "/t", "T").with_qos(Qos::keep_all());
        let ring = Rc::new(Ring {
            endpoint: endpoint.clone(),
            room: Cell::new(room),
            short_from: Cell::new(usize::MAX),
            samples: RefCell::default(),
            quiet: Cell::new(0),
        });
        let account = Accounts::new(1 << 20, 1 << 20).of_one("peer");
        let stand_in = StandIns::default().get(&One(Rc::clone(&ring)), &endpoint, &account, NOW);
        let mut inbound =
            Inbound::new(Rc::default(), MessageMemory::new(1 << 20, 1 << 20), 1 << 20, 0);
        let route = Route { kind, topic: TopicHash::new(0, "/t", "T").unwrap() };
        let mut into = RouteIn::new("/t".into(), route, Vec::new());
        into.writers.insert(PUBLISHER, stand_in.unwrap());
        inbound.routes().insert(ROUTE, into);
        let header = StreamHeader {
            reliable: true,
            copy: false,
            short,
            acknowledged: false,
            route: ROUTE,
            of: PUBLISHER,
        };
        let stream = IncomingStream {
            step: StreamStep::Length,
            header: Some((header, Some(route))),
            headers: short.then(ShortHeaders::default),
            ..IncomingStream::default()
        };
        Self { ring, inbound, stream, written: ShortHeaders::default() }
    }

    /// A message as it stands in the stream.
    fn message(&mut self, sequence: u64, payload: &[u8]) -> Vec<u8> {
        let header = match self.stream.headers {
            Some(_) => {
                let told = ShortHeader { sequence, source_timestamp: 1000, age_ms: 5 };
                self.written.write(told).as_slice().to_vec()
            }
            None => inner::Header {
                gid: PUBLISHER.0,
                sequence,
                source_timestamp: 1000,
                request_id: inner::RequestId::default(),
                compressed: false,
                age_ms: 5,
                uncompressed_len: payload.len() as u32,
            }
            .encode()
            .to_vec(),
        };
        let length = ((header.len() + payload.len()) as u32).to_be_bytes();
        [&length[..], &header, payload].concat()
    }

    fn messages(&mut self, numbers: impl IntoIterator<Item = u64>) -> Vec<u8> {
        numbers.into_iter().flat_map(|number| self.message(number, &number.to_be_bytes())).collect()
    }

    /// QUIC gave this, and the stream is read. The code with which a violation ends the link.
    fn read(&mut self, bytes: Vec<u8>) -> Result<Option<StepOutcome>, CloseCode> {
        self.stream.chunk = bytes.into();
        let key = (1, StreamId::new(Side::Client, Dir::Uni, 0));
        let run = self.inbound.run(key, &mut self.stream, &mut Open::Link, NOW);
        run.map_err(|(code, _)| code)
    }

    fn numbers(&self) -> Vec<u64> {
        let samples = self.ring.samples.borrow();
        assert!(samples.iter().all(|(number, payload)| payload[..] == number.to_be_bytes()));
        samples.iter().map(|(number, _)| *number).collect()
    }

    /// What is acknowledged in the end.
    fn acknowledged(&mut self) -> Option<ReceivedOf> {
        let received = self.inbound.poll_receipt(NOW + Duration::from_secs(1000))?;
        received.flows.into_iter().next()
    }
}

#[test]
fn the_whole_samples_of_a_piece_are_delivered_together() {
    for short in [true, false] {
        let mut way = Way::new(Kind::Topic, short, 1000);
        let mut piece = way.messages(1..=100);
        let half = way.message(101, b"half");
        piece.extend_from_slice(&half[..half.len() - 1]);
        assert!(matches!(way.read(piece), Ok(None)), "the next step gathers the half one");
        assert_eq!(way.numbers(), (1..=100).collect::<Vec<_>>());
        assert_eq!(way.stream.chunk[..], half[..half.len() - 1]);
        // As many as these are acknowledged at once.
        assert_eq!(way.inbound.poll_timeout(), Some(NOW));
        let of = ReceivedOf { route: ROUTE, publisher: PUBLISHER, sequence: 100, dropped: 0 };
        assert_eq!(way.acknowledged(), Some(of));
        // The caller of `run` wakes the readers, once.
        assert_eq!(way.ring.quiet.get(), 100);
        way.inbound.written.take().unwrap().announce();
        assert_eq!(way.ring.quiet.get(), 0);
    }
}

#[test]
fn a_full_ring_keeps_the_sample_that_has_no_room() {
    for short in [true, false] {
        let mut way = Way::new(Kind::Topic, short, 3);
        let piece = way.messages(1..=5);
        assert!(matches!(way.read(piece), Ok(Some(StepOutcome::Wait))));
        assert_eq!(way.numbers(), [1, 2, 3]);
        let StreamStep::Ring(message) = &way.stream.step else { panic!("{:?}", way.stream.step) };
        assert_eq!((message.meta.sequence, message.writer), (4, PUBLISHER));
        assert_eq!(message.payload[..], 4_u64.to_be_bytes());
        assert!(way.inbound.waits_for_room());
        assert_eq!(way.acknowledged().unwrap().sequence, 3);
        // Number 5 is next.
        let rest = way.stream.chunk.to_vec();
        way.ring.room.set(1);
        way.stream.step = StreamStep::Length;
        assert!(matches!(way.read(rest), Ok(None)));
        assert_eq!(way.numbers(), [1, 2, 3, 5]);
    }
}

#[test]
fn samples_that_came_before_are_acknowledged_and_not_written_again() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    let piece = way.messages([5, 6, 4, 5, 6, 7]);
    assert!(matches!(way.read(piece), Ok(None)));
    assert_eq!(way.numbers(), [5, 6, 7]);
    assert_eq!(way.acknowledged().unwrap().sequence, 7);
}

#[test]
fn a_sample_of_another_publisher_ends_the_link_and_those_before_it_count() {
    let mut way = Way::new(Kind::Topic, false, 1000);
    let mut piece = way.messages(1..=2);
    let mut other = way.message(3, &3_u64.to_be_bytes());
    // The GID behind the length.
    other[4] ^= 1;
    piece.extend_from_slice(&other);
    assert_eq!(way.read(piece).err(), Some(CloseCode::Malformed));
    assert_eq!(way.numbers(), [1, 2]);
    assert_eq!(way.acknowledged().unwrap().sequence, 2);
}

#[test]
fn a_short_header_that_is_none_ends_the_link() {
    for body in [&[][..], &[1, 0x80], &[0xff; 20]] {
        let mut way = Way::new(Kind::Topic, true, 1000);
        let piece = [&(body.len() as u32).to_be_bytes()[..], body].concat();
        assert_eq!(way.read(piece).err(), Some(CloseCode::Malformed), "{body:?}");
        assert!(way.numbers().is_empty() && way.acknowledged().is_none());
    }
}

#[test]
fn steps_read_samples_that_are_long_or_of_a_service() {
    let mut way = Way::new(Kind::Topic, true, 1000);
    let piece = way.message(1, &[0; super::LONG_MESSAGE_BYTES]);
    assert!(matches!(way.read(piece.clone()), Ok(None)));
    assert_eq!(way.stream.chunk.len(), piece.len());
    let mut way = Way::new(Kind::Request, false, 1000);
    let piece = way.messages(1..=2);
    assert!(matches!(way.read(piece.clone()), Ok(None)));
    assert_eq!(way.stream.chunk.len(), piece.len());
}

#[test]
fn a_call_of_a_client_that_is_gone_is_acknowledged_as_dropped() {
    let mut way = Way::new(Kind::Request, false, 1000);
    let (header, _) = way.stream.header.as_mut().unwrap();
    header.acknowledged = true;
    let meta =
        way.inbound.meta(ShortHeader { sequence: 4, source_timestamp: 1000, age_ms: 5 }, NOW);
    let message = OpenedMessage { writer: Gid([9; 16]), number: 4, meta, payload: Bytes::new() };
    let key = (1, StreamId::new(Side::Client, Dir::Uni, 0));
    let next = way.inbound.deliver(key, &mut way.stream, message, NOW, NOW);
    assert!(matches!(next, StepOutcome::Go));
    let of = ReceivedOf { route: ROUTE, publisher: PUBLISHER, sequence: 4, dropped: 1 };
    assert_eq!(way.acknowledged(), Some(of));
}

/// Delivers the sample of this number and length, again each 100 ms while it waits. For how long it waited.
fn deliver_in_time(
    way: &mut Way,
    number: u64,
    length: usize,
    ring: impl Fn(&Ring, Duration),
) -> Duration {
    let key = (1, StreamId::new(Side::Client, Dir::Uni, 0));
    let meta =
        way.inbound.meta(ShortHeader { sequence: number, source_timestamp: 1000, age_ms: 5 }, NOW);
    let mut message =
        Some(OpenedMessage { writer: PUBLISHER, number, meta, payload: vec![0; length].into() });
    let mut waited = Duration::ZERO;
    while let Some(next) = message.take() {
        assert!(waited < Duration::from_secs(300), "it waits for ever");
        ring(&way.ring, waited);
        way.inbound.deliver(key, &mut way.stream, next, NOW, NOW + waited);
        if let StreamStep::Ring(waits) = std::mem::replace(&mut way.stream.step, StreamStep::Length)
        {
            message = Some(waits);
            waited += super::FULL_RETRY;
        }
    }
    waited
}

#[test]
fn sample_without_memory_is_dropped_in_the_end_and_reported() {
    let secs = Duration::from_secs;
    for kind in [Kind::Topic, Kind::Request] {
        let mut way = Way::new(kind, false, 10);
        way.inbound.routes().get_mut(&ROUTE).unwrap().keeps_all = true;
        let (header, _) = way.stream.header.as_mut().unwrap();
        header.acknowledged = true;
        way.ring.short_from.set(100);
        // Others give it back in time.
        let in_time = |ring: &Ring, waited| {
            if waited >= secs(50) {
                ring.short_from.set(usize::MAX);
            }
        };
        assert_eq!(deliver_in_time(&mut way, 1, 100, in_time), secs(50));
        assert_eq!(way.acknowledged().map(|of| (of.sequence, of.dropped)), Some((1, 0)));
        // They never do. What a reader keeps of its own ring is another matter: it may take its time.
        way.ring.short_from.set(100);
        let full_at_first = |ring: &Ring, waited: Duration| {
            let is_full = waited < secs(100) && waited > secs(30);
            ring.short_from.set(if is_full { usize::MAX } else { 100 });
            ring.room.set(if is_full { 0 } else { 10 });
        };
        let waited = deliver_in_time(&mut way, 2, 100, full_at_first);
        assert_eq!(waited, secs(160));
        assert_eq!(way.acknowledged().map(|of| (of.sequence, of.dropped)), Some((2, 1)));
        let lost = way.inbound.counters.take_lost();
        assert_eq!((lost.len(), lost[0].cause, lost[0].samples), (1, "held", 1));
        // It is not delivered when it comes again, and what is behind it is.
        way.ring.short_from.set(usize::MAX);
        assert_eq!(deliver_in_time(&mut way, 2, 100, |_, _| {}), Duration::ZERO);
        assert_eq!(deliver_in_time(&mut way, 3, 8, |_, _| {}), Duration::ZERO);
        assert_eq!(way.ring.samples.borrow().iter().map(|(n, _)| *n).collect::<Vec<_>>(), [1, 3]);
    }
}
