//! Both ends in one process, in one session and in two.

mod activity;

use std::{
    io::Write as _,
    sync::atomic::{AtomicU64, Ordering},
};

use super::*;

#[test]
fn each_length_arrives_as_it_was_sent() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(10), 1 << 20);
    for other in [&a, &b] {
        let mut reader = attach(&writer, &a, other, keep_last(1));
        for (sequence, len) in lengths().into_iter().enumerate() {
            let sequence = sequence as u64;
            let payload = pattern(sequence, len);
            writer.publish(meta(sequence), &payload).unwrap();
            assert!(reader.has_data());
            assert_eq!(reader.peek().unwrap(), Some(meta(sequence)));
            assert_eq!(take(&mut reader), Some((sequence, payload)));
            assert_eq!(take(&mut reader), None);
        }
    }
}

#[test]
fn a_loan_written_in_pieces_delivers_the_written_bytes() {
    let a = session();
    let writer = writer(&a, keep_last(10), 1 << 20);
    let mut reader = attach(&writer, &a, &a, keep_last(10));
    for len in [0, 1, 96, 97, 1000, 4097] {
        for piece in [1, 3, 8, 13, 5000] {
            let payload = pattern(len as u64, len);
            let mut loan = writer.loan(len).unwrap();
            for bytes in payload.chunks(piece) {
                loan.write_all(bytes).unwrap();
            }
            assert_eq!(loan.write(b"more").unwrap(), 0);
            loan.publish(meta(5)).unwrap();
            assert_eq!(take(&mut reader), Some((5, payload)));
        }
    }
    let mut half = writer.loan(200).unwrap();
    half.write_all(&[0; 199]).unwrap();
    let error = half.publish(meta(6)).unwrap_err();
    assert_eq!(error, PublishError::Incomplete { len: 200, written: 199 });
    assert_eq!(take(&mut reader), None);
}

#[test]
fn loans_that_are_kept_end_in_an_error_and_come_back() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let mut loans = Vec::new();
    let error = loop {
        match writer.loan(MAX as usize) {
            Ok(loan) => loans.push(loan),
            Err(error) => break error,
        }
    };
    assert_eq!(error, PublishError::Loaned { loans: loans.len() as u32 });
    loans.clear();
    writer.publish(meta(1), &pattern(1, MAX as usize)).unwrap();
}

#[test]
fn samples_beyond_the_maximum_length_are_refused() {
    let a = session();
    let writer = writer(&a, keep_last(1), 0);
    let (len, max) = (MAX + 1, MAX);
    let long = vec![0; len as usize];
    assert_eq!(writer.publish(meta(1), &long), Err(PublishError::TooLarge { len, max }));
    assert!(writer.loan(long.len()).is_err());
    for (budget, max_message) in [(u64::MAX, 1), (0, 1 << 32), (0, u64::MAX), (1 << 40, 1)] {
        let gid = writer.gid();
        let options = RingOptions { gid, qos: Qos::default(), budget, max_message, expected: 0 };
        let refused = Writer::create(a.clone(), options);
        assert!(matches!(refused, Err(ShmError::TooLarge { .. })));
    }
}

#[test]
fn the_largest_sample_fits_at_depth_one_with_any_budget() {
    let (a, b) = (session(), session());
    let gid = Gid::new(a.id(), 1);
    let max_message = 25_000_000;
    let options = RingOptions { gid, qos: keep_last(1), budget: 1 << 20, max_message, expected: 0 };
    let writer = Writer::create(a.clone(), options).unwrap();
    let lane = b.allocate_lane().unwrap();
    let info = ReaderInfo {
        gid: Gid::new(b.id(), 1),
        lane: lane.location(),
        qos: keep_last(1),
        peer: peer(&a, &b),
        stands_for: None,
    };
    let grant = writer.attach(info).unwrap();
    let options = ReaderOptions {
        reader: Gid::new(b.id(), 1),
        writer: gid,
        peer: peer(&b, &a),
        ring: writer.location(),
        lane,
        grant,
        qos: keep_last(1),
        max_message,
    };
    let mut reader = Reader::map(options).unwrap();
    for sequence in 0..3 {
        let payload = pattern(sequence, 25_000_000);
        writer.publish(meta(sequence), &payload).unwrap();
        assert!(take(&mut reader) == Some((sequence, payload)));
    }
}

