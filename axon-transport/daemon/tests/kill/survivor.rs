//! The process at the other end: its actions before the kill, and the checks after it.

use std::{
    fs,
    os::fd::{AsFd as _, BorrowedFd, OwnedFd},
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::{
    ExternalLeader, Sample,
    internal::{
        PeerSession, Reader, ReaderInfo, ReaderOptions, RingPeer, SegmentInfo, SegmentKind,
        SessionSegment, Writer,
    },
};
use axon_transport::{ids::Gid, qos::Qos};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::fstat,
};

use crate::{
    operation::{Case, LARGEST, MORE, Operation, meta, payload, session, writer},
    trace::Tracee,
    wire::{Wire, options},
};

/// A survivor that sleeps for this long was not woken.
const SLEEP: Timespec = Timespec { tv_sec: 30, tv_nsec: 0 };

/// The result of a scene once the doomed process is dead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Outcome {
    /// True if the operation's sample was visible.
    pub(crate) shown: bool,
    /// True if the operation had ended.
    pub(crate) done: bool,
}

/// The survivor and the doomed process, which is at the operation's beginning.
pub(crate) struct Scene<'a> {
    case: &'a Case,
    wire: Wire,
    session: Arc<SessionSegment>,
    tracee: Tracee,
    end: End,
    /// The segments that the doomed process writes.
    pub(crate) written: Vec<OwnedFd>,
    /// Samples that the survivor keeps pinned.
    pinned: Vec<Sample>,
    /// The sleep of the survivor.
    leader: Option<ExternalLeader>,
    /// Bytes of memory that the survivor's segments had before the operation.
    memory: u64,
    done: bool,
}

/// The survivor's end of the ring.
enum End {
    Nothing,
    Waiting(Box<LateReader>),
    Reader(Box<Reader>, Arc<PeerSession>),
    Writer(Box<Writer>),
}

/// Maps a reader once the publisher has granted it. Returns `None` if it has not.
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
        let (pinned, leader, memory) = (Vec::new(), None, memory(&session));
        let mut scene =
            Self { case, wire, session, tracee, end, written, pinned, leader, memory, done: false };
        scene.look_for_segments();
        if let End::Reader(reader, _) = &mut scene.end {
            for _ in 0..case.taken {
                check_next(case, reader).expect("a sample");
            }
            let mut pin = || reader.take_sample().expect("a ring").expect("a sample");
            scene.pinned.extend((0..case.pinned).map(|_| pin()));
        }
        if case.operation == Operation::Wake {
            let leader = scene.session.external_leader().expect("the only one");
            leader.arm(false);
            scene.leader = Some(leader);
        }
        scene
    }

    /// Lets the doomed process execute up to `steps` instructions. Returns whether the operation
    /// ended.
    pub(crate) fn advance(&mut self, steps: u64) -> bool {
        self.done = self.tracee.advance(steps);
        self.done
    }

    /// Maps the segments that the doomed process has opened.
    pub(crate) fn look_for_segments(&mut self) {
        if let End::Reader(_, peer) = &self.end {
            self.written.extend(self.wire.take_segments(peer));
        }
    }

    /// Kills the doomed process, and checks everything that must hold.
    pub(crate) fn kill(mut self) -> Outcome {
        self.tracee.end();
        self.look_for_segments();
        // The forked child lives until the very end.
        let Self { case, wire, session, end, tracee: _tracee, pinned, leader, done, .. } = self;
        let shown = match end {
            End::Nothing => false,
            End::Waiting(map) => match map(&wire) {
                Some(reader) => drain(case, done, reader),
                None => false,
            },
            End::Reader(reader, _) => drain(case, done, *reader),
            End::Writer(writer) => {
                assert!(memory(&session) <= self.memory, "a reader takes no memory");
                go_on(case, &session, &writer, case.before);
                false
            }
        };
        pinned.iter().for_each(|sample| check(case, sample));
        if shown && let Some(leader) = &leader {
            // The process may have died before it rang.
            let mut fds = [PollFd::new(leader, PollFlags::IN)];
            assert_eq!(poll(&mut fds, Some(&SLEEP)), Ok(1), "the survivor sleeps for ever");
        }
        another_pair(&session);
        Outcome { shown, done }
    }

    /// Leaves the doomed process stopped for a while, in which others must continue without it.
    /// Then lets it finish; in the end it must have everything that it would have had otherwise.
    pub(crate) fn stop(mut self) -> Outcome {
        let case = self.case;
        let mut published = case.before + case.operation.publishes();
        if !self.done {
            if let End::Writer(writer) = &self.end {
                for _ in 0..3 * 16 {
                    let bytes = payload(published, case.len);
                    writer.publish(meta(published), &bytes).expect("nobody waits for it");
                    published += 1;
                }
            }
            another_pair(&self.session);
            self.tracee.advance_to_end();
        }
        self.look_for_segments();
        let Self { case, wire, session, end, mut tracee, .. } = self;
        tracee.release();
        match end {
            End::Nothing => {}
            End::Waiting(map) => {
                let reader = map(&wire).expect("a grant");
                wire.go();
                tracee.finish();
                drain_all(case, reader, published + MORE);
            }
            End::Reader(reader, peer) => {
                wire.go();
                tracee.finish();
                wire.take_segments(&peer);
                drain_all(case, *reader, published + MORE);
            }
            End::Writer(writer) => {
                wire.go();
                let counted: u64 = wire.take_count().iter().sum();
                assert_eq!(counted, published, "every sample is counted once");
                tracee.finish();
                go_on(case, &session, &writer, published);
            }
        }
        another_pair(&session);
        Outcome { shown: case.operation.publishes() > 0, done: true }
    }
}

