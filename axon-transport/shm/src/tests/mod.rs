//! Two ends of a ring: in one process, in two, with a hostile one, and under the model checker.

mod api;
mod batches;
mod bounds;
mod hostile;
mod images;
mod inspect;
mod local;
mod memory;
mod model;
mod mutation;
mod pins;
mod processes;
mod samples;
mod segment_channels;
mod wire;

use std::{
    sync::{Arc, Mutex, Weak, atomic::Ordering::Relaxed},
    time::{Duration, Instant},
};

use crate::{
    Context, Meta, Publisher, PublisherOptions, Sample, Subscriber, SubscriberOptions,
    alloc::segments::{SegmentEvent, SegmentInfo},
    direct::connect::{self, ConnectError},
    error::{PublishError, ShmError, TakeError},
    ids::{Gid, SessionId},
    memory::available,
    qos::{Durability, History, Qos},
    reader::{Reader, ReaderOptions},
    ring::{
        layout::{self, Location, SegmentKind},
        types::{Grant, RingOptions},
    },
    session::{
        lane::Lane,
        peer::{PeerDescriptors, PeerSession, RingPeer},
        reader_info::ReaderInfo,
        segment::SessionSegment,
    },
    writer::Writer,
};

const MAX: u64 = 1 << 20;
/// Only a lost wake-up makes a wait take this long. Such a wait checks once more when it ends, so
/// its result does not show that it was not woken.
const EVER: Duration = Duration::from_secs(60);

/// Runs a wait of up to [`EVER`], which must end because it is woken.
fn woken(wait: impl FnOnce() -> bool) {
    let start = Instant::now();
    assert!(wait() && start.elapsed() < EVER, "a wake-up was lost");
}

/// Takes the next sample, and returns its number and payload.
fn take(reader: &mut Reader) -> Option<(u64, Vec<u8>)> {
    let mut out = Vec::new();
    reader.take(&mut out).unwrap().map(|taken| {
        assert_eq!(taken.meta, meta(taken.meta.sequence));
        (taken.meta.sequence, out)
    })
}

fn await_data(session: &SessionSegment, reader: &Reader) {
    woken(|| session.wait(|| reader.has_data(), Some(EVER)));
}

fn session() -> Arc<SessionSegment> {
    let session = silent_session();
    let id = session.id();
    session.on_segment(move |event| tell_views(id, event));
    session
}

/// A session that announces no segments.
fn silent_session() -> Arc<SessionSegment> {
    SessionSegment::create(SessionId::random()).unwrap()
}

fn keep_last(depth: u32) -> Qos {
    Qos { history: History::KeepLast, depth, ..Qos::default() }
}

fn transient(qos: Qos) -> Qos {
    Qos { durability: Durability::TransientLocal, ..qos }
}

fn writer(session: &Arc<SessionSegment>, qos: Qos, budget: u64) -> Writer {
    let gid = Gid::new(session.id(), 1);
    let options = RingOptions { gid, qos, budget, max_message: MAX, expected: 0 };
    Writer::create(session.clone(), options).unwrap()
}

/// The views of sessions, which receive the announcements of segments.
static VIEWS: Mutex<Vec<Weak<PeerSession>>> = Mutex::new(Vec::new());

/// Returns the session `of` as `from` sees it.
fn peer(from: &SessionSegment, of: &Arc<SessionSegment>) -> RingPeer {
    if from.id() == of.id() { RingPeer::Local(of.clone()) } else { RingPeer::Remote(view(of)) }
}

/// Maps a session, and announces its segments to the view as a daemon would.
fn view(of: &SessionSegment) -> Arc<PeerSession> {
    let view = PeerSession::map(of.id(), of.descriptors().unwrap()).unwrap();
    VIEWS.lock().unwrap().push(Arc::downgrade(&view));
    for info in of.segments() {
        let (info, fd) = of.segment(info.number).unwrap().unwrap();
        view.add_segment(info, fd).unwrap();
    }
    view
}

fn tell_views(of: SessionId, event: SegmentEvent<'_>) {
    let mut views = VIEWS.lock().unwrap();
    views.retain(|view| view.strong_count() > 0);
    for view in views.iter().filter_map(Weak::upgrade).filter(|view| view.id() == of) {
        match event {
            SegmentEvent::Opened(info, fd) => {
                view.add_segment(info, fd).unwrap();
            }
            SegmentEvent::Gone(info) => view.remove_segment(info.number),
            SegmentEvent::Low(_) => {}
        }
    }
}

/// Attaches a subscription of session `reader` to a publisher of session `publisher`.
fn attach(
    writer: &Writer,
    publisher: &Arc<SessionSegment>,
    reader: &Arc<SessionSegment>,
    qos: Qos,
) -> Reader {
    attach_to(writer, publisher, reader, peer(reader, publisher), qos)
}

/// Like [`attach`]; `from` is the publisher's session as the reader's session sees it.
fn attach_to(
    writer: &Writer,
    publisher: &Arc<SessionSegment>,
    reader: &Arc<SessionSegment>,
    from: RingPeer,
    qos: Qos,
) -> Reader {
    let lane = reader.allocate_lane().unwrap();
    let gid = Gid::new(reader.id(), 100 + (lane.location().offset / layout::LANE) as u32);
    let grant = writer
        .attach(ReaderInfo {
            gid,
            lane: lane.location(),
            qos,
            peer: peer(publisher, reader),
            stands_for: None,
        })
        .unwrap();
    let options = ReaderOptions {
        reader: gid,
        writer: writer.gid(),
        peer: from,
        ring: writer.location(),
        lane,
        grant,
        qos,
        max_message: MAX,
    };
    Reader::map(options).unwrap()
}

fn meta(sequence: u64) -> Meta {
    Meta::at_nanos(sequence, sequence.cast_signed() * 7 - 3)
}

/// Returns bytes that differ by sequence number and offset.
fn pattern(sequence: u64, len: usize) -> Vec<u8> {
    let mut state = sequence.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut bytes = Vec::with_capacity(len + 8);
    while bytes.len() < len {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        bytes.extend_from_slice(&state.to_le_bytes());
    }
    bytes.truncate(len);
    bytes
}

/// Returns the lengths at which the handling changes: none, inline, words, granules, pages, powers
/// of two.
fn lengths() -> Vec<usize> {
    let around = (3..=18).flat_map(|power| [(1 << power) - 1, 1 << power, (1 << power) + 1]);
    (0..=200).chain(around).collect()
}
