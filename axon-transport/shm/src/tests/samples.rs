//! The memory of large samples: its size, the readers that keep it, its release, and slices of it in place.

#![allow(unsafe_code)]

use std::{fs, os::fd::OwnedFd};

use rustix::fs::fstat;

use super::*;
use crate::{TrustPublishers, alloc::retention::IDLE};

const IMAGE: usize = 200_000;

/// Returns the segments of large samples that a session has.
fn samples_of(session: &SessionSegment) -> Vec<(SegmentInfo, OwnedFd)> {
    let samples = |info: &SegmentInfo| matches!(info.kind, SegmentKind::Samples(_));
    let live = session.segments().into_iter().filter(samples);
    live.map(|info| session.segment(info.number).unwrap().unwrap()).collect()
}

/// Returns the number of bytes that are backed by memory.
fn backed(session: &SessionSegment) -> u64 {
    let blocks = |fd: &OwnedFd| fstat(fd).unwrap().st_blocks.cast_unsigned() * 512;
    samples_of(session).iter().map(|(_, fd)| blocks(fd)).sum()
}

/// Returns whether this process maps or holds any of these files, by inode.
fn exists(inodes: &[u64]) -> bool {
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let mapped = |line: &str| {
        let inode = line.split_whitespace().nth(4).and_then(|inode| inode.parse().ok());
        line.contains("axon-samples") && inode.is_some_and(|inode| inodes.contains(&inode))
    };
    let held = |entry: std::io::Result<fs::DirEntry>| {
        use std::os::unix::fs::MetadataExt;
        // Another test may close one meanwhile.
        let file = entry.ok().and_then(|entry| fs::metadata(entry.path()).ok());
        file.is_some_and(|file| inodes.contains(&file.ino()))
    };
    maps.lines().any(mapped) || fs::read_dir("/proc/self/fd").unwrap().any(held)
}

fn inodes(session: &SessionSegment) -> Vec<u64> {
    samples_of(session).iter().map(|(_, fd)| fstat(fd).unwrap().st_ino).collect()
}

fn publish(writer: &Writer, sequence: u64, len: usize) {
    writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
}

fn whole(sample: &Sample) {
    let mut out = Vec::new();
    sample.copy_to(&mut out).unwrap();
    assert!(out == pattern(sample.meta().sequence, sample.len()), "a sample changed");
}

/// Reclaims the writer's memory like a control thread, for the given number of seconds after `from`.
fn reclaim_idle(writer: &Writer, from: Instant, seconds: u64) -> bool {
    (0..=seconds)
        .map(|second| writer.reclaim_idle(from + Duration::from_secs(second)))
        .last()
        .unwrap()
}

#[test]
fn sizes_from_nothing_to_the_largest_share_a_topic() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(3), 4 << 20);
    let mut readers = [&a, &b].map(|session| attach(&writer, &a, session, keep_last(3)));
    let mut state = 7u64;
    for sequence in 0..600 {
        state = state.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(1);
        let bits = (state >> 33) % 21;
        let len = ((state >> 40) as usize) & ((1 << bits) - 1);
        let len = if sequence % 97 == 0 { MAX as usize } else { len };
        publish(&writer, sequence, len);
        if sequence % 5 > 1 {
            for reader in &mut readers {
                while let Some(sample) = reader.take_sample().unwrap() {
                    whole(&sample);
                }
            }
        }
    }
    for reader in &readers {
        assert_eq!(reader.received() + reader.skipped() + reader.lost(), 600);
        assert_eq!(reader.lost(), 0, "the budget is never short");
    }
    // The kept samples take at most the budget, and four of the largest fit beside them.
    assert!(backed(&a) <= (4 << 20) + 5 * MAX, "{} bytes", backed(&a));
}

