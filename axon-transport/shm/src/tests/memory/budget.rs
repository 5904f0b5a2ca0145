//! Rings that share a memory budget: if it is used up, each follows its QoS.

use std::os::fd::AsFd;

use super::*;
use crate::{
    alloc::{budget::MemoryBudget, retention::IDLE},
    ring::inspect::committed,
};

const IMAGE: usize = 300_000;
const MOST: u64 = 8 << 20;
/// Memory of several rings that does not count in the budget: the headers and the first
/// descriptors.
const BESIDE: u64 = 1 << 20;

/// Creates a ring of 4 MiB, whose number is the number of its publisher.
fn ring(session: &Arc<SessionSegment>, number: u32, qos: Qos, of: &Arc<MemoryBudget>) -> Writer {
    let gid = Gid::new(session.id(), number);
    let options = RingOptions { gid, qos, budget: 4 << 20, max_message: MAX, expected: 0 };
    let writer = Writer::create(session.clone(), options).unwrap();
    writer.share(of);
    writer
}

/// Returns the bytes that are backed by memory, of all segments of a session.
fn backed(session: &SessionSegment) -> u64 {
    let numbers = session.segments().into_iter().map(|info| info.number).chain([0]);
    let segments = numbers.map(|number| session.segment(number).unwrap().unwrap().1);
    segments.map(|fd| committed(fd.as_fd())).sum()
}

fn try_publish(writer: &Writer, sequence: u64, len: usize) -> Result<(), PublishError> {
    writer.try_publish(meta(sequence), &pattern(sequence, len)).map(drop)
}

/// Publishes `count` samples of this length in each ring in turn.
fn fill(writers: &[Writer], len: usize, count: u64) -> u64 {
    let mut refused = 0;
    for sequence in 0..count {
        for writer in writers {
            match try_publish(writer, sequence, len) {
                Ok(()) => {}
                Err(PublishError::MemoryBudget { most: MOST, .. }) => refused += 1,
                Err(other) => panic!("{other}"),
            }
        }
    }
    refused
}

#[test]
fn history_of_many_rings_is_bounded_together_and_given_back() {
    for (len, count) in [(IMAGE, 20), (2_000, 2_500), (60, 5_000)] {
        let (a, b) = (session(), session());
        let budget = MemoryBudget::new(MOST);
        let before = backed(&a);
        let all = transient(Qos::keep_all());
        let mut writers: Vec<_> = (0..10).map(|n| ring(&a, n, all, &budget)).collect();
        fill(&writers, len, count);
        let held = backed(&a) - before;
        assert!(held <= MOST + BESIDE, "{held} of samples of {len}");
        assert!(budget.held() > MOST / 2, "most of it is of use: {}", budget.held());
        assert!(budget.refused() > 0);
        // Late joiners get the newest sample.
        let mut reader = attach(&writers[0], &a, &b, all);
        let mut last = None;
        while let Some(sequence) = take(&mut reader) {
            last = Some(sequence);
        }
        assert_eq!(last, Some(count - 1), "{len}");
        // The memory of a dropped publisher counts until no reader can read it.
        drop(writers.remove(0));
        let with_reader = budget.held();
        drop(reader);
        a.tidy();
        assert!(budget.held() < with_reader, "{len}");
        drop(writers);
        a.tidy();
        assert_eq!(budget.held(), 0);
    }
}

#[test]
fn a_ring_that_may_have_no_more_memory_shows_its_newest_sample() {
    let (a, b) = (session(), session());
    let budget = MemoryBudget::new(MOST);
    let writers = [1, 2].map(|n| ring(&a, n, transient(keep_last(1)), &budget));
    publish(&writers[0], 0, IMAGE);
    // Other rings take everything except the sample's memory.
    let others: Vec<_> =
        (3..12).map(|n| ring(&a, n, transient(Qos::keep_all()), &budget)).collect();
    fill(&others, IMAGE, 20);
    for sequence in 1..10 {
        publish(&writers[0], sequence, IMAGE);
        let mut late = attach(&writers[0], &a, &b, transient(keep_last(1)));
        assert_eq!((take(&mut late), take(&mut late)), (Some(sequence), None));
    }
}

#[test]
fn ring_without_memory_waits_for_its_keep_all_readers() {
    let (a, b) = (session(), session());
    let budget = MemoryBudget::new(MOST);
    let writer = ring(&a, 1, Qos::keep_all(), &budget);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    let others: Vec<_> =
        (2..12).map(|n| ring(&a, n, transient(Qos::keep_all()), &budget)).collect();
    let mut sequence = 0;
    while sequence < 4 {
        publish(&writer, sequence, IMAGE);
        sequence += 1;
    }
    fill(&others, IMAGE, 20);
    let refused = loop {
        match try_publish(&writer, sequence, IMAGE) {
            Ok(()) => sequence += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(refused, PublishError::Blocked { .. }), "{refused}");
    for taken in 0..200 {
        assert_eq!(take(&mut reader), Some(taken), "nothing of it is lost");
        while try_publish(&writer, sequence, IMAGE).is_ok() {
            sequence += 1;
        }
    }
}

#[test]
fn memory_that_is_not_in_use_goes_to_those_that_were_refused_some() {
    let (a, b) = (session(), session());
    let budget = MemoryBudget::new(MOST);
    let idle = ring(&a, 1, Qos::default(), &budget);
    let mut reader = attach(&idle, &a, &b, Qos::default());
    for sequence in 0..10 {
        publish(&idle, sequence, IMAGE);
    }
    while take(&mut reader).is_some() {}
    let now = Instant::now();
    idle.reclaim_idle(now);
    let kept = budget.held();
    assert!(kept > 0, "it may need it again");
    let others: Vec<_> =
        (2..12).map(|n| ring(&a, n, transient(Qos::keep_all()), &budget)).collect();
    fill(&others, IMAGE, 20);
    let full = budget.held();
    assert!(now + IDLE > Instant::now());
    idle.reclaim_idle(now);
    assert!(budget.held() < full, "{} of {full}", budget.held());
    assert_eq!(fill(&others[..1], IMAGE, 0), 0);
}
