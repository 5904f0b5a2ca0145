//! Samples that readers keep in place, with readers that come and go in any order.

#![allow(unsafe_code)]

use std::{
    io::{Read as _, Seek as _, SeekFrom, Write as _},
    thread,
    time::Duration,
};

use super::*;
use crate::{
    ring::pins::RECORDS,
    writer::{Numbering, PublishDeadline},
};

const LARGE: usize = 10_000;

fn publish(writer: &Writer, sequence: u64, len: usize) {
    writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
}

fn take(reader: &mut Reader) -> Sample {
    reader.take_sample().unwrap().expect("a sample")
}

fn intact(sample: &Sample) {
    let sequence = sample.meta().sequence;
    assert_eq!(sample.meta(), meta(sequence));
    let mut bytes = Vec::new();
    sample.copy_to(&mut bytes).unwrap();
    assert!(bytes == pattern(sequence, sample.len()), "sample {sequence} changed");
}

/// Returns the number of samples that the publisher has given up and whose memory it has not
/// reused.
fn retired(writer: &Writer) -> usize {
    writer.lock().history.pinned().retired().len()
}

fn pin_lanes(writer: &Writer) -> usize {
    writer.lock().reader_set.pin_lanes()
}

#[test]
fn a_sample_in_use_stays_while_the_ring_goes_round() {
    let (a, b) = (session(), session());
    for other in [&a, &b] {
        let writer = writer(&a, keep_last(1), 0);
        let mut reader = attach(&writer, &a, other, keep_last(1));
        for len in [LARGE, 4097, 65_536, MAX as usize] {
            publish(&writer, 0, len);
            let sample = take(&mut reader);
            assert!(sample.is_borrowed() && sample.len() == len);
            for sequence in 1..160 {
                publish(&writer, sequence, len);
            }
            intact(&sample);
            assert!(retired(&writer) <= 2, "what is pinned, and the last that was given up");
            drop(sample);
            publish(&writer, 160, len);
            publish(&writer, 161, len);
            assert!(retired(&writer) <= 1);
            intact(&take(&mut reader));
        }
    }
}

#[test]
fn small_samples_are_copies() {
    let a = session();
    let writer = writer(&a, keep_last(10), 1 << 20);
    let mut reader = attach(&writer, &a, &a, keep_last(10));
    for (sequence, len) in [0, 1, 96, 97, 4096].into_iter().enumerate() {
        publish(&writer, sequence as u64, len);
        let sample = take(&mut reader);
        assert_eq!((sample.is_borrowed(), sample.len()), (false, len));
        intact(&sample);
    }
    publish(&writer, 9, 4097);
    let copy = reader.take_copy().unwrap().unwrap();
    assert!(!copy.is_borrowed());
    intact(&copy);
}

#[test]
fn expected_long_samples_lower_the_limit_of_in_place_loans() {
    let (a, b) = (session(), session());
    let gid = Gid::new(a.id(), 1);
    let options =
        RingOptions { gid, qos: keep_last(10), budget: 1 << 20, max_message: MAX, expected: 513 };
    let writer = Writer::create(a.clone(), options).unwrap();
    let mut readers = [&a, &b].map(|session| attach(&writer, &a, session, keep_last(10)));
    let lens = [0, 96, 512, 513, 4096, 4097].map(|len| [(len, true), (len, false)]);
    for (sequence, (len, loaned)) in lens.into_iter().flatten().enumerate() {
        let meta = meta(sequence as u64);
        let bytes = pattern(meta.sequence, len);
        if loaned {
            let mut loan = writer.loan(len).unwrap();
            loan.copy_from_slice(&bytes);
            loan.publish(meta).unwrap();
        } else {
            writer.publish(meta, &bytes).unwrap();
        }
        let mut copy = Vec::new();
        readers[0].take(&mut copy).unwrap().unwrap();
        assert_eq!(copy, bytes);
        let sample = take(&mut readers[1]);
        let longest = if loaned { 512 } else { 4096 };
        assert_eq!((sample.is_borrowed(), sample.len()), (len > longest, len));
        intact(&sample);
    }
}