#[test]
fn memory_that_is_not_used_any_more_comes_back() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(5), 16 << 20);
    let mut reader = attach(&writer, &a, &b, keep_last(5));
    let start = Instant::now();
    assert!(!reclaim_idle(&writer, start, 0), "there is none yet");
    for sequence in 0..20 {
        publish(&writer, sequence, IMAGE);
    }
    let inodes = inodes(&a);
    assert!(exists(&inodes) && backed(&a) > 5 * IMAGE as u64);
    assert!(reclaim_idle(&writer, start, 60), "what the reader has not taken stays");
    let mut last = None;
    while let Some(sample) = reader.take_sample().unwrap() {
        last = Some(sample);
    }
    assert!(
        reclaim_idle(&writer, start + Duration::from_secs(61), 60),
        "what a reader keeps stays"
    );
    let sample = last.expect("samples");
    whole(&sample);
    assert!(exists(&inodes));
    drop(sample);
    assert!(!reclaim_idle(&writer, start + Duration::from_secs(122), 30), "nothing is left");
    assert_eq!(backed(&a), 0);
    assert!(!exists(&inodes), "neither its publisher nor its reader keeps it");
    // Memory is allocated again when it is needed.
    publish(&writer, 20, IMAGE);
    whole(&reader.take_sample().unwrap().expect("a sample"));
    assert_eq!((reader.lost(), samples_of(&a).len()), (0, 1));
}

#[test]
fn far_too_much_memory_is_given_back_while_samples_flow() {
    let (a, b) = (session(), session());
    let writer = writer(&a, transient(keep_last(1)), 16 << 20);
    let mut reader = attach(&writer, &a, &b, transient(keep_last(1)));
    let start = Instant::now();
    for sequence in 0..20 {
        publish(&writer, sequence, MAX as usize);
    }
    let before = backed(&a);
    assert!(before >= 16 * MAX);
    for second in 0..60 {
        publish(&writer, 20 + second, 8192);
        whole(&reader.take_sample().unwrap().expect("the last"));
        writer.reclaim_idle(start + Duration::from_secs(second));
    }
    assert!(backed(&a) < before / 4, "{} bytes of {before}", backed(&a));
    assert_eq!(samples_of(&a).len(), 1);
    let late = attach(&writer, &a, &b, transient(keep_last(1))).take_sample().unwrap();
    assert_eq!(late.map(|sample| sample.meta()), Some(meta(79)), "what stands has not moved");
}

#[test]
fn a_loan_of_memory_that_is_given_up_can_still_be_published() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    let mut loan = writer.loan(IMAGE).unwrap();
    let start = Instant::now();
    assert!(reclaim_idle(&writer, start, 60));
    loan.copy_from_slice(&pattern(1, IMAGE));
    loan.publish(meta(1)).unwrap();
    whole(&reader.take_sample().unwrap().expect("a sample"));
    assert!(!reclaim_idle(&writer, start + Duration::from_secs(61), 30));
}

#[test]
fn samples_taken_by_all_readers_are_overwritten_first() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(10), 64 << 20);
    let mut readers = [&a, &b].map(|session| attach(&writer, &a, session, keep_last(10)));
    for sequence in 0..100 {
        publish(&writer, sequence, IMAGE);
        readers.iter_mut().for_each(|reader| whole(&reader.take_sample().unwrap().unwrap()));
    }
    assert!(backed(&a) < 6 * IMAGE as u64, "{} bytes", backed(&a));
    // A reader that lags still gets its history.
    for sequence in 100..110 {
        publish(&writer, sequence, IMAGE);
        readers[0].take_sample().unwrap().unwrap();
    }
    for sequence in 100..110 {
        let sample = readers[1].take_sample().unwrap().unwrap();
        assert_eq!(sample.meta(), meta(sequence));
        whole(&sample);
    }
    assert_eq!(readers.map(|reader| reader.lost()), [0, 0]);
}

#[test]
fn history_is_kept_for_late_readers_also_when_others_have_taken_it() {
    let (a, b) = (session(), session());
    let qos = transient(keep_last(10));
    let writer = writer(&a, qos, 64 << 20);
    let mut reader = attach(&writer, &a, &b, qos);
    for sequence in 0..30 {
        publish(&writer, sequence, IMAGE);
        reader.take_sample().unwrap().unwrap();
    }
    assert!(reclaim_idle(&writer, Instant::now(), 60));
    let mut late = attach(&writer, &a, &b, qos);
    for sequence in 20..30 {
        assert_eq!(late.take_sample().unwrap().unwrap().meta(), meta(sequence));
    }
}