/// Prepares a survivor that reads.
fn join(case: &Case, wire: &Wire, session: &Arc<SessionSegment>) -> (End, Vec<OwnedFd>) {
    match case.operation {
        Operation::Create => (End::Nothing, Vec::new()),
        Operation::Attach => {
            let offer = wire.take_offer();
            let lane = session.allocate_lane().expect("a lane");
            wire.ask(session, &lane);
            let (session, qos) = (session.clone(), case.reader);
            let map = move |wire: &Wire| {
                // A fork of the process may keep the socket open, so the socket does not show its
                // end.
                let grant = if wire.is_empty() { None } else { wire.take_grant() }?;
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

/// Prepares a survivor that publishes.
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

/// Takes the next sample, which must be whole, and returns its sequence number.
fn check_next(case: &Case, reader: &mut Reader) -> Option<u64> {
    let mut out = Vec::new();
    let taken = reader.take(&mut out).expect("a sound ring")?;
    let sequence = taken.meta.sequence;
    assert_eq!(taken.meta, meta(sequence));
    assert!(out == payload(sequence, case.len), "sample {sequence} is torn");
    Some(sequence)
}

/// Checks that a pinned sample has not changed.
fn check(case: &Case, sample: &Sample) {
    let mut bytes = Vec::new();
    sample.copy_to(&mut bytes).expect("memory");
    assert!(sample.is_borrowed(), "it is not where it was");
    let sequence = sample.meta().sequence;
    assert!(bytes == payload(sequence, case.len), "sample {sequence} is torn while it is pinned");
}

/// Takes and counts all remaining samples. Returns the publisher's total number of samples, and the
/// last one.
fn take_rest(case: &Case, reader: &mut Reader) -> (u64, Option<u64>) {
    assert!(reader.writer_dead(), "its pidfd says so");
    let first = reader.grant().first;
    let mut last = None;
    while let Some(sequence) = check_next(case, reader) {
        assert!(last < Some(sequence), "{sequence} after {last:?}");
        last = Some(sequence);
    }
    assert!(reader.is_drained());
    (first + reader.received() + reader.lost() + reader.skipped(), last)
}

/// Takes all samples that the dead publisher left. Returns whether the operation's sample was among
/// them.
fn drain(case: &Case, done: bool, mut reader: Reader) -> bool {
    let (counted, last) = take_rest(case, &mut reader);
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

/// Takes all samples of a publisher that finished.
fn drain_all(case: &Case, mut reader: Reader, published: u64) {
    let (counted, last) = take_rest(case, &mut reader);
    assert_eq!(counted, published, "every sample is counted once");
    assert_eq!(last, Some(published - 1));
}

/// Lets the publisher continue from `sequence` without its dead reader.
fn go_on(case: &Case, session: &Arc<SessionSegment>, writer: &Writer, sequence: u64) {
    let mut sequence = sequence;
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
    drop(reader);
    assert_eq!(writer.drop_gone().len(), 1);
    // The memory that the dead reader pinned is free again.
    let start = Instant::now();
    writer.reclaim_idle(start);
    assert!(
        !writer.reclaim_idle(start + Duration::from_secs(60)),
        "memory of large samples is kept"
    );
    let samples = |info: &SegmentInfo| matches!(info.kind, SegmentKind::Samples(_));
    assert!(!session.segments().iter().any(samples));
}

/// Checks that the survivor's session still works.
fn another_pair(session: &Arc<SessionSegment>) {
    let writer = writer(session, Qos::default());
    let mut reader = attach(session, &writer, Qos::default());
    writer.publish(meta(0), b"still here").expect("room");
    let mut out = Vec::new();
    assert!(reader.take(&mut out).expect("a sound ring").is_some());
    assert_eq!(out, b"still here");
}

/// Attaches a reader in the survivor's own session.
fn attach(session: &Arc<SessionSegment>, writer: &Writer, qos: Qos) -> Reader {
    let lane = session.allocate_lane().expect("a lane");
    let (reader, peer) = (Gid::new(session.id(), 2), RingPeer::Local(session.clone()));
    let info = ReaderInfo {
        gid: reader,
        lane: lane.location(),
        qos,
        peer: peer.clone(),
        stands_for: None,
    };
    let grant = writer.attach(info).expect("an attachment");
    let (writer_gid, max_message) = (writer.gid(), LARGEST);
    let (writer, ring) = (writer_gid, writer.location());
    let options = ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message };
    Reader::map(options).expect("a ring")
}

/// Returns the bytes of memory of a session's segments.
fn memory(session: &SessionSegment) -> u64 {
    let first = session.descriptors().expect("descriptors").segment;
    let bytes = |fd: BorrowedFd<'_>| fstat(fd).expect("a segment").st_blocks.cast_unsigned() * 512;
    let further = session.segments().into_iter().map(|info| {
        let (_, fd) = session.segment(info.number).expect("a descriptor").expect("it");
        bytes(fd.as_fd())
    });
    bytes(first.as_fd()) + further.sum::<u64>()
}

/// The system resources that this process holds.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Holdings {
    descriptors: usize,
    /// Number of maps of memfds.
    maps: usize,
    /// The process's share of shared memory in KiB, if the system tells.
    shared: Option<u64>,
    children: usize,
}

impl Holdings {
    pub(crate) fn now() -> Self {
        let maps = fs::read_to_string("/proc/self/maps").expect("procfs");
        let maps = maps.lines().filter(|line| line.contains("/memfd:")).count();
        let memory = fs::read_to_string("/proc/self/smaps_rollup").unwrap_or_default();
        let shared = memory.lines().find_map(|line| line.strip_prefix("Pss_Shmem:"));
        let shared = shared.and_then(|text| text.trim().strip_suffix(" kB")?.parse().ok());
        let children = fs::read_to_string("/proc/thread-self/children").unwrap_or_default();
        let children = children.split_ascii_whitespace().count();
        let descriptors = fs::read_dir("/proc/self/fd").expect("procfs").count();
        Self { descriptors, maps, shared, children }
    }
}
