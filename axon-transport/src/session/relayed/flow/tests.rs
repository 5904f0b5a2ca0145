//! Tests both ends without a socket in between.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
};

use proptest::prelude::*;

use super::{incoming::LONG_SAMPLE_BYTES, *};
use crate::wire::session::{SampleFragment, SampleHeader};

const MAX: u64 = 1 << 20;

/// Returns a channel: of a publisher for even numbers, of requests or responses for odd ones.
fn channel(number: u8) -> FlowChannel {
    let writer = Gid([number / 2; 16]);
    if number.is_multiple_of(2) {
        FlowChannel::of(writer)
    } else {
        FlowChannel::between(writer, Gid([9; 16]))
    }
}

fn incoming() -> IncomingFlow {
    IncomingFlow::new(MAX, ArrivalPool::new(MAX))
}

fn departing(sequence: u64, len: usize) -> OutboundSample<Vec<u8>> {
    let meta = Meta::at_nanos(sequence, -(sequence as i64)).with_published_nanos(sequence * 5);
    let content = (0..len).map(|at| (at as u64 * 31 + sequence) as u8).collect();
    OutboundSample { meta, lost: sequence, content }
}

fn head(length: u32) -> Option<SampleHeader> {
    Some(SampleHeader { length, sequence: 1, source_timestamp: 0, lost: 0, published: 0 })
}

fn piece(number: u8, head: Option<SampleHeader>, len: usize) -> SampleFragment {
    let name = channel(number);
    SampleFragment { publisher: name.writer, head, bytes: vec![0; len], client: name.client }
}

#[test]
fn invalid_fragments_are_refused() {
    let open = || {
        let mut incoming = incoming();
        incoming.open(channel(1), 0);
        incoming
    };
    let refused = |pieces: &[SampleFragment]| {
        let mut incoming = open();
        let (last, before) = pieces.split_last().unwrap();
        for piece in before {
            assert_eq!(incoming.piece(piece.clone()), Ok(None));
        }
        incoming.piece(last.clone()).unwrap_err()
    };
    assert_eq!(
        refused(&[piece(1, head(MAX as u32 + 1), 0)]),
        FlowViolation::TooLarge(MAX as u32 + 1)
    );
    assert_eq!(refused(&[piece(1, None, 10)]), FlowViolation::OutOfPlace);
    assert_eq!(refused(&[piece(1, head(10), 11)]), FlowViolation::OutOfPlace);
    assert_eq!(refused(&[piece(1, head(10), 5), piece(1, None, 6)]), FlowViolation::OutOfPlace);
    assert_eq!(refused(&[piece(1, head(10), 5), piece(1, head(10), 5)]), FlowViolation::OutOfPlace);
    assert_eq!(refused(&[piece(1, head(10), 5), piece(1, None, 0)]), FlowViolation::OutOfPlace);
    let long = WINDOW as usize;
    assert_eq!(refused(&[piece(1, head(MAX as u32), long)]), FlowViolation::Overrun);
    let mut samples = open();
    for _ in 0..WINDOW / OVERHEAD {
        assert!(samples.piece(piece(1, head(0), 0)).unwrap().is_some());
    }
    assert_eq!(
        samples.piece(piece(1, head(0), 0)),
        Err(FlowViolation::Overrun),
        "empty ones count"
    );
    assert_eq!(open().piece(piece(2, None, 10)), Ok(None), "of a channel that was closed");
}

#[test]
fn a_long_sample_waits_for_room_and_gives_it_back() {
    let pool = ArrivalPool::new(100_000);
    let mut ends = [(); 2].map(|()| IncomingFlow::new(MAX, Arc::clone(&pool)));
    for incoming in &mut ends {
        incoming.open(channel(1), 0);
        assert_eq!(incoming.piece(piece(1, head(100_000), 0)), Ok(None));
    }
    let [first, second] = &mut ends;
    let more = OVERHEAD + 100_000 - WINDOW;
    let credit = channel(1).credit(more, None);
    assert_eq!(first.grants(), [credit]);
    assert_eq!(second.grants(), [], "the pool is one for all");
    assert!(second.is_short() && !first.is_short());
    let arrived = first.piece(piece(1, None, 100_000)).unwrap().unwrap();
    assert_eq!(pool.held(), more);
    let credit = Credit { bytes: WINDOW, done: Some(arrived.meta.sequence), ..credit };
    assert_eq!(first.done(&arrived), Some(credit), "what was granted is not given back");
    assert_eq!(pool.held(), 0);
    assert_eq!(second.grants().len(), 1);
    second.retain(|_| false);
    assert_eq!(pool.held(), 0);
    second.open(channel(1), 0);
    assert_eq!(second.piece(piece(1, head(100_000), 0)), Ok(None));
    assert_eq!(second.grants().len(), 1);
    drop(ends);
    assert_eq!(pool.held(), 0, "an end that is gone holds nothing");
}