#[test]
fn bytes_after_a_header_are_aligned_for_writer_and_readers() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(2), 0);
    let mut readers = [&a, &b].map(|session| attach(&writer, &a, session, keep_last(2)));
    let lens = [0, 1, 16, 500, 4096, 4097, 60_000, MAX as usize];
    let headers = [0, 1, 4, 8, 15, 16, 17, usize::MAX];
    let cases = lens.into_iter().flat_map(|len| headers.map(|header| (header, len)));
    for (sequence, (header, len)) in cases.enumerate() {
        let aligned = |at: *const u8| at.addr().wrapping_add(header).is_multiple_of(16);
        let bytes = pattern(sequence as u64, len);
        let mut loan = writer.loan_behind(header, len).unwrap();
        assert!(aligned(loan.as_ptr()) && loan.len() == len, "{header} {len}");
        loan.copy_from_slice(&bytes);
        loan.publish(meta(sequence as u64)).unwrap();

        let sample = take(&mut readers[0]);
        assert_eq!((sample.is_borrowed(), sample.len()), (len > 4096, len));
        assert!(!sample.is_borrowed() || aligned(sample.as_ptr()), "{header} {len}");
        intact(&sample);
        let mut part = vec![0; 40];
        let at = len / 3;
        let count = sample.read_at(at, &mut part);
        assert_eq!(part[..count], bytes[at..][..count]);
        assert_eq!(count, 40.min(len - at));
        // SAFETY: the writer belongs to this test, and does not write to pinned samples.
        assert_eq!(unsafe { sample.as_slice() }, bytes);
        assert_eq!(sample.read_at(len, &mut part) + sample.read_at(usize::MAX, &mut part), 0);
        let mut copy = Vec::new();
        readers[1].take(&mut copy).unwrap().unwrap();
        assert_eq!(copy, bytes);
    }
    // Dropping a loan releases as many bytes as were lent.
    (0..100).for_each(|_| drop(writer.loan_behind(4, MAX as usize).unwrap()));
}

#[test]
fn a_slot_longer_than_its_sample_is_kept_as_long() {
    let (a, b) = (session(), session());
    for (header, lent) in [(4, MAX as usize), (0, MAX as usize), (0, MAX as usize / 2)] {
        let writer = writer(&a, keep_last(1), 0);
        let mut readers: Vec<_> = (0..20).map(|_| attach(&writer, &a, &b, keep_last(1))).collect();
        let publish = |sequence: u64, len: usize| {
            let mut loan = writer.loan_behind(header, lent).unwrap();
            loan[..len].copy_from_slice(&pattern(sequence, len));
            let patience = PublishDeadline::new(Duration::ZERO);
            loan.commit(len, Numbering::Given(meta(sequence)), patience).unwrap();
        };
        // Each later reader may pin only shorter samples.
        let mut kept = 0;
        for (reader, len) in (0..20).flat_map(|at| (13..21).map(move |power| (at, 1 << power))) {
            let reader: &mut Reader = &mut readers[reader];
            let len = lent.min(len);
            publish(1, len);
            let sample = take(reader);
            kept += usize::from(sample.is_borrowed());
            (2..6).for_each(|sequence| publish(sequence, len));
            intact(&sample);
            while reader.take_copy().unwrap().is_some() {}
        }
        assert!(kept > 20, "{kept}");
    }
}

#[test]
fn nothing_that_ends_ends_a_sample_in_use() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    publish(&writer, 0, LARGE);
    let sample = take(&mut reader);
    let (lane, gid) = (reader.lane(), writer.readers()[0]);

    // The daemon, or another caller of `detach`, detaches the reader.
    assert!(writer.detach(gid));
    (1..50).for_each(|sequence| publish(&writer, sequence, LARGE));
    intact(&sample);
    // The subscription ends, and with it its session.
    drop(reader);
    assert_ne!(b.allocate_lane().unwrap().location(), lane, "the lane is in use");
    drop(b);
    (50..100).for_each(|sequence| publish(&writer, sequence, LARGE));
    intact(&sample);
    assert_eq!(pin_lanes(&writer), 1);
    // The publisher ends.
    drop(writer);
    intact(&sample);
}

