use rand::{Rng, SeedableRng, rngs::StdRng};

use super::*;

fn asker(flow: FlowId) -> RequestingFlow {
    RequestingFlow { daemon: DaemonId([1; 16]), flow }
}

/// Returns the name of a sample of ten thousand bytes.
fn name(sequence: u64) -> Option<SampleName> {
    let topic = TopicHash([3; 16]);
    Some(SampleName { topic, publisher: Gid([2; 16]), sequence, length: 10_000 })
}

const NOW: Duration = Duration::from_secs(7);

fn text(length: usize) -> Bytes {
    b"a line of a log\n".iter().copied().cycle().take(length).collect::<Vec<_>>().into()
}

/// Returns bytes that no compressor makes shorter.
fn noise(length: usize) -> Bytes {
    let mut bytes = vec![0; length];
    StdRng::seed_from_u64(1).fill_bytes(&mut bytes);
    bytes.into()
}

fn order(number: u64, payload: Bytes) -> CompressionOrder {
    CompressionOrder { number, payload }
}

fn compress(payload: Bytes) -> Option<Bytes> {
    Compressor::new().compress(&order(1, payload), || Duration::ZERO).compressed
}

fn later(number: u64) -> Option<CompressionReply> {
    Some(CompressionReply::Later(number))
}

#[test]
fn compressor_returns_a_frame_only_for_payloads_that_shrink_enough() {
    let mut compressor = Compressor::new();
    for length in [SHORTEST, 100_000, LONGEST] {
        let payload = text(length);
        let answer = compressor.compress(&order(7, payload.clone()), || Duration::ZERO);
        assert_eq!(answer.number, 7);
        let frame = answer.compressed.unwrap();
        assert!(frame.len() < length / 5, "{} of {length}", frame.len());
        assert_eq!(zstd::bulk::decompress(&frame, length).unwrap(), payload);
        assert!(
            compressor.compress(&order(8, noise(length)), || Duration::ZERO).compressed.is_none()
        );
    }
    // A part of it becomes shorter, but less than a tenth of it.
    let mut mixed = noise(100_000).to_vec();
    mixed.extend_from_slice(&text(10_000));
    assert!(compress(mixed.clone().into()).is_none());
    mixed.extend_from_slice(&text(10_000));
    assert!(compress(mixed.into()).is_some());
}

#[test]
fn compression_pays_on_a_slow_link_and_not_on_a_fast_link() {
    let compression = Compression::new();
    // 54 Mbit/s, 1 Gbit/s and 10 Gbit/s.
    let [radio, cable, fast] = [54e6 / 8.0, 125e6, 1.25e9];
    assert!(compression.pays(64 << 10, radio, NOW));
    assert!(!compression.pays(64 << 10, cable, NOW) && !compression.pays(64 << 10, fast, NOW));
    // A short sample takes longer to the thread and back than it saves.
    assert!(!compression.pays(2_000, radio, NOW) && compression.pays(2_000, 1e6, NOW));
    assert!(!compression.pays(SHORTEST - 1, 1.0, NOW) && !compression.pays(LONGEST + 1, 1.0, NOW));
}

#[test]
fn the_speed_of_the_compressor_counts() {
    let compression = Compression::new();
    let run = |speed: f64| {
        for _ in 0..40 {
            let payload = text(1 << 20);
            let Some(CompressionReply::Later(number)) = compression.ask(asker(1), None, &payload)
            else {
                panic!("too much is being compressed")
            };
            let took = Duration::from_secs_f64(payload.len() as f64 / speed);
            let answer = CompressionAnswer { number, compressed: None, took };
            assert_eq!(compression.handle_answer(NOW, &answer), [asker(1)]);
        }
    };
    run(1e9);
    assert!(compression.pays(1 << 20, 250e6, NOW));
    run(1e7);
    assert!(!compression.pays(1 << 20, 54e6 / 8.0, NOW));
    // The compressor may have been held up.
    let later = NOW + TRIED_AGAIN;
    assert!(!compression.pays(1 << 20, 54e6 / 8.0, later));
    assert!(compression.pays(1 << 20, 54e6 / 8.0, later + Duration::from_nanos(1)));
}