#[test]
fn a_long_sample_that_is_not_read_holds_up_none_but_long_ones() {
    let mut incoming = IncomingFlow::new(1 << 30, ArrivalPool::new(u64::MAX));
    let lengths = [
        63 << 20,
        200 << 20,
        LONG_SAMPLE_BYTES as u32,
        LONG_SAMPLE_BYTES as u32,
        40 << 20,
        100_000,
    ];
    for (number, length) in (0..).zip(lengths) {
        incoming.open(channel(number), 0);
        assert_eq!(incoming.piece(piece(number, head(length), 0)), Ok(None));
    }
    let granted = |incoming: &mut IncomingFlow| {
        let names = incoming.grants().into_iter();
        let names =
            names.map(|credit| FlowChannel { writer: credit.publisher, client: credit.client });
        names.collect::<Vec<_>>()
    };
    assert_eq!(granted(&mut incoming), [0, 2, 3, 5].map(channel));
    assert!(!incoming.is_short(), "no other session can make room");
    incoming.retain(|name| *name != channel(0));
    assert_eq!(granted(&mut incoming), [channel(1)], "the next of those that are long");
    incoming.retain(|name| *name != channel(1));
    assert_eq!(granted(&mut incoming), [channel(4)]);
    // Samples that are not long are bounded as well.
    for number in 6..20 {
        incoming.open(channel(number), 0);
        assert_eq!(incoming.piece(piece(number, head(LONG_SAMPLE_BYTES as u32), 0)), Ok(None));
    }
    let more = granted(&mut incoming).len();
    assert!((2..=6).contains(&more), "{more} of at most eight in all");
}

#[test]
fn one_sample_may_be_longer_than_the_pool() {
    let mut incoming = IncomingFlow::new(MAX, ArrivalPool::new(1));
    incoming.open(channel(1), 0);
    assert_eq!(incoming.piece(piece(1, head(MAX as u32), 0)), Ok(None));
    assert_eq!(incoming.grants().len(), 1);
}

#[test]
fn an_image_does_not_hold_a_small_sample_up() {
    let next = |outgoing: &mut OutgoingFlow<Vec<u8>>| {
        let piece = outgoing.next_piece().unwrap();
        FlowChannel { writer: piece.publisher, client: piece.client }
    };
    let mut outgoing = OutgoingFlow::default();
    for number in [1, 2] {
        outgoing.open(channel(number), 0);
        outgoing.credit(&channel(number).credit(MAX, Some(0)));
    }
    assert!(outgoing.fill(|of| (*of == channel(1)).then(|| departing(1, 500_000))));
    assert_eq!(next(&mut outgoing), channel(1));
    assert!(outgoing.fill(|of| (*of == channel(2)).then(|| departing(1, 52))));
    let both = [(); 2].map(|()| next(&mut outgoing));
    assert!(both.contains(&channel(2)));
    assert_eq!(next(&mut outgoing), channel(1));
}

#[test]
fn a_channel_without_its_receiver_sends_nothing() {
    let mut outgoing = OutgoingFlow::default();
    outgoing.open(channel(1), 0);
    outgoing.credit(&channel(1).credit(1000, None));
    assert!(!outgoing.fill(|_| Some(departing(1, 1))), "of a channel before it");
    outgoing.credit(&channel(1).credit(1000, Some(0)));
    assert!(outgoing.fill(|_| Some(departing(1, 1))));
    assert!(!outgoing.is_idle(&channel(1)));
    let sent = outgoing.next_piece().unwrap();
    assert_eq!(outgoing.next_piece(), None);
    assert!(!outgoing.is_idle(&channel(1)), "nobody has said that it is where it belongs");
    let mut incoming = incoming();
    incoming.open(channel(1), 0);
    let arrived = incoming.piece(sent).unwrap().unwrap();
    outgoing.credit(&incoming.done(&arrived).unwrap());
    assert!(outgoing.is_idle(&channel(1)));
}