#[test]
fn a_dropped_sample_and_reader_release_their_pins() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    publish(&writer, 0, LARGE);
    let sample = take(&mut reader);
    let lane = reader.lane();
    drop(reader);
    drop(sample);
    assert_eq!(b.allocate_lane().unwrap().location(), lane, "the lane is free again");
    (1..4).for_each(|sequence| publish(&writer, sequence, LARGE));
    assert_eq!(pin_lanes(&writer), 0);
    assert!(retired(&writer) <= 1);
}

#[test]
fn the_sixth_sample_in_use_is_a_copy() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &a, keep_last(1));
    let mut kept: Vec<_> = (0..8)
        .map(|sequence| {
            publish(&writer, sequence, LARGE);
            take(&mut reader)
        })
        .collect();
    let borrowed: Vec<_> = kept.iter().map(Sample::is_borrowed).collect();
    assert_eq!(borrowed, [true, true, true, true, true, false, false, false]);
    kept.iter().for_each(intact);
    kept.remove(2);
    publish(&writer, 8, LARGE);
    assert!(take(&mut reader).is_borrowed());
    kept.iter().for_each(intact);
}

#[test]
fn samples_in_use_hold_no_publisher() {
    let (a, b) = (session(), session());
    // The depth is one, and the samples are the largest.
    let last = writer(&a, keep_last(1), 0);
    let mut reader = attach(&last, &a, &b, keep_last(1));
    let mut other = attach(&last, &a, &b, keep_last(1));
    let mut kept = Vec::new();
    for sequence in 0..5 {
        publish(&last, sequence, MAX as usize);
        kept.push(take(&mut reader));
    }
    for sequence in 5..20 {
        last.try_publish(meta(sequence), &pattern(sequence, MAX as usize)).unwrap();
        intact(&take(&mut other));
    }
    kept.iter().for_each(intact);
    // With KEEP_ALL, a sample that was taken holds nobody up.
    let all = writer(&a, Qos::keep_all(), 4 * LARGE as u64);
    let mut reader = attach(&all, &a, &b, Qos::keep_all());
    let mut kept = Vec::new();
    for sequence in 0..100 {
        all.try_publish(meta(sequence), &pattern(sequence, LARGE)).unwrap();
        kept.push(take(&mut reader));
    }
    kept.iter().for_each(intact);
    assert_eq!((reader.received(), reader.lost(), reader.skipped()), (100, 0, 0));
}

#[test]
fn memory_that_readers_keep_is_named_and_comes_back() {
    const LEN: usize = 1 << 16;
    // Readers in the publisher's own session may pin everything.
    let a = session();
    let (gid, max_message) = (Gid::new(a.id(), 1), LEN as u64);
    let options = RingOptions { gid, qos: keep_last(1), budget: 0, max_message, expected: 0 };
    let writer = Writer::create(a.clone(), options).unwrap();
    let mut readers: Vec<_> = (0..60).map(|_| attach(&writer, &a, &a, keep_last(1))).collect();
    let mut kept = Vec::new();
    let mut sequence = 0;
    let mut error = None;
    'full: for reader in &mut readers {
        for _ in 0..5 {
            match writer.publish(meta(sequence), &pattern(sequence, LEN)) {
                Ok(_) => kept.push(take(reader)),
                Err(refused) => {
                    error = Some(refused);
                    break 'full;
                }
            }
            sequence += 1;
        }
    }
    let error = error.expect("an end of memory");
    let PublishError::Pinned { keeper } = error else { panic!("{error}") };
    assert!(writer.readers().contains(&keeper.reader) && keeper.samples >= 40, "{keeper}");
    let named = format!("reader {} (pid {}) holds", keeper.reader, std::process::id());
    assert!(error.to_string().contains(&named), "{error}");
    kept.iter().for_each(intact);
    // Small samples need none of this memory.
    publish(&writer, sequence, 4096);
    kept.clear();
    publish(&writer, sequence + 1, LEN);
}

