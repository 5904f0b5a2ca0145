//! Samples that are taken, skipped or announced together.

use super::*;
#[test]
fn a_reader_that_skips_to_a_depth_takes_the_newest_and_counts_the_others() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(100), 1 << 20);
    let mut reader = attach(&writer, &a, &b, keep_last(100));
    for sequence in 0..50 {
        writer.publish(meta(sequence), &pattern(sequence, 200)).unwrap();
    }
    reader.skip_to_depth(60);
    assert_eq!((reader.unread(), reader.skipped()), (50, 0));
    reader.skip_to_depth(3);
    assert_eq!((reader.unread(), reader.skipped(), reader.lost()), (3, 47, 0));
    for sequence in 47..50 {
        assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 200))));
    }
    reader.skip_to_depth(0);
    assert_eq!((take(&mut reader), reader.received(), reader.skipped()), (None, 3, 47));
}

#[test]
fn samples_that_are_taken_together_stand_one_behind_the_other() {
    let (a, b) = (session(), session());
    let writer = writer(&a, keep_last(100), 1 << 20);
    let mut reader = attach(&writer, &a, &b, keep_last(100));
    // Inline samples, samples in blocks, and samples in slots.
    let lengths = [10, 80, 0, 2000, 300, 9000, 20, 5000];
    for (sequence, len) in lengths.into_iter().enumerate() {
        writer.publish(meta(sequence as u64), &pattern(sequence as u64, len)).unwrap();
    }
    let (mut taken, mut batches) = (0, 0);
    loop {
        let mut out = Vec::new();
        while let Some((next, len)) = reader.take_behind(&mut out, 2390).unwrap() {
            assert_eq!((next.meta, len), (meta(taken), lengths[taken as usize]));
            assert!(out[out.len() - len..] == pattern(taken, len));
            taken += 1;
        }
        if out.is_empty() {
            break;
        }
        assert!(
            out.len() <= 2390 || lengths.contains(&out.len()),
            "more than one beyond the bound"
        );
        batches += 1;
    }
    // 10 + 80 + 0 + 2000 + 300, 9000, 20, 5000.
    assert_eq!((taken, batches, reader.received()), (8, 4, 8));
}

#[test]
fn a_publisher_hears_of_samples_that_are_taken_together_when_it_is_told() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    let mut published = 0;
    while writer.try_publish(meta(published), &pattern(published, 50)).is_ok() {
        published += 1;
    }
    let mut out = Vec::new();
    while reader.take_behind(&mut out, usize::MAX).unwrap().is_some() {}
    assert_eq!((reader.received(), out.len() as u64), (published, 50 * published));
    let blocked = writer.try_publish(meta(published), b"more").unwrap_err();
    assert!(matches!(blocked, PublishError::Blocked { .. }), "{blocked:?}");
    reader.tell_taken();
    writer.try_publish(meta(published), b"more").unwrap();
}

#[test]
fn samples_that_were_published_quietly_wake_a_reader_when_they_are_announced() {
    let (a, b) = (session(), session());
    let writer = writer(&a, Qos::keep_all(), 1 << 20);
    let mut reader = attach(&writer, &a, &b, Qos::keep_all());
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| {
            for sequence in 0..3000 {
                await_data(&b, &reader);
                assert_eq!(take(&mut reader), Some((sequence, pattern(sequence, 50))));
            }
            reader
        });
        for sequence in 0..3000 {
            while writer.try_publish_quietly(meta(sequence), &pattern(sequence, 50)).is_err() {
                writer.announce();
                std::thread::yield_now();
            }
            if sequence % 7 == 0 || sequence == 2999 {
                writer.announce();
            }
        }
        assert_eq!(reader.join().unwrap().received(), 3000);
    });
}
