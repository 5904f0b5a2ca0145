//! Descriptors and memory that no honest process sends: they are refused or reported, and never cause a panic, a
//! hang or a read outside the segment.

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::atomic::{AtomicU64, Ordering::Relaxed},
};

use proptest::prelude::*;
use rustix::{
    fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create},
    net::{AddressFamily, SocketType},
    pipe::pipe,
};

use super::*;
use crate::memory::segment::OwnMapping;

const RING: u64 = layout::HEAP_AT;
const ARRAY: u64 = RING + 512;
const SLOTS: u64 = 16;
const BLOCK: u64 = 32 << 10;
/// The bits of a generation that permit pins of any length.
const ALL: u64 = 63 << 24;

/// A session with a ring, of which a test may corrupt every word.
struct HostileSession {
    segment: OwnMapping,
    id: SessionId,
    gid: Gid,
    reader: Arc<SessionSegment>,
    /// The generation that it grants.
    generation: u64,
}

impl HostileSession {
    fn new() -> Self {
        let id = SessionId::random();
        let gid = Gid::new(id, 1);
        let segment = OwnMapping::create("test", layout::SESSION_BYTES).unwrap();
        layout::write_segment(segment.words(), id, 0, SegmentKind::Session);
        let at = Location { segment: 0, offset: ARRAY };
        let array = layout::Array { at, descriptors: SLOTS };
        let ring = &segment.words()[RING as usize / 8..][..layout::RING_WORDS];
        layout::write_ring(ring, gid, 0, &array);
        Self { segment, id, gid, reader: session(), generation: ALL | 1 }
    }

    fn words(&self) -> &[AtomicU64] {
        self.segment.words()
    }

    fn set(&self, byte: u64, value: u64) {
        self.words()[byte as usize / 8].store(value, Relaxed);
    }

    fn set_tail(&self, tail: u64) {
        self.set(RING + 256, tail);
    }

    fn set_head(&self, head: u64) {
        self.set(RING + 128, head);
    }

    fn set_array(&self, word: u64) {
        self.set(RING + 264, word);
    }

    fn peer(&self) -> Result<Arc<PeerSession>, ShmError> {
        let segment = self.segment.fd().try_clone_to_owned().unwrap();
        let segment = segment.into();
        PeerSession::map(self.id, PeerDescriptors { segment, ..self.reader.descriptors().unwrap() })
    }

    fn map(&self, first: u64) -> Result<Reader, ShmError> {
        self.map_as(first, Qos::keep_all())
    }

    fn map_as(&self, first: u64, qos: Qos) -> Result<Reader, ShmError> {
        self.map_at(Location { segment: 0, offset: RING }, first, qos)
    }

    fn map_at(&self, ring: Location, first: u64, qos: Qos) -> Result<Reader, ShmError> {
        let options = ReaderOptions {
            reader: Gid::new(self.reader.id(), 2),
            writer: self.gid,
            peer: RingPeer::Remote(self.peer()?),
            ring,
            lane: self.reader.allocate_lane().unwrap(),
            grant: Grant { generation: self.generation, first },
            qos,
            max_message: MAX,
        };
        Reader::map(options)
    }

    /// Writes a descriptor as a publisher does, except for the given fields.
    fn descriptor(&self, position: u64, len: u32, place: u32, data: u64) {
        let start = ARRAY as usize / 8 + (position % SLOTS) as usize * layout::DESCRIPTOR_WORDS;
        let stamp = position.wrapping_mul(2).wrapping_add(2);
        let fields = [stamp, 5, 6, u64::from(len) | u64::from(place) << 32, data];
        for (word, value) in self.words()[start..].iter().zip(fields) {
            word.store(value, Relaxed);
        }
        self.set_head(position + 1);
    }
}

fn refusal(result: Result<Reader, ShmError>) -> &'static str {
    match result {
        Err(ShmError::Refused { what }) => what,
        Err(other) => panic!("another error: {other}"),
        Ok(_) => panic!("was mapped"),
    }
}

fn memfd(bytes: u64, seals: SealFlags) -> OwnedFd {
    let fd = memfd_create("test", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING).unwrap();
    ftruncate(&fd, bytes).unwrap();
    fcntl_add_seals(&fd, seals).unwrap();
    fd
}

