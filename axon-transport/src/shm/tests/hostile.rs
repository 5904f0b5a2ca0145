//! Descriptors and memory that no honest process hands over: refused or reported, never a panic,
//! a hang or a read outside the segment.

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

use super::{
    super::{memory::Segment, ring::SLOT_WORDS},
    *,
};

const BYTES: u64 = layout::ALIGN * 4;

/// A ring whose every word a test may scribble on.
struct Scribble {
    segment: Segment,
    gid: Gid,
    session: Arc<SessionSegment>,
}

impl Scribble {
    fn new() -> Self {
        let session = session();
        let gid = Gid::new(session.id(), 1);
        let segment = Segment::create("test", BYTES).unwrap();
        layout::RingLayout::new(16, 0, 6000).write(segment.words(), gid);
        Self { segment, gid, session }
    }

    fn words(&self) -> &[AtomicU64] {
        self.segment.words()
    }

    fn set(&self, byte: usize, value: u64) {
        self.words()[byte / 8].store(value, Relaxed);
    }

    fn map(&self, first: u64) -> Result<Reader, ShmError> {
        self.map_as(first, Qos::keep_all())
    }

    fn map_as(&self, first: u64, qos: Qos) -> Result<Reader, ShmError> {
        let options = ReaderOptions {
            reader: Gid::new(self.session.id(), 2),
            writer: self.gid,
            peer: Peer::Local(self.session.clone()),
            lane: self.session.allocate_lane().unwrap(),
            grant: Grant { generation: 1, first },
            qos,
            max_message: MAX,
        };
        Reader::map(self.segment.fd().try_clone_to_owned().unwrap(), options)
    }

    /// A slot as a publisher leaves it, but for what the test changes.
    fn slot(&self, position: u64, len: u32, flags: u32, data: u64) {
        let start = 4096 / 8 + (position % 16) as usize * SLOT_WORDS;
        let fields = [2 * position + 2, 5, 6, u64::from(len) | u64::from(flags) << 32, data];
        for (word, value) in self.words()[start..].iter().zip(fields) {
            word.store(value, Relaxed);
        }
        self.set(128, position + 1);
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
        (memfd(BYTES, good), "it is not a ring"),
    ];
    for missing in [SealFlags::SHRINK, SealFlags::GROW, SealFlags::FUTURE_WRITE, SealFlags::SEAL] {
        bad.push((memfd(BYTES, good - missing), "its seals are missing"));
    }
    for (fd, reason) in bad {
        let scribble = Scribble::new();
        let options = ReaderOptions {
            reader: scribble.gid,
            writer: scribble.gid,
            peer: Peer::Local(scribble.session.clone()),
            lane: scribble.session.allocate_lane().unwrap(),
            grant: Grant { generation: 1, first: 0 },
            qos: Qos::default(),
            max_message: MAX,
        };
        assert_eq!(refusal(Reader::map(fd.try_clone().unwrap(), options)), reason);
        let mut descriptors = scribble.session.descriptors().unwrap();
        descriptors.segment = fd.into();
        assert!(PeerSession::map(scribble.session.id(), descriptors).is_err());
    }
}

#[test]
fn what_is_handed_over_cannot_be_changed_by_whoever_gets_it() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    for fd in [writer.descriptor().unwrap().into(), a.descriptors().unwrap().segment] {
        assert!(ftruncate(&fd, 0).is_err());
        assert!(rustix::io::write(&fd, b"x").is_err());
        assert!(fcntl_add_seals(&fd, SealFlags::WRITE).is_err());
        // The map that the kernel allows at all is one that cannot write.
        assert!(rustix::io::fcntl_getfd(&fd).unwrap().contains(rustix::io::FdFlags::CLOEXEC));
    }
}

#[test]
fn headers_that_make_no_sense_are_refused() {
    let cases: [(usize, u64); 12] = [
        (0, 0),
        (0, u64::from_ne_bytes(*b"AXONSES1")),
        (8, 16 << 32),
        (8, 1 | 16 << 32),
        (8, 2),
        (8, 2 | 1 << 32),
        (8, 2 | 17 << 32),
        (8, 2 | 0x8000_0000 << 32),
        (16, u64::MAX),
        (16, 4096),
        (24, u64::MAX - 63),
        (32, 0x0123_4567),
    ];
    for (byte, value) in cases {
        let scribble = Scribble::new();
        scribble.set(byte, value);
        refusal(scribble.map(0));
    }
    assert!(Scribble::new().map(0).is_ok());
}

