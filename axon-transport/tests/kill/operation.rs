//! What the doomed process does.

use std::{
    io::Write as _,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_transport::{
    ids::{Gid, SessionId},
    qos::{Durability, History, Qos},
    shm::{Meta, Reader, RingOptions, SessionSegment, Writer},
};

use crate::{trace::mark, wire::Wire};

/// The largest message of any case, in bytes.
pub(crate) const LARGEST: u64 = 1 << 16;
/// Bytes of history that a publisher may keep.
const BUDGET: u64 = 8 << 10;

/// One operation in one situation.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    pub(crate) operation: Operation,
    pub(crate) publisher: Qos,
    pub(crate) reader: Qos,
    /// Samples published before the operation, and their length and the operation's in bytes.
    pub(crate) before: u64,
    pub(crate) len: usize,
    /// Samples taken before the operation.
    pub(crate) taken: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Operation {
    // The publisher dies in these.
    Create,
    Attach,
    Publish,
    /// Of which a KEEP_ALL reader has no room for more.
    PublishHeld,
    LoanAndPublish,
    LoanAndDrop,
    Detach,
    DropWriter,
    /// Memory is made ready for the next large sample.
    Prepare,
    /// Memory of large samples that nobody needs any more is given up.
    Tend,
    // The reader dies in these.
    Map,
    Take,
    Peek,
    Skip,
    DropReader,
}

impl Operation {
    pub(crate) fn kills_publisher(self) -> bool {
        use Operation::{
            Attach, Create, Detach, DropWriter, LoanAndDrop, LoanAndPublish, Prepare, Publish,
            PublishHeld, Tend,
        };
        matches!(
            self,
            Create
                | Attach
                | Publish
                | PublishHeld
                | LoanAndPublish
                | LoanAndDrop
                | Detach
                | DropWriter
                | Prepare
                | Tend
        )
    }

    /// Samples that the operation publishes.
    pub(crate) fn publishes(self) -> u64 {
        u64::from(matches!(self, Self::Publish | Self::LoanAndPublish))
    }
}

pub(crate) fn cases() -> Vec<Case> {
    use Operation::*;
    let last = |depth| Qos { history: History::KeepLast, depth, ..Qos::default() };
    let all = Qos::keep_all();
    let latched = |depth| Qos { durability: Durability::TransientLocal, ..last(depth) };
    let case = |name, operation, reader: Qos, (before, taken), len| {
        let publisher = if reader.history == History::KeepAll { all } else { last(1) };
        let publisher = Qos { durability: reader.durability, ..publisher };
        Case { name, operation, publisher, reader, before, len, taken }
    };
    vec![
        case("create a ring", Create, last(4), (0, 0), 0),
        case("attach a reader", Attach, last(4), (0, 0), 40),
        case("attach a reader that gets history", Attach, latched(1), (2, 1), 40),
        case("publish nothing", Publish, last(4), (0, 0), 0),
        case("publish inline, the first", Publish, last(4), (0, 0), 96),
        case("publish inline", Publish, last(4), (3, 1), 8),
        case("publish inline to a reader with all unread", Publish, last(20), (30, 0), 96),
        case("publish inline over the ring's end", Publish, last(4), (32, 2), 52),
        case("publish over the first descriptor", Publish, last(20), (32, 15), 52),
        case("publish and grow", Publish, last(4), (16, 2), 52),
        case("publish and grow, all unread", Publish, last(20), (16, 0), 96),
        case("publish and grow, by copy", Publish, all, (16, 10), 300),
        case("publish and open a segment for descriptors", Publish, last(3000), (1024, 1000), 8),
        case("publish and move to that segment", Publish, last(3000), (1025, 1000), 8),
        case("publish by copy, the first", Publish, last(4), (0, 0), 97),
        case("publish by copy", Publish, last(4), (3, 1), 1024),
        case("publish by copy in place of the oldest", Publish, last(20), (8, 0), 1024),
        case("publish by copy in place of many", Publish, last(20), (40, 20), 200),
        case("publish a large one, the first", Publish, last(1), (0, 0), 5000),
        case("publish a large one", Publish, last(1), (2, 1), 5000),
        case("publish a large one, the first", Publish, last(4), (0, 0), 5000),
        case("publish a large one in place of one that was taken", Publish, last(4), (4, 1), 5000),
        case("have memory ready for a large one", Prepare, last(4), (1, 1), 5000),
        case("give the memory of large ones up", Tend, last(4), (2, 2), 5000),
        case("publish, KEEP_ALL", Publish, all, (3, 3), 300),
        case("publish, KEEP_ALL and held", PublishHeld, all, (8, 0), 1024),
        case("loan, write, publish inline", LoanAndPublish, last(4), (3, 1), 60),
        case("loan, write, publish", LoanAndPublish, last(4), (3, 1), 2000),
        case("loan, drop", LoanAndDrop, last(4), (3, 1), 2000),
        case("detach a reader", Detach, last(4), (3, 1), 300),
        case("drop the publisher", DropWriter, last(4), (3, 1), 300),
        case("map a ring", Map, last(4), (3, 0), 300),
        case("take inline", Take, last(4), (3, 1), 60),
        case("take by copy", Take, last(4), (3, 1), 1024),
        case("take a large one", Take, last(1), (2, 0), 5000),
        case("take from a ring that grew", Take, last(20), (20, 3), 60),
        case("take over what its depth skips", Take, last(2), (9, 0), 100),
        case("take over what is lost", Take, last(20), (12, 0), 1024),
        case("take, KEEP_ALL, held publisher", Take, all, (8, 0), 1024),
        case("take nothing", Take, last(4), (2, 2), 10),
        case("peek", Peek, last(4), (3, 1), 1024),
        case("skip", Skip, last(4), (3, 1), 1024),
        case("drop the reader", DropReader, last(4), (3, 1), 300),
        case("drop the reader, KEEP_ALL", DropReader, all, (8, 2), 1024),
    ]
}

pub(crate) fn session() -> Arc<SessionSegment> {
    SessionSegment::create(SessionId::random()).expect("a session")
}

pub(crate) fn writer(session: &Arc<SessionSegment>, qos: Qos) -> Writer {
    let gid = Gid::new(session.id(), 1);
    let (budget, max_message) = (BUDGET, LARGEST);
    let options = RingOptions { gid, qos, budget, max_message, expected: 0 };
    Writer::create(session.clone(), options).expect("a ring")
}

pub(crate) fn meta(sequence: u64) -> Meta {
    Meta { sequence, source_timestamp: sequence.cast_signed() * 7 - 3 }
}

/// Bytes that differ by sequence number and place.
pub(crate) fn payload(sequence: u64, len: usize) -> Vec<u8> {
    let mut state = sequence.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state = state.wrapping_mul(0xbf58_476d_1ce4_e5b9).rotate_left(23) ^ sequence;
        state.to_le_bytes()
    };
    (0..len.div_ceil(8)).flat_map(|_| next()).take(len).collect()
}