#[test]
fn a_slot_is_ready_ahead_of_the_next_sample() {
    static LOW: Mutex<Vec<Gid>> = Mutex::new(Vec::new());
    let a = silent_session();
    a.on_segment(|event| {
        if let SegmentEvent::Low(gid) = event {
            LOW.lock().unwrap().push(gid);
        }
    });
    let writer = writer(&a, transient(keep_last(3)), 64 << 20);
    writer.prepare().unwrap();
    assert_eq!(backed(&a), 0, "nobody knows yet how large samples are");
    publish(&writer, 0, IMAGE);
    assert_eq!(*LOW.lock().unwrap(), [writer.gid()]);
    for sequence in 1..40 {
        writer.prepare().unwrap();
        let ready = backed(&a);
        publish(&writer, sequence, IMAGE);
        assert_eq!(backed(&a), ready, "sample {sequence} had to wait for memory");
    }
    let enough = backed(&a);
    for sequence in 40..80 {
        writer.prepare().unwrap();
        publish(&writer, sequence, IMAGE);
    }
    assert_eq!(backed(&a), enough, "one is enough");
}

#[test]
fn readers_that_keep_all_they_can_are_given_way_and_named_at_the_end() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut kept = Vec::new();
    let mut sequence = 0;
    // More samples than fit in the first segment. Readers of the publisher's own session may pin all of them.
    for _ in 0..8 {
        let mut reader = attach(&writer, &a, &a, keep_last(1));
        for _ in 0..5 {
            publish(&writer, sequence, MAX as usize);
            kept.push(reader.take_sample().unwrap().unwrap());
            sequence += 1;
        }
    }
    kept.iter().for_each(|sample| assert!(sample.is_borrowed()));
    kept.iter().for_each(whole);
    assert!(samples_of(&a).len() > 1);
    kept.clear();
    publish(&writer, sequence, MAX as usize);
    assert!(reclaim_idle(&writer, Instant::now(), 1));
    assert_eq!(samples_of(&a).len(), 1, "the others went with what was kept in them");
}

#[test]
fn nothing_is_given_up_for_a_sample_that_there_is_no_memory_for() {
    let (a, b) = (session(), session());
    let qos = transient(keep_last(5));
    let writer = writer(&a, qos, 1 << 20);
    for sequence in 0..5 {
        publish(&writer, sequence, IMAGE);
    }
    let standing = |expected: &[u64]| {
        let mut late = attach(&writer, &a, &b, qos);
        let taken = std::iter::from_fn(|| late.take_sample().unwrap());
        let sequences: Vec<u64> = taken.map(|sample| sample.meta().sequence).collect();
        assert_eq!(sequences, expected);
    };
    available::PRETENDED.set(Some(0));
    // The budget is full, so all samples except one would have to be dropped.
    let refused = writer.loan(MAX as usize).map(drop);
    assert!(matches!(refused, Err(PublishError::NoMemory { .. })), "{refused:?}");
    standing(&[0, 1, 2, 3, 4]);
    // The kept samples make room for a sample of the same length.
    publish(&writer, 5, IMAGE);
    publish(&writer, 6, IMAGE);
    standing(&[2, 3, 4, 5, 6]);
}

#[test]
fn a_sample_evicted_before_its_memory_arrived_does_not_block_readers() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_last(10), 0);
    let from = RingPeer::Remote(PeerSession::map(a.id(), a.descriptors().unwrap()).unwrap());
    let mut reader = attach_to(&writer, &a, &b, from, keep_last(10));
    publish(&writer, 0, IMAGE);
    assert!(reader.take_sample().unwrap().is_none(), "its memory has not come");
    assert!(!reader.has_data() && reader.missing().is_some());
    // The budget is full: the large sample is dropped, and its memory with it.
    publish(&writer, 1, 1000);
    publish(&writer, 2, 1000);
    assert!(!reclaim_idle(&writer, Instant::now(), 20));
    assert!(reader.has_data(), "there is something to take");
    let sample = reader.take_sample().unwrap().expect("a sample");
    assert_eq!((sample.meta(), reader.lost()), (meta(1), 1));
}

