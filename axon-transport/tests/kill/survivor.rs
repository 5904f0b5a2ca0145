//! The process at the other end: what it does before the kill, and what must hold for it after.

use std::{fs, os::fd::OwnedFd, sync::Arc};

use axon_transport::{
    ids::Gid,
    qos::Qos,
    shm::{Peer, PeerSession, Reader, ReaderInfo, ReaderOptions, SessionSegment, Writer},
};

use crate::{
    operation::{Case, LARGEST, Operation, meta, payload, session, writer},
    trace::Tracee,
    wire::{Wire, options},
};

/// What a scene shows once the doomed process is dead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Outcome {
    /// Whether the operation's sample was there.
    pub(crate) shown: bool,
    /// Whether the operation had come to its end.
    pub(crate) done: bool,
}

/// The survivor and the doomed, the latter at the operation's beginning.
pub(crate) struct Scene<'a> {
    case: &'a Case,
    wire: Wire,
    session: Arc<SessionSegment>,
    tracee: Tracee,
    end: End,
    /// Those segments that the doomed process writes.
    pub(crate) written: Vec<OwnedFd>,
    done: bool,
}

/// What the survivor holds.
enum End {
    Nothing,
    Waiting(Box<LateReader>),
    Reader(Box<Reader>, Arc<PeerSession>),
    Writer(Box<Writer>),
}

/// Maps a reader once the publisher has granted it, if it has.
type LateReader = dyn FnOnce(&Wire) -> Option<Reader>;

impl<'a> Scene<'a> {
    pub(crate) fn set(case: &'a Case) -> Self {
        let publishes = case.operation.kills_publisher();
        let doomed = |wire: Wire| if publishes { case.publish(&wire) } else { case.read(&wire) };
        let (tracee, (wire, session, end, written)) = Tracee::start(Wire::pair(), doomed, |wire| {
            let session = session();
            let set = if publishes { join } else { serve };
            let (end, written) = set(case, &wire, &session);
            (wire, session, end, written)
        });
        let mut scene = Self { case, wire, session, tracee, end, written, done: false };
        scene.look_for_segments();
        if let End::Reader(reader, _) = &mut scene.end {
            for _ in 0..case.taken {
                check_next(case, reader).expect("a sample");
            }
        }
        scene
    }

    /// Lets the doomed process take up to `steps` instructions. Whether it came to the end.
    pub(crate) fn advance(&mut self, steps: u64) -> bool {
        self.done = self.tracee.advance(steps);
        self.done
    }

    /// Takes in the segments that the doomed process has opened.
    pub(crate) fn look_for_segments(&mut self) {
        if let End::Reader(_, peer) = &self.end {
            self.written.extend(self.wire.take_segments(peer));
        }
    }

    /// Kills it and checks all that must hold.
    pub(crate) fn kill(mut self) -> Outcome {
        self.tracee.end();
        self.look_for_segments();
        let Self { case, wire, session, end, written, done, .. } = self;
        drop(written);
        let shown = match end {
            End::Nothing => false,
            End::Waiting(map) => match map(&wire) {
                Some(reader) => drain(case, done, reader),
                None => false,
            },
            End::Reader(reader, _) => drain(case, done, *reader),
            End::Writer(writer) => {
                go_on(case, &session, &writer);
                false
            }
        };
        another_pair(&session);
        Outcome { shown, done }
    }
}

/// The survivor reads.
fn join(case: &Case, wire: &Wire, session: &Arc<SessionSegment>) -> (End, Vec<OwnedFd>) {
    match case.operation {
        Operation::Create => (End::Nothing, Vec::new()),
        Operation::Attach => {
            let offer = wire.take_offer();
            let lane = session.allocate_lane().expect("a lane");
            wire.ask(session, &lane);
            let (session, qos) = (session.clone(), case.reader);
            let map = move |wire: &Wire| {
                let grant = wire.take_grant()?;
                wire.take_segments(&offer.peer);
                let (peer, writer, ring) = (offer.peer, offer.writer, offer.ring);
                let options = options(&session, peer, writer, ring, lane, grant, qos);
                Some(Reader::map(options).expect("a ring"))
            };
            (End::Waiting(Box::new(map)), offer.seen)
        }
        _ => {
            let (granted, seen) = wire.join(session, case.reader);
            let peer = granted.peer.clone();
            (End::Reader(Box::new(granted.map()), peer), seen)
        }
    }
}