#[test]
fn a_segment_must_be_a_sealed_memfd_of_a_sane_size() {
    let good = SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL;
    let kind = "it is not a memfd";
    let size = "its size is not a segment's";
    let mut bad = vec![
        (pipe().unwrap().0, kind),
        (std::fs::File::open("/dev/null").unwrap().into(), kind),
        (memfd(0, good), size),
        (memfd(4096, good), size),
        (memfd(layout::ALIGN + 8, good), size),
        (memfd(1 << 60, good), size),
        (memfd(layout::SESSION_BYTES, good), "it is not a segment of AXON"),
    ];
    for missing in [SealFlags::SHRINK, SealFlags::GROW, SealFlags::FUTURE_WRITE, SealFlags::SEAL] {
        bad.push((memfd(layout::SESSION_BYTES, good - missing), "its seals are missing"));
    }
    for (fd, reason) in bad {
        let mut descriptors = session().descriptors().unwrap();
        descriptors.segment = fd.try_clone().unwrap().into();
        match PeerSession::map(SessionId::random(), descriptors) {
            Err(ShmError::Refused { what }) => assert_eq!(what, reason),
            other => panic!("{:?}", other.map(|peer| peer.id())),
        }
        // As a further segment of a valid session it is refused, permanently.
        let a = session();
        let peer = PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap();
        let info = SegmentInfo { number: 1, kind: SegmentKind::Heap };
        assert!(peer.add_segment(info, &fd).is_err());
        assert!(peer.has_segment(1));
        assert!(RingPeer::Remote(peer).lane(Location { segment: 1, offset: 4096 }).is_err());
    }
}

#[test]
fn memory_that_is_handed_over_cannot_be_changed_by_its_receiver() {
    let a = session();
    let writer = writer(&a, transient(keep_last(1)), 0);
    writer.publish(meta(0), &[0; 5000]).unwrap();
    let (_, samples) = a.segment(1).unwrap().unwrap();
    for fd in [samples.into(), a.descriptors().unwrap().segment] {
        assert!(ftruncate(&fd, 0).is_err());
        assert!(rustix::io::write(&fd, b"x").is_err());
        assert!(fcntl_add_seals(&fd, SealFlags::WRITE).is_err());
        // The kernel permits a map of it, but not for writing.
        assert!(rustix::io::fcntl_getfd(&fd).unwrap().contains(rustix::io::FdFlags::CLOEXEC));
    }
}

#[test]
fn rings_that_make_no_sense_are_refused() {
    for (byte, value) in [(0, 0), (0, u64::from_ne_bytes(*b"AXONRNG1")), (16, 7)] {
        let hostile = HostileSession::new();
        hostile.set(RING + byte, value);
        refusal(hostile.map(0));
    }
    for (segment, offset) in [
        (0, 0),
        (0, 128),
        (0, RING + 8),
        (0, layout::SESSION_BYTES - 256),
        (0, u64::MAX),
        (1, RING),
    ] {
        refusal(HostileSession::new().map_at(Location { segment, offset }, 0, Qos::default()));
    }
    refusal(HostileSession::new().map(u64::MAX));
    assert!(HostileSession::new().map(0).is_ok());
}

#[test]
fn grants_that_make_no_sense_are_refused() {
    // 0 would leave the lane without a reader. The values with the highest bit would leave it to a reader that still
    // asks. The others are for an earlier or a later reader with the same lane.
    for generation in [0, 1 << 63, 1 << 63 | 1, u64::MAX, 2, 7 << 24, 7 << 24 | 2] {
        let mut hostile = HostileSession::new();
        hostile.generation = generation;
        refusal(hostile.map(0));
    }
    let mut hostile = HostileSession::new();
    hostile.generation = 1 << 62 | 1;
    assert!(hostile.map(0).is_ok());
}

