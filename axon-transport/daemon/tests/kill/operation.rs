//! The operations of the doomed process.

use std::{
    io::Write as _,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    Meta,
    internal::{Reader, RingOptions, SessionSegment, Writer},
};
use axon_transport::{
    ids::{Gid, SessionId},
    qos::Qos,
};

use crate::{around::Around, trace::mark, wire::Wire};

/// The largest message of any case, in bytes.
pub(crate) const LARGEST: u64 = 1 << 16;
/// Bytes of history that a publisher may keep.
const BUDGET: u64 = 8 << 10;
/// Number of samples that a stopped publisher publishes after it continues.
pub(crate) const MORE: u64 = 5;

/// One operation in one situation.
pub(crate) struct Case {
    pub(crate) name: &'static str,
    pub(crate) operation: Operation,
    pub(crate) publisher: Qos,
    pub(crate) reader: Qos,
    /// Number of samples published before the operation; `len` is the length in bytes of these and of the operation's
    /// sample.
    pub(crate) before: u64,
    pub(crate) len: usize,
    /// Number of samples taken before the operation.
    pub(crate) taken: u64,
    /// Number of samples taken after those, which the survivor keeps pinned.
    pub(crate) pinned: u64,
    pub(crate) around: Around,
    /// True if the operation has so many instructions that a bounded run does not walk it.
    pub(crate) long: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Operation {
    // In these operations the publisher dies.
    Create,
    Attach,
    Publish,
    /// Publishes to a reader that sleeps.
    Wake,
    /// Publishes a sample for which a KEEP_ALL reader leaves no room.
    PublishHeld,
    /// Publishes a sample for which a resource is short.
    PublishRefused,
    LoanAndPublish,
    LoanAndDrop,
    Detach,
    DropWriter,
    /// Prepares memory for the next large sample.
    Prepare,
    /// Releases memory of large samples that nobody needs.
    Tend,
    // In these operations the reader dies.
    Map,
    Take,
    /// Takes a large sample in place.
    Pin,
    Unpin,
    /// Drops such a sample after its reader.
    UnpinLast,
    Peek,
    Skip,
    DropReader,
}

impl Operation {
    pub(crate) fn kills_publisher(self) -> bool {
        use Operation::{DropReader, Map, Peek, Pin, Skip, Take, Unpin, UnpinLast};
        !matches!(self, Map | Take | Pin | Unpin | UnpinLast | Peek | Skip | DropReader)
    }

    /// Returns the number of samples that the operation publishes.
    pub(crate) fn publishes(self) -> u64 {
        u64::from(matches!(self, Self::Publish | Self::Wake | Self::LoanAndPublish))
    }
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
    Meta::at_nanos(sequence, sequence.cast_signed() * 7 - 3)
}

/// Returns bytes that differ by sequence number and offset.
pub(crate) fn payload(sequence: u64, len: usize) -> Vec<u8> {
    let mut state = sequence.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state = state.wrapping_mul(0xbf58_476d_1ce4_e5b9).rotate_left(23) ^ sequence;
        state.to_le_bytes()
    };
    (0..len.div_ceil(8)).flat_map(|_| next()).take(len).collect()
}

impl Case {
    /// Runs the publisher that dies.
    pub(crate) fn publish(&self, wire: &Wire) {
        let session = session();
        if self.operation == Operation::Create {
            self.around.begin();
            mark();
            let writer = writer(&session, self.publisher);
            wire.offer(&session, &writer);
            mark();
            return;
        }
        let writer = writer(&session, self.publisher);
        wire.offer(&session, &writer);
        let (info, _) = wire.take_request(self.reader);
        let reader = info.gid;
        let mut request = Some(info);
        if self.operation != Operation::Attach {
            let info = request.take().expect("a request");
            wire.grant(writer.attach(info).expect("an attachment"));
        }
        for sequence in 0..self.before {
            writer.publish(meta(sequence), &payload(sequence, self.len)).expect("room");
        }
        let bytes = payload(self.before, self.len);
        let start = Instant::now();
        writer.reclaim_idle(start);
        self.around.begin();
        mark();
        match self.operation {
            Operation::Attach => {
                let request = request.expect("a request");
                wire.grant(writer.attach(request).expect("an attachment"));
            }
            Operation::Publish | Operation::Wake => {
                writer.publish(meta(self.before), &bytes).expect("room");
            }
            Operation::PublishHeld => {
                writer.try_publish(meta(self.before), &bytes).expect_err("a held publisher");
            }
            Operation::PublishRefused => {
                writer.publish(meta(self.before), &bytes).expect_err("what is short");
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
            Operation::Detach => assert!(writer.detach(reader)),
            Operation::DropWriter => return self.drop_writer(writer),
            Operation::Prepare => writer.prepare().expect("memory"),
            Operation::Tend => {
                let kept = writer.reclaim_idle(start + Duration::from_secs(60));
                assert_eq!(kept, self.pinned > 0);
            }
            other => unreachable!("{other:?} is the reader's"),
        }
        mark();
        // Only a stopped process gets here.
        wire.wait();
        let next = self.before + self.operation.publishes();
        for sequence in next..next + MORE {
            writer.publish(meta(sequence), &payload(sequence, self.len)).expect("room");
        }
    }

    fn drop_writer(&self, writer: Writer) {
        drop(writer);
        mark();
    }

    /// Runs the reader that dies.
    pub(crate) fn read(&self, wire: &Wire) {
        let session = session();
        let (granted, _) = wire.join(&session, self.reader);
        if self.operation == Operation::Map {
            wire.wait();
            self.around.begin();
            mark();
            let reader = granted.map();
            mark();
            return self.read_on(wire, reader);
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
        let unpins = matches!(self.operation, Operation::Unpin | Operation::UnpinLast);
        let mut sample = unpins.then(|| reader.take_sample().expect("a ring").expect("a sample"));
        let mut reader = Some(reader);
        if self.operation == Operation::UnpinLast {
            reader = None;
        }
        wire.go();
        wire.wait();
        self.around.begin();
        mark();
        match (self.operation, &mut reader) {
            (Operation::Take, Some(reader)) => drop(reader.take(&mut out).expect("a ring")),
            (Operation::Pin, Some(reader)) => sample = reader.take_sample().expect("a ring"),
            (Operation::Unpin | Operation::UnpinLast, _) => sample = None,
            (Operation::Peek, Some(reader)) => drop(reader.peek().expect("a ring")),
            (Operation::Skip, Some(reader)) => assert!(reader.skip()),
            (Operation::DropReader, reader) => *reader = None,
            (other, _) => unreachable!("{other:?} is the publisher's"),
        }
        mark();
        assert!(sample.is_none_or(|sample| sample.is_borrowed()));
        if let Some(reader) = reader {
            self.read_on(wire, reader);
        }
    }

    /// Takes all samples after a stopped reader continues, and reports how many.
    fn read_on(&self, wire: &Wire, mut reader: Reader) {
        wire.wait();
        let mut out = Vec::new();
        while let Some(taken) = reader.take(&mut out).expect("a ring") {
            assert!(out == payload(taken.meta.sequence, self.len), "{taken:?} is torn");
        }
        let first = reader.grant().first;
        wire.count([first, reader.received(), reader.lost(), reader.skipped()]);
    }
}
