//! Rings that grow, segments that arrive later than the samples in them, and memory that is returned.

use std::process::Command;

use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::*;

mod budget;

/// Attaches a reader in another session that receives segments only through [`hand`].
fn attach_untold(
    writer: &Writer,
    publisher: &Arc<SessionSegment>,
    reader: &Arc<SessionSegment>,
    qos: Qos,
) -> (Reader, Arc<PeerSession>) {
    let descriptors = publisher.descriptors().unwrap();
    attach_untold_with(descriptors, writer, publisher, reader, qos)
}

/// Like [`attach_untold`], with these descriptors of the publisher's session.
fn attach_untold_with(
    descriptors: PeerDescriptors,
    writer: &Writer,
    publisher: &Arc<SessionSegment>,
    reader: &Arc<SessionSegment>,
    qos: Qos,
) -> (Reader, Arc<PeerSession>) {
    let from = PeerSession::map(publisher.id(), descriptors).unwrap();
    let reader = attach_to(writer, publisher, reader, RingPeer::Remote(from.clone()), qos);
    (reader, from)
}

fn hand(from: &SessionSegment, number: u32, to: &PeerSession) {
    let (info, fd) = from.segment(number).unwrap().expect("the segment");
    to.add_segment(info, fd).unwrap();
}

fn publish(writer: &Writer, sequence: u64, len: usize) {
    writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
}

fn take(reader: &mut Reader) -> Option<u64> {
    let mut out = Vec::new();
    let taken = reader.take(&mut out).unwrap()?;
    let sequence = taken.meta.sequence;
    assert_eq!(taken.meta, meta(sequence));
    assert!(out == pattern(sequence, out.len()), "sample {sequence} is torn");
    Some(sequence)
}

fn descriptors(writer: &Writer) -> u64 {
    writer.lock().history.capacity() + 1
}

#[test]
fn a_ring_is_as_deep_as_it_must_be() {
    for depth in [1, 2, 15, 16, 17, 100, 1000, 10_000] {
        let (a, b) = (session(), session());
        let writer = writer(&a, keep_last(1), 64 << 20);
        assert_eq!(descriptors(&writer), 16);
        let mut reader = attach(&writer, &a, &b, keep_last(depth));
        let (depth, total) = (u64::from(depth), 2 * u64::from(depth) + 40);
        (0..total).for_each(|sequence| publish(&writer, sequence, 8 + (sequence % 200) as usize));
        assert_eq!(reader.unread(), depth);
        for sequence in total - depth..total {
            assert_eq!(take(&mut reader), Some(sequence));
        }
        assert_eq!(take(&mut reader), None);
        let counts = (reader.received(), reader.skipped(), reader.lost());
        assert_eq!(counts, (depth, total - depth, 0));
        let expected = (depth.max(16) * 5 / 4 + 1).next_power_of_two();
        assert_eq!(descriptors(&writer), expected, "at depth {depth}");
    }
}

#[test]
fn keep_all_grows_to_its_limit_and_then_holds() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 64 << 20);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    let mut sequence = 0;
    while writer.try_publish(meta(sequence), &pattern(sequence, 100)).is_ok() {
        sequence += 1;
    }
    assert_eq!(sequence, 8192);
    for expected in 0..sequence {
        assert_eq!(take(&mut reader), Some(expected));
    }
    assert_eq!((take(&mut reader), reader.lost()), (None, 0));
}

/// KEEP_ALL, with all samples for late joiners.
fn keep_all_for_later() -> Qos {
    Qos { durability: Durability::TransientLocal, ..Qos::keep_all() }
}

/// Publishes `total` samples of `len` bytes, and returns the number that a late joiner gets.
fn late_reader_gets(budget: u64, total: u64, len: usize) -> u64 {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_all_for_later(), budget);
    (0..total).for_each(|sequence| publish(&writer, sequence, len));
    let mut late = attach(&writer, &a, &b, keep_all_for_later());
    let mut taken = 0;
    while let Some(sequence) = take(&mut late) {
        taken += 1;
        // No sample is missing among the newest.
        assert_eq!(sequence + late.unread(), total - 1);
    }
    assert_eq!(late.lost(), 0);
    taken
}