#[test]
fn segments_of_others_versions_and_machines_are_refused_by_name() {
    let cases: [(u64, u64, &str); 9] = [
        (0, u64::from_ne_bytes(*b"AXONSES1"), "not a segment"),
        (8, 3 | 0x0a0b_0c0d << 32, "another version"),
        (8, 5 | 0x0a0b_0c0d << 32, "another version"),
        (8, 4 | 0x0d0c_0b0a << 32, "another byte order"),
        (8, u64::from(4u32.swap_bytes()) | 0x0d0c_0b0a << 32, "another byte order"),
        (16, 7, "another session"),
        (32, 1, "another one"),
        (32, 1 << 32, "another one"),
        (40, layout::SESSION_BYTES - layout::ALIGN, "not as large"),
    ];
    for (byte, value, reason) in cases {
        let hostile = HostileSession::new();
        hostile.set(byte, value);
        match hostile.peer() {
            Err(ShmError::Refused { what }) => assert!(what.contains(reason), "{what}"),
            other => panic!("{reason}: {:?}", other.map(|peer| peer.id())),
        }
    }
}

#[test]
fn sessions_that_make_no_sense_are_refused() {
    let a = session();
    assert!(PeerSession::map(SessionId::random(), a.descriptors().unwrap()).is_err());
    // A publisher's segment cannot be announced as another publisher's or as one for objects.
    let writer = writer(&a, transient(keep_last(1)), 0);
    writer.publish(meta(0), &[0; 5000]).unwrap();
    let (info, fd) = a.segment(1).unwrap().unwrap();
    assert_eq!(info.kind, SegmentKind::Samples(writer.gid()));
    let other = SegmentKind::Samples(Gid::new(a.id(), 9));
    for (number, kind) in [(1, SegmentKind::Heap), (1, other), (2, info.kind)] {
        let peer = PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap();
        assert!(peer.add_segment(SegmentInfo { number, kind }, &fd).is_err());
    }
    // Ringing a pipe or an eventfd could block, and ringing a stream would send data to it.
    let flags = rustix::event::EventfdFlags::NONBLOCK;
    let socket = |family, kind| {
        let flags = rustix::net::SocketFlags::CLOEXEC;
        rustix::net::socket_with(family, kind, flags, None).unwrap()
    };
    for other in [
        pipe().unwrap().1,
        rustix::event::eventfd(0, flags).unwrap(),
        socket(AddressFamily::UNIX, SocketType::STREAM),
        socket(AddressFamily::INET, SocketType::DGRAM),
    ] {
        let mut descriptors = a.descriptors().unwrap();
        descriptors.doorbell = other.into();
        assert!(PeerSession::map(a.id(), descriptors).is_err());
    }
}

#[test]
fn a_descriptor_that_is_no_pidfd_names_no_process() {
    let descriptors = session().descriptors().unwrap();
    assert_eq!(descriptors.process().unwrap(), Some(std::process::id()));
    let peer = PeerDescriptors { pidfd: pipe().unwrap().0.into(), ..descriptors };
    assert_eq!(peer.process().unwrap(), None);
    assert!(peer.doorbell.as_fd().try_clone_to_owned().is_ok());
}

#[test]
fn control_words_that_make_no_sense_are_reported_and_stay_so() {
    let huge = u64::MAX;
    for (tail, head) in [(0, huge), (5, 4), (huge, 0), (huge, huge), (0, 1 << 63)] {
        let hostile = HostileSession::new();
        let mut reader = hostile.map(0).unwrap();
        // A reader that lags reads tail and head.
        hostile.descriptor(SLOTS, 1, 0, 0);
        hostile.set_tail(tail);
        hostile.set_head(head);
        let mut out = Vec::new();
        assert!(matches!(reader.take(&mut out), Err(TakeError::Corrupt { .. })));
        hostile.set_tail(0);
        hostile.set_head(0);
        assert!(matches!(reader.peek(), Err(TakeError::Corrupt { .. })));
        assert!(!reader.has_data());
    }
}

#[test]
fn a_head_that_goes_back_is_reported() {
    let hostile = HostileSession::new();
    let mut reader = hostile.map(7).unwrap();
    hostile.descriptor(7 + SLOTS, 1, 0, 0);
    hostile.set_head(3);
    assert!(matches!(reader.take(&mut Vec::new()), Err(TakeError::Corrupt { .. })));
}

