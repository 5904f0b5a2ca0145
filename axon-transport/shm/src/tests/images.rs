//! Images at depth one beside other topics, at AXON's default sizes.

use std::{collections::VecDeque, thread};

use super::*;
use crate::qos::Reliability;

/// The defaults of `AXON_RING_BUFFER_SIZE_MB` and `AXON_MAX_MESSAGE_MB`.
const BUDGET: u64 = 64 << 20;
const MAX_MESSAGE: u64 = 256 << 20;

/// The most images that a reader keeps while it takes the next.
const KEPT: usize = 2;

fn create(session: &Arc<SessionSegment>, number: u32, qos: Qos) -> Writer {
    let gid = Gid::new(session.id(), number);
    let options = RingOptions { gid, qos, budget: BUDGET, max_message: MAX_MESSAGE, expected: 0 };
    Writer::create(session.clone(), options).unwrap()
}

fn attach_whole(
    writer: &Writer,
    publisher: &Arc<SessionSegment>,
    reader: &Arc<SessionSegment>,
    qos: Qos,
) -> Reader {
    let mut reader = attach(writer, publisher, reader, qos);
    reader.expect(writer.options().max_message);
    reader
}

/// Returns an image in which each part identifies it.
fn image(canvas: &[u8], sequence: u64) -> Vec<u8> {
    let mut image = canvas.to_vec();
    for line in image.chunks_exact_mut(3840) {
        line[..8].copy_from_slice(&sequence.to_le_bytes());
    }
    image
}

fn check(sample: &Sample, canvas: &[u8], out: &mut Vec<u8>) {
    sample.copy_to(out).unwrap();
    assert!(*out == image(canvas, sample.meta().sequence), "an image is torn");
}

/// Publishes images of `len` bytes to `count` readers in several sessions. Each reader has a
/// thread, keeps some images and takes the newest. Other topics of the same session go on.
fn stream(count: usize, len: usize, total: u64, reliability: Reliability) {
    let qos = Qos { reliability, ..keep_last(1) };
    let a = session();
    let others = [session(), session(), session(), a.clone()];
    let images = create(&a, 1, qos);
    let (scans, poses) = (create(&a, 2, keep_last(10)), create(&a, 3, keep_last(10)));
    let (mut scan, mut pose) = (
        attach(&scans, &a, &others[0], keep_last(10)),
        attach(&poses, &a, &others[1], keep_last(10)),
    );
    let canvas = pattern(7, len);
    thread::scope(|scope| {
        for index in 0..count {
            let home = &others[index % others.len()];
            let mut reader = attach_whole(&images, &a, home, qos);
            let canvas = &canvas;
            scope.spawn(move || {
                let mut kept = VecDeque::new();
                let (mut last, mut out) = (None, Vec::new());
                while last != Some(total - 1) {
                    await_data(home, &reader);
                    let Some(sample) = reader.take_sample().unwrap() else { continue };
                    assert!(sample.is_borrowed() && last < Some(sample.meta().sequence));
                    last = Some(sample.meta().sequence);
                    check(&sample, canvas, &mut out);
                    kept.push_back(sample);
                    if kept.len() > KEPT.min(index) {
                        check(&kept.pop_front().expect("one"), canvas, &mut out);
                    }
                }
                kept.iter().for_each(|sample| check(sample, canvas, &mut out));
                let counts = (reader.lost(), reader.received() + reader.skipped());
                assert_eq!(counts, (0, total), "the last is never lost");
            });
        }
        let publish = |writer: &Writer, sequence, payload: &[u8]| {
            writer.publish(meta(sequence), payload).unwrap();
        };
        for sequence in 0..total {
            publish(&images, sequence, &image(&canvas, sequence));
            publish(&scans, sequence, &pattern(sequence, 40_000));
            publish(&poses, sequence, &pattern(sequence, 300));
        }
    });
    let mut out = Vec::new();
    for sequence in total - 10..total {
        for reader in [&mut scan, &mut pose] {
            assert_eq!(reader.take(&mut out).unwrap().unwrap().meta, meta(sequence));
            assert!(out == pattern(sequence, out.len()));
        }
    }
    assert_eq!((scan.lost(), pose.lost()), (0, 0));
}

fn both(count: usize, len: usize, total: u64) {
    stream(count, len, total, Reliability::Reliable);
    stream(count, len, total, Reliability::BestEffort);
}

/// A colour image of 3840 by 2160 pixels.
const FOUR_K: usize = 3840 * 2160 * 3;

#[test]
fn a_4k_image_at_depth_one_has_room_in_the_usual_history_for_one_reader() {
    both(1, FOUR_K, 12);
}

#[test]
fn a_4k_image_at_depth_one_has_room_in_the_usual_history_for_two_readers() {
    both(2, FOUR_K, 12);
}

#[test]
fn images_at_depth_one_have_room_for_sixteen_readers() {
    both(16, FOUR_K / 12, 30);
}

#[test]
fn images_at_depth_one_have_room_for_sixty_four_readers() {
    both(64, FOUR_K / 96, 60);
}