#[test]
fn a_child_after_fork_looks_after_nothing() {
    let a = session();
    let writer = writer(&a, transient(keep_last(1)), 0);
    publish(&writer, 0, IMAGE);
    // SAFETY: the child takes no lock, allocates nothing and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let refused = matches!(writer.prepare(), Err(ShmError::Forked))
            && !writer.reclaim_idle(Instant::now());
        // SAFETY: ends the process without running anything else.
        unsafe { libc::_exit(i32::from(!refused)) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made; `status` outlives the call.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert_eq!(status, 0);
    assert!(reclaim_idle(&writer, Instant::now(), IDLE.as_secs() + 2), "the parent's stands");
}

#[test]
fn a_subscriber_in_its_publishers_context_is_sent_nothing() {
    let (ours, theirs) = std::os::unix::net::UnixDatagram::pair().unwrap();
    let context = Context::new().unwrap();
    let publisher = Publisher::new(&context, PublisherOptions::new(keep_last(1))).unwrap();
    let mut subscriber = std::thread::scope(|scope| {
        scope.spawn(|| publisher.serve(&ours, Some(EVER)).unwrap());
        let options = SubscriberOptions::new(keep_last(1));
        Subscriber::connect(&context, &theirs, options, Some(EVER)).unwrap()
    });
    publisher.publish(&pattern(1, IMAGE)).unwrap();
    assert!(subscriber.take().unwrap().is_some());
    theirs.set_nonblocking(true).unwrap();
    let error = theirs.recv(&mut [0; 64]).expect_err("memory in a packet that nobody takes stays");
    assert_eq!(error.kind(), std::io::ErrorKind::WouldBlock);
}

/// Trusts the publishers of this test.
fn trust() -> TrustPublishers {
    // SAFETY: the publishers use this crate, and no forked child of a test uses a slice that was borrowed before.
    unsafe { TrustPublishers::new() }
}

#[test]
fn a_slice_is_where_the_sample_is_and_keeps_it() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    for reading in [&a, &b] {
        let mut reader = attach(&writer, &a, reading, keep_last(1));
        writer.publish(meta(1), &pattern(1, IMAGE)).unwrap();
        let sample = reader.take_sample().unwrap().expect("a sample");
        assert!(sample.is_borrowed());
        let place = sample.as_ptr();
        let slice = sample.into_slice(trust());
        assert_eq!((slice.as_ptr(), slice.meta()), (place, meta(1)));
        for sequence in 2..50 {
            writer.publish(meta(sequence), &pattern(sequence, IMAGE)).unwrap();
        }
        drop(reader);
        assert!(slice[..] == pattern(1, IMAGE), "the sample changed");
    }
}

#[test]
fn in_a_forked_child_a_slice_is_empty() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &a, keep_last(1));
    writer.publish(meta(1), &pattern(1, IMAGE)).unwrap();
    let slice = reader.take_sample().unwrap().expect("a sample").into_slice(trust());
    assert_eq!(slice.len(), IMAGE);
    // SAFETY: the child takes no lock, allocates nothing and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let empty = slice.is_empty();
        // SAFETY: ends the process without running anything else.
        unsafe { libc::_exit(i32::from(!empty)) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made; `status` outlives the call.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert_eq!(status, 0);
}

#[test]
fn bytes_that_are_not_done_with_are_told_of_taken_samples_too() {
    const DESCRIPTOR: u64 = 128;
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    reader.finish_later();
    assert_eq!(reader.undone_bytes(), 0);
    // An inline sample, a sample in a block, and samples in slots.
    for (sequence, len) in (1..).zip([10, 2000, 9000, 5000]) {
        writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
    }
    assert_eq!(reader.undone_bytes(), 16_010 + 4 * DESCRIPTOR);
    assert!(take(&mut reader).is_some() && take(&mut reader).is_some());
    assert_eq!(reader.undone_bytes(), 16_010 + 4 * DESCRIPTOR, "taken, and not done with");
    reader.finish(1);
    assert_eq!(reader.undone_bytes(), 16_000 + 3 * DESCRIPTOR);
    reader.finish(2);
    assert!(take(&mut reader).is_some() && take(&mut reader).is_some());
    reader.finish(4);
    assert_eq!(reader.undone_bytes(), 0);
}