#[test]
fn skipping_to_the_own_depth_is_no_loss() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(5), 1 << 20);
    let mut reader = attach(&writer, &a, &b, keep_last(3));
    for sequence in 0..5000 {
        writer.publish(meta(sequence), &pattern(sequence, 200)).unwrap();
    }
    assert_eq!(reader.unread(), 3);
    for sequence in 4997..5000 {
        assert_eq!(take(&mut reader).unwrap().0, sequence);
    }
    assert_eq!(take(&mut reader), None);
    assert_eq!((reader.received(), reader.skipped(), reader.lost()), (3, 4997, 0));
}

#[test]
fn a_reader_deeper_than_the_publisher_widens_its_window() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 1 << 20);
    let mut reader = attach(&writer, &a, &b, keep_last(100));
    for sequence in 0..250 {
        writer.publish(meta(sequence), &pattern(sequence, 100)).unwrap();
    }
    for sequence in 150..250 {
        assert_eq!(take(&mut reader).unwrap().0, sequence);
    }
    assert_eq!((reader.received(), reader.skipped(), reader.lost()), (100, 150, 0));
}

#[test]
fn samples_beyond_the_budget_are_counted_as_lost() {
    let (a, b) = (session(), session());
    // The budget holds eight samples of 4 KiB; the window would hold 50.
    let writer = writer(&a, keep_last(50), 8 * 4096);
    let mut reader = attach(&writer, &a, &b, keep_last(50));
    for sequence in 0..100 {
        writer.publish(meta(sequence), &pattern(sequence, 4096)).unwrap();
    }
    for sequence in 92..100 {
        assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 4096))));
    }
    assert_eq!((reader.received(), reader.skipped(), reader.lost()), (8, 50, 42));
}

#[test]
fn a_reader_of_the_same_session_never_holds_the_publisher() {
    let a = session();
    let writer = writer(&a, Qos::keep_all(), 16 * 1024);
    let mut reader = attach(&writer, &a, &a, Qos::keep_all());
    for sequence in 0..100 {
        writer.try_publish(meta(sequence), &pattern(sequence, 1024)).unwrap();
    }
    for sequence in 84..100 {
        assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 1024))));
    }
    assert_eq!((reader.received(), reader.lost()), (16, 84));
}

#[test]
fn keep_all_holds_the_publisher_until_a_sample_is_taken() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 16 * 1024);
    let mut lagging = attach(&writer, &a, &b, Qos::keep_all());
    let mut paused = attach(&writer, &a, &b, keep_last(10));
    let mut sequence = 0;
    let error = loop {
        match writer.try_publish(meta(sequence), &pattern(sequence, 1024)) {
            Ok(published) => assert_eq!(published.position, Some(sequence)),
            Err(error) => break error,
        }
        sequence += 1;
    };
    assert_eq!((sequence, matches!(error, PublishError::Blocked { .. })), (16, true));
    assert!(matches!(
        writer.publish(meta(sequence), &pattern(sequence, 1024)),
        Err(PublishError::Blocked { .. })
    ));
    for expected in 0..100 {
        assert_eq!(take(&mut lagging), Some((expected, pattern(expected, 1024))));
        writer.try_publish(meta(sequence), &pattern(sequence, 1024)).unwrap();
        sequence += 1;
    }
    assert_eq!(lagging.lost(), 0);
    // The other reader did not hold up the publisher, and loses nothing within its depth.
    assert_eq!(take(&mut paused).unwrap().0, sequence - 10);
    // A reader that has left does not hold up the publisher.
    drop(lagging);
    writer.try_publish(meta(sequence), &pattern(sequence, 1024)).unwrap();
}

#[test]
fn a_blocked_publish_goes_on_when_the_reader_does() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 4096);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for sequence in 0..2000 {
                let payload = pattern(sequence, 1024);
                let mut attempt = || writer.try_publish(meta(sequence), &payload).is_ok();
                woken(|| a.wait_for_room(&mut attempt, &[], EVER));
            }
        });
        for sequence in 0..2000 {
            await_data(&b, &reader);
            assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 1024))));
        }
    });
    assert_eq!(reader.lost(), 0);
}

#[test]
fn a_late_joiner_gets_the_history_that_both_want() {
    let (a, b) = (session(), session());
    let publisher = writer(&a, transient(keep_last(5)), 1 << 20);
    for sequence in 0..100 {
        publisher.publish(meta(sequence), &pattern(sequence, 300)).unwrap();
    }
    let firsts = [
        (transient(keep_last(10)), 95),
        (transient(keep_last(3)), 97),
        (transient(Qos::keep_all()), 95),
        (keep_last(10), 100),
    ];
    for (qos, first) in firsts {
        let mut reader = attach(&publisher, &a, &b, qos);
        for sequence in first..100 {
            assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 300))));
        }
        assert_eq!((take(&mut reader), reader.lost(), reader.skipped()), (None, 0, 0));
        assert!(publisher.detach(publisher.readers()[0]));
    }

    let all = writer(&a, transient(Qos::keep_all()), 1 << 20);
    for sequence in 0..3000 {
        all.publish(meta(sequence), &pattern(sequence, 50)).unwrap();
    }
    let mut reader = attach(&all, &a, &b, transient(Qos::keep_all()));
    for sequence in 0..3000 {
        assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 50))));
    }
}