#[test]
fn history_for_late_readers_is_bounded_by_bytes() {
    assert_eq!(late_reader_gets(64 << 20, 20_000, 64), 20_000);
    // Each sample takes a descriptor of 128 bytes.
    assert_eq!(late_reader_gets(4 << 20, 200_000, 64), (4 << 20) / 128);
    assert_eq!(late_reader_gets(3 << 20, 200_000, 64), (3 << 20) / 128);
    // Each sample also takes a block of 256 bytes.
    assert_eq!(late_reader_gets(3 << 20, 50_000, 200), (3 << 20) / 384);
    assert_eq!(late_reader_gets(64 << 20, 600_000, 88), (64 << 20) / 128);
}

#[test]
fn keep_all_history_survives_a_move_that_one_reader_cannot_map() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_all_for_later(), 64 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, keep_last(1));
    (0..20_000).for_each(|sequence| publish(&writer, sequence, 64));
    let mut late = attach(&writer, &a, &a, keep_all_for_later());
    for sequence in 0..20_000 {
        assert_eq!(take(&mut late), Some(sequence));
    }
    assert_eq!(take(&mut reader), None, "it does not see where they are");
    for segment in a.segments() {
        if segment.number > 0 {
            hand(&a, segment.number, &from);
        }
    }
    assert_eq!(take(&mut reader), Some(19_999));
}

#[test]
fn a_reader_keeps_its_place_while_the_ring_grows() {
    let (a, b) = (session(), session());
    for each in 1..6 {
        let writer = writer(&a, Qos::keep_all(), 64 << 20);
        let mut reader = attach(&writer, &a, &b, Qos::keep_all());
        let mut next = 0;
        for sequence in 0..3000 {
            publish(&writer, sequence, 60);
            if sequence % (each + 1) == 0 {
                assert_eq!(take(&mut reader), Some(next));
                next += 1;
            }
        }
        while let Some(sequence) = take(&mut reader) {
            assert_eq!(sequence, next);
            next += 1;
        }
        assert_eq!((next, reader.lost()), (3000, 0));
    }
}

#[test]
fn an_overtaken_reader_counts_right_while_the_ring_grows() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 1 << 20);
    let total = 30_000;
    // The readers that attach make the ring grow while the first one reads.
    let mut first = attach(&writer, &a, &b, keep_last(3));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut others = Vec::new();
            for sequence in 0..total {
                if sequence % 3000 == 0 {
                    others.push(attach(&writer, &a, &b, keep_last(20 << (sequence / 3000))));
                }
                publish(&writer, sequence, (sequence % 150) as usize);
            }
        });
        let mut last = None;
        while last != Some(total - 1) {
            await_data(&b, &first);
            let Some(sequence) = take(&mut first) else { continue };
            assert!(last < Some(sequence));
            last = Some(sequence);
        }
    });
    assert_eq!(first.received() + first.skipped() + first.lost(), total);
    assert!(descriptors(&writer) >= 8192);
}

/// Makes a publisher with `offered` fill its first segment. One reader takes each sample at once and does not receive
/// further segments; another takes none and has a depth of 1. Checks that the ring stays where the first one reads it.
fn ring_stays_in_its_segment(offered: Qos, wanted: Qos) {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, offered, 64 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, wanted);
    let (idle, _) = attach_untold(&writer, &a, &session(), keep_last(1));
    let start = Instant::now();
    let total = 6000;
    for sequence in 0..total {
        publish(&writer, sequence, 8);
        assert_eq!(take(&mut reader), Some(sequence));
    }
    if start.elapsed() > Duration::from_millis(900) {
        // On such a slow host the ring may move in spite of that.
        return;
    }
    assert_eq!(idle.received(), 0);
    assert_eq!(a.segments().len(), 1, "the session has the segment, and the ring does not use it");
    assert!((1024..4096).contains(&descriptors(&writer)));
    hand(&a, 1, &from);
    (total..2 * total).for_each(|sequence| publish(&writer, sequence, 8));
    assert!(descriptors(&writer) >= 8192);
    for sequence in total..2 * total {
        assert_eq!(take(&mut reader), Some(sequence));
    }
    assert_eq!(reader.lost() + reader.skipped(), 0);
}