impl Case {
    /// The life of the publisher that dies.
    pub(crate) fn publish(&self, wire: &Wire) {
        let session = session();
        if self.operation == Operation::Create {
            mark();
            let writer = writer(&session, self.publisher);
            wire.offer(&session, &writer);
            mark();
            return;
        }
        let writer = writer(&session, self.publisher);
        let mut request = None;
        let mut reader = None;
        if self.operation == Operation::Attach {
            wire.offer(&session, &writer);
            request = Some(wire.take_request(self.reader).0);
        } else {
            wire.offer(&session, &writer);
            let (info, _) = wire.take_request(self.reader);
            reader = Some(info.gid);
            wire.grant(writer.attach(info).expect("an attachment"));
        }
        for sequence in 0..self.before {
            writer.publish(meta(sequence), &payload(sequence, self.len)).expect("room");
        }
        let bytes = payload(self.before, self.len);
        let start = Instant::now();
        writer.tend(start);
        mark();
        match self.operation {
            Operation::Attach => {
                let request = request.expect("a request");
                wire.grant(writer.attach(request).expect("an attachment"));
            }
            Operation::Publish => {
                writer.publish(meta(self.before), &bytes).expect("room");
            }
            Operation::PublishHeld => {
                writer.try_publish(meta(self.before), &bytes).expect_err("a held publisher");
            }
            Operation::LoanAndPublish => {
                let mut loan = writer.loan(self.len).expect("a loan");
                loan.write_all(&bytes).expect("room in a loan");
                loan.publish(meta(self.before)).expect("room");
            }
            Operation::LoanAndDrop => {
                let mut loan = writer.loan(self.len).expect("a loan");
                loan.write_all(&bytes).expect("room in a loan");
            }
            Operation::Detach => assert!(writer.detach(reader.expect("a reader"))),
            Operation::DropWriter => drop(writer),
            Operation::Prepare => writer.prepare().expect("memory"),
            Operation::Tend => assert!(!writer.tend(start + Duration::from_secs(60))),
            other => unreachable!("{other:?} is the reader's"),
        }
        mark();
    }

    /// The life of the reader that dies.
    pub(crate) fn read(&self, wire: &Wire) {
        let session = session();
        let (granted, _) = wire.join(&session, self.reader);
        if self.operation == Operation::Map {
            wire.wait();
            mark();
            let _reader = granted.map();
            return mark();
        }
        let peer = granted.peer.clone();
        let mut reader: Reader = granted.map();
        wire.go();
        wire.wait();
        wire.take_segments(&peer);
        let mut out = Vec::with_capacity(self.len);
        for _ in 0..self.taken {
            reader.take(&mut out).expect("a ring").expect("a sample");
        }
        wire.go();
        wire.wait();
        mark();
        match self.operation {
            Operation::Take => drop(reader.take(&mut out).expect("a ring")),
            Operation::Peek => drop(reader.peek().expect("a ring")),
            Operation::Skip => assert!(reader.skip()),
            Operation::DropReader => drop(reader),
            other => unreachable!("{other:?} is the publisher's"),
        }
        mark();
    }
}
