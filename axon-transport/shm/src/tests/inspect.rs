//! What the status reads of rings and lanes.

use std::os::fd::AsFd;

use super::*;
use crate::{
    qos::Reliability,
    ring::inspect::{self, LaneCounts, RingCounts},
};

fn counts(session: &SessionSegment, writer: &Writer) -> RingCounts {
    let descriptors = session.descriptors().unwrap();
    RingCounts::read(descriptors.segment.as_fd(), writer.location()).unwrap()
}

fn lane(session: &SessionSegment, reader: &Reader) -> LaneCounts {
    let descriptors = session.descriptors().unwrap();
    LaneCounts::read(descriptors.segment.as_fd(), reader.lane()).unwrap()
}

#[test]
fn what_is_no_memory_is_not_read() {
    let (end, _other) = std::io::pipe().unwrap();
    let at = Location { segment: 0, offset: 4096 };
    assert_eq!(RingCounts::read(end.as_fd(), at), None);
    assert_eq!(LaneCounts::read(end.as_fd(), at), None);
    let session = session();
    let descriptors = session.descriptors().unwrap();
    let beyond = Location { segment: 0, offset: i64::MAX as u64 - 127 };
    assert_eq!(RingCounts::read(descriptors.segment.as_fd(), beyond), None);
}

#[test]
fn who_takes_what_and_when_is_told() {
    let (ours, theirs) = (session(), session());
    let writer = writer(&ours, keep_last(8), MAX);
    assert_eq!(counts(&ours, &writer).window, 16);
    let mut reader = attach(&writer, &ours, &theirs, keep_last(40));
    assert_eq!(counts(&ours, &writer).window, 40);
    assert_eq!(lane(&theirs, &reader), LaneCounts::default());
    for sequence in 1..=100 {
        writer.publish(meta(sequence), b"sample").unwrap();
    }
    let ring = counts(&ours, &writer);
    assert_eq!((ring.published, ring.standing.1), (100, 100));
    assert!(ring.standing.0 <= 60, "{ring:?}");
    let file = ours.descriptors().unwrap().segment;
    let timestamp = |position| {
        let at = ring.descriptor(position).unwrap();
        inspect::timestamp(file.as_fd(), at, position)
    };
    assert_eq!(timestamp(99), Some(meta(100).source_timestamp));
    assert_eq!(timestamp(3), None, "others stand there");
    assert_eq!(timestamp(u64::MAX), None);
    let mut out = Vec::new();
    let taken = reader.take(&mut out).unwrap().unwrap();
    let lane_now = lane(&theirs, &reader);
    assert_eq!(lane_now.taken, Some(taken.meta.source_timestamp));
    assert_eq!((lane_now.received, lane_now.skipped, lane_now.cursor), (1, 60, 61));
    drop(reader);
    assert_eq!(counts(&ours, &writer).window, 40, "nobody has said that it is gone");
    writer.drop_gone();
    assert_eq!(counts(&ours, &writer).window, 16);
}

#[test]
fn memory_comes_and_goes_with_descriptors_and_blocks() {
    let (ours, theirs) = (session(), session());
    let writer = writer(&ours, keep_last(200), MAX);
    let bare = counts(&ours, &writer).bytes;
    assert_eq!(bare, layout::RING + layout::FIRST_DESCRIPTORS * layout::DESCRIPTOR);
    let _reader = attach(&writer, &ours, &theirs, keep_last(200));
    for sequence in 1..=300 {
        writer.publish(meta(sequence), &pattern(sequence, 1000)).unwrap();
    }
    let full = counts(&ours, &writer).bytes;
    assert!(full >= layout::RING + 200 * (layout::DESCRIPTOR + 1024), "{full}");
    assert!(full <= layout::RING + 512 * (layout::DESCRIPTOR + 1024), "{full}");
    // Blocks of another length take the place of most of these.
    for sequence in 301..=700 {
        writer.publish(meta(sequence), &pattern(sequence, 200)).unwrap();
    }
    assert!(counts(&ours, &writer).bytes < full);
}

#[test]
fn publishes_that_fail_are_counted_by_why() {
    let (ours, theirs) = (session(), session());
    let all =
        Qos { history: History::KeepAll, reliability: Reliability::Reliable, ..Qos::default() };
    let writer = writer(&ours, all, 64 << 10);
    let _reader = attach(&writer, &ours, &theirs, all);
    let mut sequence = 0;
    let error = loop {
        sequence += 1;
        if let Err(error) = writer.try_publish(meta(sequence), &pattern(sequence, 4000)) {
            break error;
        }
    };
    assert!(matches!(error, PublishError::Blocked { .. }), "{error}");
    assert_eq!(counts(&ours, &writer).blocked, 0, "whoever does not wait tries again");
    writer.publish(meta(sequence), &pattern(sequence, 4000)).unwrap_err();
    let ring = counts(&ours, &writer);
    assert_eq!((ring.blocked, ring.no_memory, ring.pinned), (1, 0, 0));

    let lent = super::writer(&ours, keep_last(1), 0);
    let mut loans = Vec::new();
    let error = loop {
        match lent.loan(MAX as usize) {
            Ok(loan) => loans.push(loan),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, PublishError::Loaned { .. }), "{error}");
    assert_eq!(counts(&ours, &lent).pinned, 1);
}