#[test]
fn ring_stays_while_a_reader_that_has_taken_all_cannot_map_the_new_segment() {
    ring_stays_in_its_segment(keep_last(1), keep_last(10_000));
    let latched = |depth| keep_last(depth).with_durability(Durability::TransientLocal);
    ring_stays_in_its_segment(latched(1), latched(10_000));
}

#[test]
fn history_within_the_depth_survives_a_move_that_one_reader_cannot_map() {
    let (a, b) = (silent_session(), session());
    let latched = keep_last(6000).with_durability(Durability::TransientLocal);
    let writer = writer(&a, latched, 64 << 20);
    let (mut reader, _from) = attach_untold(&writer, &a, &b, keep_last(10));
    for sequence in 0..6000 {
        publish(&writer, sequence, 64);
        while take(&mut reader).is_some() {}
    }
    let mut late = attach(&writer, &a, &a, latched);
    for sequence in 0..6000 {
        assert_eq!(take(&mut late), Some(sequence));
    }
}

#[test]
fn reader_without_the_descriptors_sleeps_after_its_depth_is_exceeded() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_last(1), 64 << 20);
    let (slow, _) = attach_untold(&writer, &a, &b, keep_last(10_000));
    let (mut reader, from) = attach_untold(&writer, &a, &session(), keep_last(10));
    (0..6000).for_each(|sequence| publish(&writer, sequence, 8));
    assert!(slow.missing().is_none() && reader.has_data());
    assert_eq!(take(&mut reader), None);
    assert_eq!(reader.missing(), Some(1));
    assert!(!reader.has_data(), "a reader that has data and finds none never sleeps");
    publish(&writer, 6000, 8);
    assert!(reader.has_data());
    assert_eq!((take(&mut reader), reader.has_data()), (None, false));
    hand(&a, 1, &from);
    assert!(reader.has_data());
    for sequence in 5991..=6000 {
        assert_eq!(take(&mut reader), Some(sequence));
    }
    assert_eq!((take(&mut reader), reader.skipped(), reader.lost()), (None, 5991, 0));
}

#[test]
fn a_reader_that_lacks_the_memory_loses_no_sample_within_its_depth() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_last(1), 64 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, keep_last(10_000));
    let total = 6000;
    (0..total).for_each(|sequence| publish(&writer, sequence, 8));
    assert_eq!(take(&mut reader), None, "the reader does not see where they are");
    assert_eq!(reader.missing(), Some(1));
    hand(&a, 1, &from);
    for sequence in 0..total {
        assert_eq!(take(&mut reader), Some(sequence));
    }
    assert_eq!(reader.lost() + reader.skipped(), 0);
}

#[test]
fn memory_to_grow_into_is_there_before_it_is_needed() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_last(1), 64 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, keep_last(10_000));
    let total = 10_000;
    for sequence in 0..total {
        publish(&writer, sequence, 8);
        if !a.segments().is_empty() && !from.has_segment(1) {
            assert!(descriptors(&writer) < 4096, "it comes ahead of what moves there");
            hand(&a, 1, &from);
        }
    }
    for sequence in 0..total {
        assert_eq!(take(&mut reader), Some(sequence));
    }
    assert_eq!(reader.lost() + reader.skipped(), 0);
}

#[test]
fn a_publish_that_waits_for_readers_goes_where_they_do_not_look_yet() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, Qos::keep_all(), 64 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, Qos::keep_all());
    let total = 6000;
    for sequence in 0..total {
        writer.try_publish(meta(sequence), &pattern(sequence, 8)).unwrap();
    }
    assert_eq!(take(&mut reader), None, "not yet");
    assert_eq!(reader.missing(), Some(1));
    hand(&a, 1, &from);
    for sequence in 0..total {
        assert_eq!(take(&mut reader), Some(sequence));
    }
    assert_eq!(reader.lost() + reader.skipped(), 0);
}