#[test]
fn sessions_that_make_no_sense_are_refused() {
    let a = session();
    assert!(PeerSession::map(SessionId::random(), a.descriptors().unwrap()).is_err());
    for (word, value) in [(0, 0), (1, 1), (1, 2 | 1 << 48), (1, 2 | u64::from(u32::MAX) << 32)] {
        let segment = Segment::create("test", layout::session_bytes()).unwrap();
        layout::write_session(segment.words(), a.id());
        segment.words()[word].store(value, Relaxed);
        let mut descriptors = a.descriptors().unwrap();
        descriptors.segment = segment.fd().try_clone_to_owned().unwrap().into();
        assert!(PeerSession::map(a.id(), descriptors).is_err());
    }
    // Whoever rings a pipe or an eventfd could be made to wait, and a stream be told something.
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
    assert_eq!(descriptors.process(), Some(std::process::id()));
    let peer = PeerDescriptors { pidfd: pipe().unwrap().0.into(), ..descriptors };
    assert_eq!(peer.process(), None);
    assert!(peer.doorbell.as_fd().try_clone_to_owned().is_ok());
}

#[test]
fn control_words_that_make_no_sense_are_reported_and_stay_so() {
    let huge = u64::MAX;
    for (tail, head) in [(0, huge), (5, 4), (huge, 0), (huge, huge), (0, 1 << 63)] {
        let scribble = Scribble::new();
        let mut reader = scribble.map(0).unwrap();
        scribble.set(256, tail);
        scribble.set(128, head);
        let mut out = Vec::new();
        assert!(matches!(reader.take(&mut out), Err(TakeError::Corrupt { .. })));
        scribble.set(256, 0);
        scribble.set(128, 0);
        assert!(matches!(reader.peek(), Err(TakeError::Corrupt { .. })));
        assert!(!reader.has_data());
    }
}

#[test]
fn a_head_that_goes_back_is_reported() {
    let scribble = Scribble::new();
    let mut reader = scribble.map(7).unwrap();
    scribble.set(128, 3);
    assert!(matches!(reader.take(&mut Vec::new()), Err(TakeError::Corrupt { .. })));
}

#[test]
fn slots_that_make_no_sense_are_reported() {
    let area = BYTES - layout::ALIGN;
    let cases = [
        (97, 1, 0),
        (u32::MAX, 1, 0),
        (200, 0, area - 192),
        (5000, 0, area - 4992),
        (1, 0, area),
        (1, 0, 3),
        (1, 0, u64::MAX),
        (u32::MAX, 0, 0),
        (u32::MAX, 0, u64::MAX - 7),
    ];
    for (len, flags, data) in cases {
        let scribble = Scribble::new();
        let mut reader = scribble.map(0).unwrap();
        scribble.slot(0, len, flags, data);
        let taken = reader.take(&mut Vec::new());
        assert!(matches!(taken, Err(TakeError::Corrupt { .. })), "{len} {flags} {data}");
        assert!(matches!(reader.take_sample(), Err(TakeError::Corrupt { .. })));
    }
    // The same slot with what a publisher writes.
    let scribble = Scribble::new();
    let mut reader = scribble.map(0).unwrap();
    scribble.slot(0, 200, 0, area - 256);
    let mut out = Vec::new();
    assert_eq!(reader.take(&mut out).unwrap().unwrap().meta.sequence, 5);
    assert_eq!(out, [0; 200]);
}

#[test]
fn a_sample_longer_than_the_reader_allows_is_lost_and_the_next_is_not() {
    let session = session();
    let gid = Gid::new(session.id(), 1);
    let options = RingOptions { gid, qos: keep_last(2), budget: 8 * MAX, max_message: 4 * MAX };
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
fn lanes_that_make_no_sense_hold_nobody_for_ever() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 8 * 1024);
    let reader = attach(&writer, &a, &b, Qos::keep_all());
    let lane = b.lane_words(reader.lane());
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
    fn any_scribbling_ends_in_an_answer(
        writes in proptest::collection::vec((0usize..1024, any::<u64>(), any::<u8>()), 1..40),
        first in 0u64..20,
        depth in 1u32..40,
    ) {
        let scribble = Scribble::new();
        let Ok(mut reader) = scribble.map_as(first, keep_last(depth)) else {
            return Err(TestCaseError::fail("an honest header was refused"));
        };
        let mut out = Vec::new();
        for (word, value, shift) in writes {
            // Small values make plausible heads, tails and lengths.
            let value = value >> (shift % 64);
            match word % 4 {
                0 => scribble.set(128, value),
                1 => scribble.set(256, value),
                2 => scribble.slot(value % 64, value as u32 % 9000, (value >> 8) as u32 & 1, value),
                _ => scribble.words()[4096 / 8 + word].store(value, Relaxed),
            }
            let _ = reader.peek();
            if let Ok(Some(taken)) = reader.take(&mut out) {
                prop_assert!(out.len() as u64 <= BYTES);
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