/// The survivor publishes.
fn serve(case: &Case, wire: &Wire, session: &Arc<SessionSegment>) -> (End, Vec<OwnedFd>) {
    let writer = writer(session, case.publisher);
    let seen = wire.serve(session, &writer, case.reader);
    let mapped_first = case.operation != Operation::Map;
    if mapped_first {
        wire.wait();
    }
    for sequence in 0..case.before {
        writer.publish(meta(sequence), &payload(sequence, case.len)).expect("room");
    }
    wire.go();
    if mapped_first {
        wire.wait();
        wire.go();
    }
    (End::Writer(Box::new(writer)), seen)
}

/// The next sample, which must be whole. Its sequence number.
fn check_next(case: &Case, reader: &mut Reader) -> Option<u64> {
    let mut out = Vec::new();
    let taken = reader.take(&mut out).expect("a sound ring")?;
    let sequence = taken.meta.sequence;
    assert_eq!(taken.meta, meta(sequence));
    assert!(out == payload(sequence, case.len), "sample {sequence} is torn");
    Some(sequence)
}

/// Takes all that the dead publisher left, and counts. Whether the operation's sample was there.
fn drain(case: &Case, done: bool, mut reader: Reader) -> bool {
    assert!(reader.writer_dead(), "its pidfd says so");
    let first = reader.grant().first;
    let mut last = None;
    while let Some(sequence) = check_next(case, &mut reader) {
        assert!(last < Some(sequence), "{sequence} after {last:?}");
        last = Some(sequence);
    }
    assert!(reader.is_drained());
    let counted = first + reader.received() + reader.lost() + reader.skipped();
    let shown = counted > case.before;
    assert_eq!(counted - u64::from(shown), case.before, "every sample is counted once");
    if shown {
        assert_eq!(case.operation.publishes(), 1);
        assert_eq!(last, Some(case.before), "a sample that counts is there");
    }
    if done {
        assert_eq!(u64::from(shown), case.operation.publishes(), "what was published is there");
    }
    shown
}

/// The publisher goes on without its dead reader.
fn go_on(case: &Case, session: &Arc<SessionSegment>, writer: &Writer) {
    let mut sequence = case.before;
    let mut publish = |count: u64| {
        for _ in 0..count {
            writer.publish(meta(sequence), &payload(sequence, case.len)).expect("it is not held");
            sequence += 1;
        }
        sequence
    };
    publish(3 * 16);
    assert!(writer.drop_dead().len() <= 1);
    assert!(!writer.has_readers());
    publish(3 * 16);
    let mut reader = attach(session, writer, case.reader);
    let end = publish(1);
    assert_eq!(check_next(case, &mut reader), Some(end - 1));
    assert_eq!(check_next(case, &mut reader), None);
    assert_eq!((reader.received(), reader.lost(), reader.skipped()), (1, 0, 0));
}

/// The survivor's session still serves.
fn another_pair(session: &Arc<SessionSegment>) {
    let writer = writer(session, Qos::default());
    let mut reader = attach(session, &writer, Qos::default());
    writer.publish(meta(0), b"still here").expect("room");
    let mut out = Vec::new();
    assert!(reader.take(&mut out).expect("a sound ring").is_some());
    assert_eq!(out, b"still here");
}

/// A reader in the survivor's own session.
fn attach(session: &Arc<SessionSegment>, writer: &Writer, qos: Qos) -> Reader {
    let lane = session.allocate_lane().expect("a lane");
    let (reader, peer) = (Gid::new(session.id(), 2), Peer::Local(session.clone()));
    let info = ReaderInfo {
        gid: reader,
        lane: lane.location(),
        qos,
        peer: peer.clone(),
        stands_for: Vec::new(),
    };
    let grant = writer.attach(info).expect("an attachment");
    let (writer_gid, max_message) = (writer.gid(), LARGEST);
    let (writer, ring) = (writer_gid, writer.location());
    let options = ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message };
    Reader::map(options).expect("a ring")
}

/// Descriptors that this process holds, and memfds that it maps.
pub(crate) fn holdings() -> (usize, usize) {
    let descriptors = fs::read_dir("/proc/self/fd").expect("procfs").count();
    let maps = fs::read_to_string("/proc/self/maps").expect("procfs");
    (descriptors, maps.lines().filter(|line| line.contains("/memfd:")).count())
}