#[test]
fn credit_for_a_closed_channel_opens_no_later_one() {
    let mut outgoing = OutgoingFlow::default();
    outgoing.open(channel(1), 1);
    outgoing.close(&channel(1));
    outgoing.open(channel(1), 3);
    outgoing.credit(&channel(1).credit(1000, Some(2)));
    assert!(!outgoing.fill(|_| Some(departing(1, 1))), "it has not heard that it was closed");
    outgoing.credit(&channel(1).credit(1000, Some(3)));
    assert!(outgoing.fill(|_| Some(departing(1, 1))));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// Samples of any sizes on several channels, some of which are not read for a while: all samples arrive whole and
    /// in order, and neither side holds more than the credit.
    #[test]
    fn all_arrive_whole_in_order_and_within_bounds(
        sizes in prop::collection::vec((0u8..4, 0usize..200_000), 1..40),
        stuck in 0u8..4,
        order in any::<u64>(),
    ) {
        let pool = ArrivalPool::new(300_000);
        let mut incoming = IncomingFlow::new(MAX, Arc::clone(&pool));
        let mut outgoing = OutgoingFlow::default();
        let mut queues: HashMap<FlowChannel, VecDeque<OutboundSample<Vec<u8>>>> = HashMap::new();
        let mut expected: HashMap<FlowChannel, VecDeque<Vec<u8>>> = HashMap::new();
        for number in 0..4 {
            outgoing.open(channel(number), 0);
            outgoing.credit(&incoming.open(channel(number), 0).unwrap());
        }
        for (number, (of, len)) in sizes.iter().enumerate() {
            let sample = departing(number as u64, *len);
            expected.entry(channel(*of)).or_default().push_back(sample.content.clone());
            queues.entry(channel(*of)).or_default().push_back(sample);
        }
        let mut held: Vec<InboundSample> = Vec::new();
        let mut random = order;
        for round in 0.. {
            let all_there = queues.values().all(VecDeque::is_empty)
                && (0..4).all(|number| outgoing.is_idle(&channel(number)));
            if all_there {
                break;
            }
            prop_assert!(round < 100_000, "nothing moves any more");
            outgoing.fill(|of| queues.get_mut(of)?.pop_front());
            for credit in incoming.grants() {
                outgoing.credit(&credit);
            }
            prop_assert!(pool.held() <= 300_000);
            let mut sent = false;
            while let Some(piece) = outgoing.next_piece() {
                sent = true;
                prop_assert!(piece.bytes.len() <= PIECE);
                held.extend(incoming.piece(piece).unwrap());
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                if random >> 62 == 0 {
                    break;
                }
            }
            // The stuck channel goes on only when no other sample moves.
            let keep = held
                .iter()
                .any(|sample| sample.channel != channel(stuck)) || sent;
            let (go, stay): (Vec<_>, Vec<_>) =
                held.into_iter().partition(|sample| sample.channel != channel(stuck) || !keep);
            held = stay;
            for sample in go {
                let next = expected.get_mut(&sample.channel).unwrap().pop_front();
                prop_assert_eq!(Some(&sample.payload), next.as_ref());
                prop_assert_eq!(sample.lost, sample.meta.sequence);
                outgoing.credit(&incoming.done(&sample).unwrap());
            }
        }
        prop_assert_eq!(pool.held(), 0);
        prop_assert!(expected.values().all(VecDeque::is_empty));
    }

    #[test]
    fn no_sequence_of_pieces_panics_or_is_kept_beyond_the_bounds(
        pieces in prop::collection::vec(
            (0u8..3, prop::option::of(0u32..100_000), 0usize..40_000, any::<bool>()), 0..60),
    ) {
        let pool = ArrivalPool::new(50_000);
        let mut incoming = IncomingFlow::new(90_000, Arc::clone(&pool));
        incoming.open(channel(0), 0);
        incoming.open(channel(1), 0);
        let mut kept = 0;
        for (of, length, len, gone) in pieces {
            let arrived = incoming.piece(piece(of, length.and_then(head), len));
            incoming.grants();
            match arrived {
                Ok(Some(sample)) if gone => drop(incoming.done(&sample)),
                Ok(Some(sample)) => kept += sample.payload.len() as u64,
                Ok(None) => {}
                Err(_) => break,
            }
            prop_assert!(kept <= 2 * WINDOW + pool.held());
        }
        drop(incoming);
        prop_assert_eq!(pool.held(), 0);
    }
}