#[test]
fn memory_of_a_dead_process_that_never_comes_is_waited_for_once() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let mut process = Command::new("true").spawn().unwrap();
    let pidfd = pidfd_open(Pid::from_child(&process), PidfdFlags::empty()).unwrap().into();
    process.wait().unwrap();
    let descriptors = PeerDescriptors { pidfd, ..a.descriptors().unwrap() };
    let (mut reader, from) = attach_untold_with(descriptors, &writer, &a, &b, Qos::keep_all());
    // The short sample is in memory that the reader has.
    for (sequence, length) in [(0, 5000), (1, 10), (2, 5000)] {
        publish(&writer, sequence, length);
    }
    // Returns how often the reader asks for the memory of a sample before it gives the sample up.
    let asks = |reader: &mut Reader, lost| {
        let mut times = 0;
        while reader.lost() < lost {
            if reader.has_data() {
                let _ = take(reader);
            }
            times += from.take_wanted().len();
            std::thread::sleep(Duration::from_millis(5));
        }
        times
    };
    let [first, second] = [1, 2].map(|lost| asks(&mut reader, lost));
    assert!(first > 1 && second == 1, "{first} and {second} times");
    assert_eq!((reader.received(), reader.lost()), (1, 2));
}

#[test]
fn a_sample_whose_memory_has_not_come_waits_for_it() {
    let (a, b) = (silent_session(), session());
    let writer = writer(&a, keep_last(1), 1 << 20);
    let (mut reader, from) = attach_untold(&writer, &a, &b, keep_last(10));
    publish(&writer, 0, 10);
    publish(&writer, 1, 5000);
    publish(&writer, 2, 20);
    assert_eq!(take(&mut reader), Some(0));
    assert!(reader.has_data());
    for _ in 0..3 {
        assert_eq!(take(&mut reader), None);
        assert!(reader.take_sample().unwrap().is_none());
    }
    assert_eq!(reader.missing(), Some(1));
    assert!(!reader.has_data() && !reader.is_drained(), "nothing yet");
    assert_eq!(from.take_wanted(), [1].into());
    assert!(from.take_wanted().is_empty(), "asked for once");
    hand(&a, 1, &from);
    assert!(reader.has_data());
    let sample = reader.take_sample().unwrap().unwrap();
    assert!(sample.is_borrowed());
    assert_eq!(take(&mut reader), Some(2));
    // The publisher gave the segment up; memory in use stays mapped.
    from.remove_segment(1);
    drop(writer);
    let mut out = Vec::new();
    sample.copy_to(&mut out).unwrap();
    assert!(out == pattern(1, 5000));
    assert_eq!(reader.lost(), 0);
}

#[test]
fn memory_for_expected_samples_exists_before_the_first_one() {
    let (a, b) = (silent_session(), session());
    let gid = Gid::new(a.id(), 1);
    let options =
        RingOptions { gid, qos: keep_last(1), budget: 0, max_message: MAX, expected: 100_000 };
    let writer = Writer::create(a.clone(), options).unwrap();
    let info = SegmentInfo { number: 1, kind: SegmentKind::Samples(gid) };
    assert_eq!(a.segments(), [info]);
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    publish(&writer, 0, 100_000);
    assert_eq!(take(&mut reader), Some(0));
}

#[test]
fn an_unread_sample_costs_a_number_and_no_memory() {
    let (a, b) = (session(), session());
    let publisher = writer(&a, keep_last(5), 1 << 20);
    for number in 1..=50 {
        let len = [0, 100, 5000, MAX as usize][number as usize % 4];
        assert_eq!(publisher.publish_next(7, &vec![1; len]), Ok(number));
    }
    let published = publisher.publish(meta(51), b"x").unwrap();
    assert_eq!(published.position, None);
    assert_eq!(publisher.skip_unread(), Ok(Some(52)));
    assert!(a.segments().is_empty(), "no memory for large samples");
    // A loan that nobody reads returns its memory.
    for number in 53..100 {
        let mut loan = publisher.loan(MAX as usize).unwrap();
        loan.fill(1);
        assert_eq!(loan.publish_next(7), Ok(number));
    }
    let words = publisher.header.words();
    assert_eq!(words[layout::ring::HEAD].load(Relaxed), 0);
    assert_eq!(words[layout::ring::PUBLISHED].load(Relaxed), 99);
    let mut reader = attach(&publisher, &a, &b, keep_last(5));
    assert_eq!(reader.grant().first, 0);
    assert_eq!(publisher.skip_unread(), Ok(None));
    assert_eq!(publisher.publish_next(7, b"read"), Ok(100));
    let taken = reader.take(&mut Vec::new()).unwrap().unwrap();
    assert_eq!((taken.meta.sequence, taken.position), (100, 0));
    drop(reader);
    publisher.drop_gone();
    assert_eq!(publisher.skip_unread(), Ok(Some(101)));
    // A late joiner may read it.
    let latched = writer(&a, transient(keep_last(5)), 1 << 20);
    assert_eq!(latched.skip_unread(), Ok(None));
    assert_eq!(latched.publish(meta(1), b"x").unwrap().position, Some(0));
}

