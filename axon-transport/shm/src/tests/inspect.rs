//! Tests the values that the status reads from rings and lanes.

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
fn inspect_reads_no_invalid_memory() {
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
fn inspect_reports_each_readers_progress() {
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
    assert_eq!(timestamp(99), Some(meta(100).source_nanos));
    assert_eq!(timestamp(3), None, "others stand there");
    assert_eq!(timestamp(u64::MAX), None);
    let mut out = Vec::new();
    let taken = reader.take(&mut out).unwrap().unwrap();
    let lane_now = lane(&theirs, &reader);
    assert_eq!(lane_now.taken, Some(taken.meta.source_nanos));
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
    // Blocks of another length replace most of the earlier ones.
    for sequence in 301..=700 {
        writer.publish(meta(sequence), &pattern(sequence, 200)).unwrap();
    }
    assert!(counts(&ours, &writer).bytes < full);
}

/// More samples than fit in the first segment of a session.
const MANY: u64 = 2048;

#[test]
fn history_dropped_for_lack_of_memory_is_counted() {
    let ours = session();
    let all =
        Qos { history: History::KeepAll, reliability: Reliability::Reliable, ..Qos::default() };
    let writer = writer(&ours, transient(all), MAX);
    available::PRETENDED.set(Some(0));
    for sequence in 1..=MANY {
        writer.publish(meta(sequence), &pattern(sequence, 8)).unwrap();
    }
    let ring = counts(&ours, &writer);
    let gone = MANY - (ring.standing.1 - ring.standing.0);
    assert!(gone > 0, "{ring:?}");
    assert_eq!((ring.blocked, ring.no_memory), (0, gone), "{ring:?}");
    // The same for blocks, if there is none for another sample.
    for sequence in ring.standing.1 + 1..=10_000 {
        writer.publish(meta(sequence), &pattern(sequence, 1000)).unwrap();
    }
    let ring = counts(&ours, &writer);
    assert_eq!(ring.no_memory, 10_000 - (ring.standing.1 - ring.standing.0), "{ring:?}");
}

#[test]
fn dropping_taken_samples_counts_no_loss() {
    let (ours, theirs) = (session(), session());
    let writer = writer(&ours, keep_last(1000), MAX);
    let mut reader = attach(&writer, &ours, &theirs, keep_last(1000));
    available::PRETENDED.set(Some(0));
    for sequence in 1..=10_000 {
        let len = if sequence > 5_000 { 1000 } else { 8 };
        writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
        assert!(reader.take_sample().unwrap().is_some());
    }
    let ring = counts(&ours, &writer);
    assert!(ring.standing.1 - ring.standing.0 < 1000, "memory was to be short: {ring:?}");
    assert_eq!((reader.lost(), ring.no_memory), (0, 0));
}

#[test]
fn a_reader_is_not_blamed_where_memory_is_short() {
    let (ours, theirs) = (session(), session());
    let all =
        Qos { history: History::KeepAll, reliability: Reliability::Reliable, ..Qos::default() };
    let writer = writer(&ours, all, MAX);
    let mut reader = attach(&writer, &ours, &theirs, all);
    let (mut last, mut failed) = (0, 0);
    for len in [8, 1000, 8000] {
        let (before, mut taken) = (last, 0);
        // There is memory for samples of this length; then there is no more.
        available::PRETENDED.set(None);
        last += 1;
        writer.publish(meta(last), &pattern(last, len)).unwrap();
        available::PRETENDED.set(Some(0));
        let error = loop {
            match writer.try_publish(meta(last + 1), &pattern(last + 1, len)) {
                Ok(_) => last += 1,
                Err(error) => break error,
            }
        };
        // A publish that does not wait is tried again until the reader has made room.
        assert!(matches!(error, PublishError::Blocked { .. }), "{len}: {error}");
        assert_eq!(counts(&ours, &writer).no_memory, failed, "nothing is dropped yet");
        let error = writer.publish(meta(last + 1), &pattern(last + 1, len)).unwrap_err();
        assert!(matches!(error, PublishError::NoMemory { .. }), "{len}: {error}");
        failed += 1;
        // Nothing is lost: the publisher waited for its reader.
        while reader.take_sample().unwrap().is_some() {
            taken += 1;
        }
        assert_eq!((taken, reader.lost()), (last - before, 0));
    }
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
    assert_eq!(counts(&ours, &writer).blocked, 0, "a caller that does not wait tries again");
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