#[test]
fn attaching_again_changes_only_the_subscriptions_a_relay_represents() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(5), 1 << 20);
    let relayed: Vec<_> = (0..3).map(|number| Gid::new(SessionId::random(), number)).collect();
    let lanes = [b.allocate_lane().unwrap(), b.allocate_lane().unwrap()];
    let mut info = ReaderInfo {
        gid: Gid::new(b.id(), 9),
        lane: lanes[0].location(),
        qos: keep_last(5),
        peer: peer(&a, &b),
        stands_for: None,
    };
    assert!(!writer.has_readers());
    let grant = writer.attach(info.clone()).unwrap();
    assert_eq!((writer.readers(), writer.reader_count()), (vec![info.gid], 1));
    writer.publish(meta(0), b"x").unwrap();
    info.stands_for = Some(Vec::new());
    assert_eq!(writer.attach(info.clone()).unwrap(), grant);
    assert_eq!((writer.readers(), writer.reader_count()), (vec![], 0), "it stands for nobody");
    info.stands_for = Some(relayed.clone());
    assert_eq!(writer.attach(info.clone()).unwrap(), grant);
    assert_eq!((writer.readers(), writer.reader_count()), (relayed.clone(), relayed.len()));
    // A request with another lane is another attachment.
    info.lane = lanes[1].location();
    let other = writer.attach(info.clone()).unwrap();
    assert_ne!(other.generation, grant.generation);
    assert_eq!((other.first, writer.readers()), (1, relayed));
    assert!(writer.drop_dead().is_empty());
    assert!(writer.detach(info.gid));
    assert!(!writer.detach(info.gid));
    let far = Location { segment: 0, offset: layout::SESSION_BYTES };
    let odd = Location { segment: 0, offset: 5000 };
    let elsewhere = Location { segment: 77, offset: 4096 };
    for lane in [far, odd, elsewhere, Location { segment: 0, offset: 0 }] {
        assert!(writer.attach(ReaderInfo { lane, ..info.clone() }).is_err());
    }
}

#[test]
fn a_reader_that_left_and_comes_back_starts_anew() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let reader = attach(&writer, &a, &b, Qos::keep_all());
    let (lane, grant) = (reader.lane(), reader.grant());
    writer.publish(meta(0), b"x").unwrap();
    drop(reader);
    writer.publish(meta(1), b"x").unwrap();
    let reader = attach(&writer, &a, &b, Qos::keep_all());
    assert_eq!((reader.lane(), reader.grant().first), (lane, 2));
    assert_ne!(reader.grant().generation, grant.generation);
    assert_eq!(writer.readers().len(), 1);
}

#[test]
fn a_stale_lane_grant_is_refused() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 1 << 20);
    let reader = attach(&writer, &a, &b, keep_last(1));
    let (before, grant) = (reader.lane(), reader.grant());
    drop(reader);
    // The publisher has not read the lane since, and could mistake the next reader for the earlier
    // one.
    let lane = b.allocate_lane().unwrap();
    assert_eq!(lane.location(), before);
    let options = ReaderOptions {
        reader: Gid::new(b.id(), 2),
        writer: writer.gid(),
        peer: peer(&b, &a),
        ring: writer.location(),
        lane,
        grant,
        qos: keep_last(1),
        max_message: MAX,
    };
    assert!(matches!(Reader::map(options), Err(ShmError::Refused { .. })));
    assert!(attach(&writer, &a, &b, keep_last(1)).grant() != grant);
}

#[test]
fn lanes_are_reused_and_bounded() {
    let a = session();
    let lanes: Vec<_> = std::iter::from_fn(|| a.allocate_lane().ok()).collect();
    assert_eq!(lanes.len(), layout::LANES as usize);
    assert!(matches!(a.allocate_lane(), Err(ShmError::NoLane { .. })));
    drop(lanes);
    let lane = a.allocate_lane().unwrap();
    assert!(lane.location().offset > 0);
}