#[test]
fn descriptors_in_places_that_make_no_sense_are_reported() {
    let mut words = vec![0, 1, 18, 30, 63, u64::MAX, !63 | 4];
    // The array would reach beyond the segment by all but one line, or begin in front of the objects, or outside.
    for offset in [0, 128, layout::SESSION_BYTES - 16 * 128 + 128, 1 << 40] {
        words.push((offset / 128) << 6 | 4);
    }
    for word in words {
        let hostile = HostileSession::new();
        let mut reader = hostile.map(0).unwrap();
        hostile.set_array(word);
        assert!(reader.has_data(), "so that somebody looks");
        let taken = reader.take(&mut Vec::new());
        let missing = word >> 40 != 0 && (1..=18).contains(&(word & 63));
        if missing {
            assert_eq!(taken, Ok(None));
            assert!(reader.missing().is_some() && !reader.has_data());
        } else {
            assert!(matches!(taken, Err(TakeError::Corrupt { .. })), "{word:x}");
        }
    }
    // A publisher may move the array at any time; both of these locations are as good.
    let hostile = HostileSession::new();
    let mut reader = hostile.map(0).unwrap();
    hostile.descriptor(0, 1, 0, 0);
    for word in [ARRAY >> 7 << 6 | 3, ARRAY >> 7 << 6 | 1] {
        hostile.set_array(word);
        assert_eq!(
            reader.peek().unwrap(),
            Some(Meta { sequence: 5, source_nanos: 6, published_nanos: 0 })
        );
    }
}

#[test]
fn samples_in_places_that_make_no_sense_are_reported() {
    let end = layout::SESSION_BYTES;
    let cases = [
        (97, 0, 0),
        (u32::MAX, 0, 0),
        (200, 1, end - 128),
        (4096, 1, end - 4096 + 128),
        (5000, 2, end - 4992),
        (1, 1, end),
        (1, 1, BLOCK + 8),
        (1, 1, 0),
        (1, 1, !127),
        (5000, 2, !127),
        (5000, 2, !0),
        // A sample in place may begin within a word.
        (5000, 2, end - 4999),
        (5000, 2, 0),
        (u32::MAX, 2, BLOCK),
        // A sample that is too long for a block, one that is too short for a slot, and one at an unknown kind of place.
        (4097, 1, BLOCK),
        (512, 2, BLOCK),
        (1, 3, BLOCK),
        (1, 0xff, BLOCK),
    ];
    for (len, place, data) in cases {
        let hostile = HostileSession::new();
        let mut reader = hostile.map(0).unwrap();
        reader.expect(u64::MAX);
        hostile.descriptor(0, len, place, data);
        let taken = reader.take(&mut Vec::new());
        assert!(matches!(taken, Err(TakeError::Corrupt { .. })), "{len} {place} {data}");
        assert!(matches!(reader.take_sample(), Err(TakeError::Corrupt { .. })));
    }
    // The same descriptor with valid values.
    let hostile = HostileSession::new();
    let mut reader = hostile.map(0).unwrap();
    hostile.descriptor(0, 200, 1, end - 256);
    let mut out = Vec::new();
    assert_eq!(reader.take(&mut out).unwrap().unwrap().meta.sequence, 5);
    assert_eq!(out, [0; 200]);
    hostile.descriptor(1, 5000, 2, end - 5000);
    assert_eq!(reader.take(&mut out).unwrap().unwrap().meta.sequence, 5);
    assert_eq!(out, [0; 5000]);
}

#[test]
fn a_segment_that_never_comes_holds_no_reader_for_ever() {
    let hostile = HostileSession::new();
    let mut reader = hostile.map_as(0, keep_last(2)).unwrap();
    hostile.descriptor(0, 1, 1 | 77 << 8, BLOCK);
    assert!(reader.has_data());
    assert_eq!(reader.take(&mut Vec::new()), Ok(None));
    assert_eq!(
        (reader.missing(), reader.has_data(), reader.is_drained()),
        (Some(77), false, false)
    );
    // The newer samples, which fill the depth, can be taken.
    for position in 1..3 {
        hostile.descriptor(position, 1, 0, 0);
    }
    assert!(reader.has_data());
    assert_eq!(reader.take(&mut Vec::new()).unwrap().unwrap().position, 1);
    assert_eq!((reader.missing(), reader.skipped()), (None, 1));
}