#[test]
fn a_sample_of_a_topic_is_compressed_once_for_all_peers() {
    let compression = Compression::new();
    let payload = text(10_000);
    assert_eq!(compression.ask(asker(1), name(1), &payload), later(1));
    assert_eq!(compression.ask(asker(2), name(1), &payload), later(1));
    assert_eq!(compression.ask(asker(3), name(2), &payload), later(2));
    assert_eq!(compression.poll_order(), Some(order(1, payload.clone())));
    assert_eq!(compression.poll_order(), Some(order(2, payload.clone())));
    assert_eq!(compression.poll_order(), None);
    let compressed = compress(payload.clone());
    let answer = |number| CompressionAnswer {
        number,
        compressed: compressed.clone(),
        took: Duration::from_micros(20),
    };
    assert_eq!(compression.handle_answer(NOW, &answer(1)), [asker(1), asker(2)]);
    assert_eq!(compression.handle_answer(NOW, &answer(1)), [], "it comes once");
    assert_eq!(compression.handle_answer(NOW, &answer(9)), [], "nobody asked");
    assert_eq!(
        compression.ask(asker(3), name(1), &payload),
        Some(CompressionReply::Known(compressed))
    );
    // Samples of services have no name, because no other flow may ask for them.
    assert_eq!(compression.ask(asker(1), None, &payload), later(3));
    assert_eq!(compression.ask(asker(2), None, &payload), later(4));
}

#[test]
fn an_incompressible_sample_is_not_tried_again_for_another_peer() {
    let compression = Compression::new();
    let payload = noise(10_000);
    assert_eq!(compression.ask(asker(1), name(1), &payload), later(1));
    let answer = CompressionAnswer { number: 1, compressed: None, took: Duration::ZERO };
    compression.handle_answer(NOW, &answer);
    assert_eq!(compression.ask(asker(2), name(1), &payload), Some(CompressionReply::Known(None)));
}

#[test]
fn orders_and_answers_that_are_kept_take_bounded_memory() {
    let compression = Compression::new();
    let long = text(LONGEST);
    assert_eq!(compression.ask(asker(1), None, &long), later(1), "one of any length");
    assert_eq!(compression.ask(asker(1), None, &text(SHORTEST)), None);
    compression.handle_answer(
        NOW,
        &CompressionAnswer { number: 1, compressed: None, took: Duration::ZERO },
    );
    let payload = noise(1 << 20);
    for number in 1..=100 {
        let Some(CompressionReply::Later(order)) =
            compression.ask(asker(1), name(number), &payload)
        else {
            panic!("there is room")
        };
        let compressed = Some(payload.slice(..700_000));
        compression.handle_answer(
            NOW,
            &CompressionAnswer { number: order, compressed, took: Duration::ZERO },
        );
    }
    let state = compression.0.borrow();
    assert_eq!((state.pending_bytes, state.pending.len(), state.named.len()), (0, 0, 0));
    assert!(state.kept_bytes <= MAX_SHARED_BYTES && state.kept.len() == 5, "{}", state.kept.len());
    drop(state);
    for number in 101..=100_000 {
        let Some(CompressionReply::Later(order)) =
            compression.ask(asker(1), name(number), &text(SHORTEST))
        else {
            panic!("there is room")
        };
        compression.handle_answer(
            NOW,
            &CompressionAnswer { number: order, compressed: None, took: Duration::ZERO },
        );
    }
    assert_eq!(compression.0.borrow().kept.len(), MAX_SHARED_BYTES / SHORTEST);
}

#[test]
fn the_compressor_backlog_counts_in_the_decision_to_compress() {
    let compression = Compression::new();
    assert!(compression.pays(20_000, 54e6 / 8.0, NOW));
    for _ in 0..3 {
        assert!(matches!(
            compression.ask(asker(1), None, &text(1 << 20)),
            Some(CompressionReply::Later(_))
        ));
    }
    assert!(!compression.pays(20_000, 54e6 / 8.0, NOW), "15 ms for a sample that takes 3 ms");
}

/// A faulty publisher may write two samples under one number, which the relays of two peers read.
#[test]
fn a_sample_of_another_length_or_topic_is_another_sample() {
    let compression = Compression::new();
    let payload = text(10_000);
    assert_eq!(compression.ask(asker(1), name(1), &payload), later(1));
    let longer = name(1).map(|name| SampleName { length: 12_000, ..name });
    assert_eq!(compression.ask(asker(2), longer, &text(12_000)), later(2));
    let elsewhere = name(1).map(|name| SampleName { topic: TopicHash([4; 16]), ..name });
    assert_eq!(compression.ask(asker(2), elsewhere, &payload), later(3));
}