#[test]
fn pins_of_other_processes_leave_room_for_the_publisher() {
    const LEN: usize = 1 << 16;
    let (a, b) = (session(), session());
    let (gid, max_message) = (Gid::new(a.id(), 1), LEN as u64);
    let options = RingOptions { gid, qos: keep_last(1), budget: 0, max_message, expected: 0 };
    let writer = Writer::create(a.clone(), options).unwrap();
    // One half of the readers keeps to the protocol and pins as much as it may; the other half pins
    // everything.
    let pair = || [(); 2].map(|()| attach(&writer, &a, &b, keep_last(1))).into();
    let (mut readers, hostile): (Vec<_>, Vec<_>) = (0..100).map(|_| -> (_, _) { pair() }).unzip();
    let view = peer(&b, &b);
    let lanes: Vec<_> = hostile.iter().map(|reader| view.lane(reader.lane()).unwrap()).collect();
    let mut kept = Vec::new();
    for sequence in 0..600u64 {
        let len = if sequence % 3 == 0 { LEN } else { 5000 + 97 * sequence as usize };
        publish(&writer, sequence, len);
        let pins = &lanes[sequence as usize / 6].words()[layout::lane::PINS..];
        pins[sequence as usize % 6].store(sequence + 1, Relaxed);
        if sequence < 500 {
            kept.push(take(&mut readers[sequence as usize / 5]));
        }
    }
    kept.iter().for_each(intact);
    assert!(kept[..5].iter().all(Sample::is_borrowed), "the first keeps what it likes");
    assert!(!kept.iter().all(Sample::is_borrowed));
}

#[test]
fn a_sample_that_may_not_be_pinned_is_copied_whole_or_not_at_all() {
    const LEN: usize = MAX as usize;
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    // Created in advance, so that the publisher is faster than the reader.
    let payloads: Vec<_> = (0..4).map(|number| pattern(number, LEN)).collect();
    let payload = |sequence: u64| &payloads[sequence as usize % 4];
    let _others = [(); 2].map(|()| attach(&writer, &a, &b, keep_last(1)));
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    let total = 3000;
    thread::scope(|scope| {
        scope.spawn(|| {
            for sequence in 0..total {
                writer.publish(meta(sequence), payload(sequence)).unwrap();
            }
        });
        let mut bytes = Vec::new();
        let mut last = None;
        while last != Some(total - 1) {
            await_data(&b, &reader);
            let Some(sample) = reader.take_sample().unwrap() else { continue };
            assert!(!sample.is_borrowed());
            sample.copy_to(&mut bytes).unwrap();
            let sequence = sample.meta().sequence;
            assert!(bytes == *payload(sequence), "sample {sequence} is torn");
            last = Some(sequence);
        }
    });
    assert_eq!(reader.received() + reader.skipped() + reader.lost(), total);
}

#[test]
fn a_sample_may_end_on_any_thread() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(4), 4 * LARGE as u64);
    let mut reader = attach(&writer, &a, &b, keep_last(4));
    let (send, receive) = std::sync::mpsc::sync_channel::<Sample>(3);
    let receive = Mutex::new(receive);
    let total = 4000;
    thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Ok(sample) = { receive.lock().unwrap().recv() } {
                    intact(&sample);
                }
            });
        }
        scope.spawn(|| (0..total).for_each(|sequence| publish(&writer, sequence, LARGE)));
        let mut last = None;
        while last != Some(total - 1) {
            await_data(&b, &reader);
            let Some(sample) = reader.take_sample().unwrap() else { continue };
            let sequence = Some(sample.meta().sequence);
            assert!(last < sequence, "in order");
            last = sequence;
            send.send(sample).unwrap();
        }
        drop(send);
    });
    assert_eq!(reader.received() + reader.skipped() + reader.lost(), total);
    for sequence in total..total + 3 {
        publish(&writer, sequence, LARGE);
    }
    assert!(retired(&writer) <= 1, "all pins were given back");
}