#[test]
fn descriptors_that_never_come_are_given_up_once_the_writer_is_gone() {
    let hostile = HostileSession::new();
    let mut reader = hostile.map_as(0, keep_last(2)).unwrap();
    hostile.descriptor(0, 1, 0, 0);
    hostile.set(RING + 8 * layout::ring::HEAD as u64, 1);
    hostile.set_array(77 << 40 | ARRAY >> 7 << 6 | 4);
    assert_eq!(reader.take(&mut Vec::new()), Ok(None));
    assert_eq!((reader.missing(), reader.is_drained()), (Some(77), false));
    reader.end();
    let start = Instant::now();
    // The reader requests it again before it gives it up.
    while reader.lost() == 0 {
        assert!(start.elapsed() < EVER, "it is hoped for without end");
        if reader.has_data() {
            assert_eq!(reader.take(&mut Vec::new()), Ok(None));
        }
        std::thread::yield_now();
    }
    assert_eq!((reader.lost(), reader.unread(), reader.missing()), (1, 0, None));
    assert!(!reader.has_data() && reader.is_drained(), "a waiter would not sleep again");
    assert_eq!(reader.take(&mut Vec::new()), Ok(None));
}

#[test]
fn a_sample_longer_than_the_reader_allows_is_lost_and_the_next_is_not() {
    let session = session();
    let gid = Gid::new(session.id(), 1);
    let options =
        RingOptions { gid, qos: keep_last(2), budget: 8 * MAX, max_message: 4 * MAX, expected: 0 };
    let writer = Writer::create(session.clone(), options).unwrap();
    let mut reader = attach(&writer, &session, &session, keep_last(2));
    writer.publish(meta(1), &vec![0; 2 * MAX as usize]).unwrap();
    writer.publish(meta(2), b"small").unwrap();
    let (len, max) = (2 * MAX, MAX);
    let refused = TakeError::TooLarge { writer: gid, len, max };
    assert_eq!(reader.take_sample().unwrap_err(), refused);
    assert_eq!(reader.take(&mut Vec::new()).unwrap().unwrap().meta, meta(2));
    assert_eq!((reader.received(), reader.lost()), (1, 1));
}

#[test]
fn corrupt_lanes_never_block_the_publisher_forever() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 8 * 1024);
    let reader = attach(&writer, &a, &b, Qos::keep_all());
    let lane = peer(&b, &b).lane(reader.lane()).unwrap();
    let lane = lane.words();
    for cursor in [u64::MAX, 1 << 63, 0] {
        lane[layout::lane::CURSOR].store(cursor, Relaxed);
        for sequence in 0..20 {
            let result = writer.try_publish(meta(sequence), &pattern(sequence, 1024));
            assert!(matches!(result, Ok(_) | Err(PublishError::Blocked { .. })));
        }
    }
    lane[layout::lane::GENERATION].store(12345, Relaxed);
    writer.try_publish(meta(99), &pattern(99, 1024)).unwrap();
}

proptest! {
    #[test]
    fn any_corruption_ends_in_an_answer(
        writes in proptest::collection::vec((0usize..1024, any::<u64>(), any::<u8>()), 1..40),
        first in 0u64..20,
        depth in 1u32..40,
    ) {
        let hostile = HostileSession::new();
        let Ok(mut reader) = hostile.map_as(first, keep_last(depth)) else {
            return Err(TestCaseError::fail("an honest header was refused"));
        };
        let mut out = Vec::new();
        for (word, value, shift) in writes {
            // Small values make plausible heads, tails and lengths.
            let value = value >> (shift % 64);
            match word % 4 {
                0 => hostile.set_head(value),
                1 => hostile.set_tail(value),
                2 => {
                    let place = (value >> 8) as u32 & 0x1ff;
                    let offset = (value % layout::SESSION_BYTES) & !127;
                    hostile.descriptor(value % 64, value as u32 % 9000, place, offset);
                }
                _ => hostile.words()[RING as usize / 8 + word].store(value, Relaxed),
            }
            let _ = reader.peek();
            if let Ok(Some(taken)) = reader.take(&mut out) {
                prop_assert!(out.len() as u64 <= layout::SESSION_BYTES);
                prop_assert!(taken.position >= first);
            }
            if let Ok(Some(sample)) = reader.take_sample() {
                prop_assert_eq!(sample.read_at(0, &mut [0; 8]), sample.len().min(8));
                sample.copy_to(&mut out).unwrap();
            }
            let _ = reader.skip();
        }
    }
}