#[test]
fn memory_of_ended_publishers_is_reused() {
    let a = session();
    for round in 0..2000 {
        let publisher = writer(&a, transient(keep_last(20)), 1 << 20);
        (0..40).for_each(|sequence| publish(&publisher, sequence, 1000));
        if round % 100 == 0 {
            publish(&publisher, 40, 5000);
        }
    }
    assert!(a.segments().is_empty(), "what two thousand took one after the other fits in one");
}

#[test]
fn ended_publishers_are_not_checked_again_at_each_end() {
    const MANY: usize = 3000;
    let (a, b) = (session(), session());
    let from = peer(&b, &a);
    let writers: Vec<_> = (0..MANY).map(|_| writer(&a, keep_last(1), 0)).collect();
    let attached = writers.iter().map(|w| attach_to(w, &a, &b, from.clone(), keep_last(1)));
    let readers: Vec<_> = attached.collect();
    drop(writers);
    assert!(a.tidy(), "they are read");
    let looks = a.looks_at_orphans();
    assert!(looks < 4 * MANY, "{looks} looks");
    drop(readers);
    assert!(!a.tidy(), "nobody reads them any more");
}

#[test]
fn a_publisher_that_is_gone_is_read_to_the_end() {
    let (a, b) = (session(), session());
    let gone = writer(&a, Qos::keep_all(), 1 << 20);
    let mut reader = attach(&gone, &a, &b, Qos::keep_all());
    let mut near = attach(&gone, &a, &a, Qos::keep_all());
    (0..300).for_each(|sequence| publish(&gone, sequence, 100 + (sequence % 2 * 6000) as usize));
    let samples = a.segments();
    drop(gone);
    // Others take memory meanwhile.
    for _ in 0..100 {
        let other = writer(&a, transient(keep_last(20)), 1 << 20);
        (0..40).for_each(|sequence| publish(&other, sequence, 1000));
    }
    for sequence in 0..300 {
        assert_eq!(take(&mut reader), Some(sequence));
        assert_eq!(take(&mut near), Some(sequence));
    }
    assert!(reader.is_drained() && near.is_drained());
    assert_eq!(a.segments(), samples);
    drop((reader, near));
    a.tidy();
    assert!(a.segments().is_empty(), "all of it is given up");
}

#[test]
fn a_session_is_mapped_once_for_all_its_topics() {
    let (a, b) = (session(), session());
    let from = peer(&b, &a);
    let writers: Vec<_> = (0..100).map(|_| writer(&a, keep_last(1), 1 << 20)).collect();
    let mut readers: Vec<_> =
        writers.iter().map(|w| attach_to(w, &a, &b, from.clone(), keep_last(1))).collect();
    for (number, writer) in writers.iter().enumerate() {
        publish(writer, number as u64, 500);
    }
    for (number, reader) in readers.iter_mut().enumerate() {
        assert_eq!(take(reader), Some(number as u64));
    }
    assert!(a.segments().is_empty() && b.segments().is_empty());
}

#[test]
fn small_samples_find_room_when_the_first_segment_is_full() {
    let (a, b) = (session(), session());
    let writers: Vec<_> = (0..20).map(|_| writer(&a, keep_last(50), 1 << 20)).collect();
    let mut readers: Vec<_> = writers.iter().map(|w| attach(w, &a, &b, keep_last(50))).collect();
    for sequence in 0..120 {
        writers.iter().for_each(|writer| publish(writer, sequence, 4000));
    }
    assert_eq!(a.segments().len(), 1);
    for reader in &mut readers {
        for sequence in 70..120 {
            assert_eq!(take(reader), Some(sequence));
        }
        assert_eq!(reader.lost(), 0);
    }
}