#[test]
fn a_sample_is_read_from_anywhere() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &a, keep_last(1));
    for len in [100, LARGE + 3] {
        publish(&writer, 7, len);
        let (sample, expected) = (take(&mut reader), pattern(7, len));
        for at in (0..20).chain(len - 20..len + 3) {
            for count in 0..20 {
                let mut out = vec![0; count];
                let got = sample.read_at(at, &mut out);
                assert_eq!(got, count.min(len.saturating_sub(at)));
                assert_eq!(out[..got], expected[at.min(len)..][..got]);
            }
        }
        let mut stream = sample.reader();
        stream.seek(SeekFrom::End(-5)).unwrap();
        let mut out = Vec::new();
        stream.read_to_end(&mut out).unwrap();
        assert_eq!(out, expected[len - 5..]);
        assert!(stream.seek(SeekFrom::Current(-1 - len as i64)).is_err());
        // SAFETY: the publisher is this test, and no child is forked.
        assert!(unsafe { sample.as_slice() } == expected);
    }
}

#[test]
fn a_loan_is_a_slice_of_the_ring() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &a, keep_last(1));
    for len in [0, 50, 1000, LARGE] {
        let mut loan = writer.loan(len).unwrap();
        loan.copy_from_slice(&pattern(3, len));
        loan.publish(meta(3)).unwrap();
        intact(&take(&mut reader));
    }
    let mut half = writer.loan(LARGE).unwrap();
    half.write_all(&[0; LARGE - 1]).unwrap();
    let (len, written) = (LARGE as u64, LARGE as u64 - 1);
    assert_eq!(half.publish(meta(4)), Err(PublishError::Incomplete { len, written }));
    assert!(reader.take_sample().unwrap().is_none());
}

#[test]
fn corrupted_pins_keep_six_samples_at_most() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let reader = attach(&writer, &a, &b, keep_last(1));
    let lane = peer(&b, &b).lane(reader.lane()).unwrap();
    let pins = &lane.words()[layout::lane::PINS..][..RECORDS];
    for sequence in 0..300u64 {
        for (record, pin) in pins.iter().enumerate() {
            let absurd = [0, u64::MAX, 1 << 63, sequence + 1, sequence, 1];
            pin.store(absurd[(record + sequence as usize) % 6], Relaxed);
        }
        publish(&writer, sequence, LARGE);
        assert!(retired(&writer) <= RECORDS + 1);
    }
    pins.iter().enumerate().for_each(|(n, pin)| pin.store(290 + n as u64, Relaxed));
    (300..400).for_each(|sequence| publish(&writer, sequence, LARGE));
    assert!(retired(&writer) <= RECORDS + 1);
}

#[test]
fn a_lane_that_passes_on_unseen_is_another_attachment() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let lane = b.allocate_lane().unwrap();
    let info = ReaderInfo {
        gid: Gid::new(b.id(), 1),
        lane: lane.location(),
        qos: Qos::keep_all(),
        peer: peer(&a, &b),
        stands_for: None,
    };
    let before = writer.attach(info.clone()).unwrap();
    publish(&writer, 0, 10);
    // The lane is opened, closed and given to the next reader before the publisher reads it.
    lane.open(before, info.gid);
    drop(lane);
    let lane = b.allocate_lane().unwrap();
    assert_eq!(lane.location(), info.lane);
    let after = writer.attach(info).unwrap();
    assert_ne!(before.generation, after.generation);
    assert_eq!((before.first, after.first), (0, 1));
    assert_eq!(writer.readers().len(), 1);
}

#[test]
fn asking_for_ever_takes_no_memory() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let lanes: Vec<_> = (0..3).map(|_| b.allocate_lane().unwrap()).collect();
    let mut grants = Vec::new();
    for round in 0..300 {
        let info = ReaderInfo {
            gid: Gid::new(b.id(), 1),
            lane: lanes[round % 3].location(),
            qos: keep_last(1),
            peer: peer(&a, &b),
            stands_for: None,
        };
        grants.push(writer.attach(info).unwrap());
        assert!(writer.detach(Gid::new(b.id(), 1)));
    }
    assert_eq!(pin_lanes(&writer), 3);
    assert_eq!(grants[0], grants[297]);
    drop(lanes);
    assert!(writer.drop_dead().is_empty());
    assert_eq!(pin_lanes(&writer), 0);
}