#[test]
fn several_threads_publish_into_one_ring() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    std::thread::scope(|scope| {
        for thread in 0..3 {
            let writer = &writer;
            scope.spawn(move || {
                for number in 0..500 {
                    // A number far ahead of the last would be refused.
                    let sequence = thread << 20 | number;
                    let payload = pattern(sequence, 90 + (number % 30) as usize);
                    while writer.publish(meta(sequence), &payload).is_err() {}
                }
            });
        }
        let mut next = [0; 3];
        for _ in 0..1500 {
            await_data(&b, &reader);
            let (sequence, payload) = take(&mut reader).unwrap();
            let thread = (sequence >> 20) as usize;
            assert_eq!(sequence & 0xf_ffff, next[thread], "in order by thread");
            next[thread] += 1;
            assert_eq!(payload, pattern(sequence, payload.len()));
        }
    });
    assert_eq!(reader.lost(), 0);
}

#[test]
fn an_overtaken_reader_never_sees_a_torn_sample() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(1), 0);
    let mut reader = attach(&writer, &a, &b, keep_last(1));
    let total = 3000;
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for sequence in 0..total {
                let len = 500 + (sequence * 997 % 20_000) as usize;
                writer.publish(meta(sequence), &pattern(sequence, len)).unwrap();
            }
        });
        let mut last = None;
        while last != Some(total - 1) {
            await_data(&b, &reader);
            // `None` if the publisher overtook the reader again and again.
            let Some((sequence, payload)) = take(&mut reader) else { continue };
            assert_eq!(payload, pattern(sequence, payload.len()));
            assert!(last < Some(sequence));
            last = Some(sequence);
        }
    });
    assert_eq!(reader.received() + reader.skipped() + reader.lost(), total);
}

#[test]
fn a_ring_reaches_the_one_of_several_waiting_threads_that_it_is_for() {
    let (a, b) = (session(), session());
    let acknowledged = AtomicU64::new(0);
    let (threads, rounds) = (3, 2000);
    let rings: Vec<_> = (0..threads).map(|_| writer(&a, keep_last(1), 1 << 20)).collect();
    std::thread::scope(|scope| {
        for ring in &rings {
            let mut reader = attach(ring, &a, &b, keep_last(1));
            let (a, b, acknowledged) = (&a, &b, &acknowledged);
            scope.spawn(move || {
                for _ in 0..rounds {
                    await_data(b, &reader);
                    let (sequence, _) = take(&mut reader).unwrap();
                    acknowledged.store(sequence, Ordering::Release);
                    a.notify();
                }
            });
        }
        for sequence in 1..=threads * rounds {
            let ring = &rings[(sequence % threads) as usize];
            ring.publish(meta(sequence), b"x").unwrap();
            let ready = || acknowledged.load(Ordering::Acquire) == sequence;
            woken(|| a.wait(ready, Some(EVER)));
        }
    });
}

#[test]
fn a_relay_attached_later_owes_no_earlier_samples() {
    let a = session();
    let writer = writer(&a, keep_last(10), 1 << 20);
    let _reader = attach(&writer, &a, &a, keep_last(10));
    for sequence in 1..=3 {
        writer.publish(meta(sequence), b"before").unwrap();
    }
    let lane = a.allocate_lane().unwrap();
    let gid = Gid::new(a.id(), 99);
    let info = ReaderInfo {
        gid,
        lane: lane.location(),
        qos: keep_last(10),
        peer: RingPeer::Local(a.clone()),
        stands_for: Some(vec![gid]),
    };
    assert_eq!(writer.attach(info).unwrap().first, 3);
    // A waiting thread may still ask with a head from before the relay attached.
    let delivered_up_to = |published| writer.lock().reader_set.delivered_up_to(published);
    assert_eq!([1, 3, 4].map(delivered_up_to), [1, 3, 3]);
}

#[test]
fn a_number_that_no_publisher_can_have_reached_is_refused() {
    let a = session();
    for (before, number) in
        [(None, 1 << 49), (None, u64::MAX), (Some(7), u64::MAX), (Some(7), 1 << 33)]
    {
        let writer = writer(&a, keep_last(10), 1 << 20);
        let mut reader = attach(&writer, &a, &a, keep_last(10));
        if let Some(before) = before {
            writer.publish(meta(before), b"before").unwrap();
            assert_eq!(take(&mut reader), Some((before, b"before".to_vec())));
        }
        for payload in [&b"short"[..], &[0; 10_000]] {
            let error = writer.publish(meta(number), payload).unwrap_err();
            let last = before.unwrap_or(0);
            assert_eq!(error, PublishError::Sequence { sequence: number, last });
        }
        writer.publish(meta(8), b"after").unwrap();
        assert_eq!(take(&mut reader), Some((8, b"after".to_vec())), "the reader goes on");
        assert_eq!(reader.lost(), 0);
    }
}
