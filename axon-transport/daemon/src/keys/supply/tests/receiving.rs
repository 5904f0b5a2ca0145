use std::time::Duration;

use axon_envelope::{Delivery, KeyId};

use super::{Pair, exporters, id, ms, retire};
use crate::keys::{
    KeyMessage,
    request::{Answer, FailureKind, RequestFailure},
};

#[test]
fn a_batch_with_an_unknown_key_is_fetched_one_by_one() {
    let mut pair = Pair::new();
    let known: Vec<KeyId> = (0..3).map(|_| pair.kmes.issue().0).collect();
    let announce = KeyMessage::Announce(vec![known[0].clone(), id("lost"), known[1].clone()]);
    pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
    let mut said = Vec::new();
    while let Some(request) = pair.receiver.poll_request(pair.now) {
        let answer = pair.kmes.answer(request);
        pair.receiver.handle_answer(pair.now, answer);
    }
    while let Some((_, message)) = pair.receiver.poll_message() {
        said.push(message);
    }
    let (ready, failed): (Vec<_>, Vec<_>) =
        said.iter().partition(|m| matches!(m, KeyMessage::Ready { .. }));
    assert_eq!(ready.len(), 2);
    assert!(matches!(failed[..], [KeyMessage::Failed { key_id, .. }] if *key_id == id("lost")));
}

#[test]
fn a_late_announcement_on_a_connection_before_takes_no_key_from_its_successor() {
    for is_fetched in [false, true] {
        let mut pair = Pair::new();
        let (key_id, _) = pair.kmes.issue();
        pair.connect();
        let announce = KeyMessage::Announce(vec![key_id.clone()]);
        pair.receiver.handle_message(pair.now, 2, &announce).unwrap();
        if !is_fetched {
            pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
        }
        pair.fetch();
        assert!(matches!(pair.receiver.poll_message(), Some((2, KeyMessage::Ready { .. }))));
        pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
        assert!(pair.receiver.poll_message().is_none());
        assert!(pair.receiver.opener(2).unwrap().contains(key_id.as_bytes()), "{is_fetched}");
    }
}

/// Two daemons that dial each other have two connections at a time. The connection that was opened first may be elected
/// last.
#[test]
fn a_key_goes_to_the_last_elected_connection_in_any_opening_order() {
    for is_fetched in [false, true] {
        let mut pair = Pair::new();
        let (key_id, _) = pair.kmes.issue();
        for connection in [7, 8] {
            pair.receiver.attach(pair.now, connection, &exporters(connection)).unwrap();
        }
        let announce = KeyMessage::Announce(vec![key_id.clone()]);
        for connection in [8, 7] {
            pair.receiver.elect(connection);
            pair.receiver.handle_message(pair.now, connection, &announce).unwrap();
            if is_fetched && connection == 8 {
                pair.fetch();
                assert!(matches!(pair.receiver.poll_message(), Some((8, _))));
            }
        }
        pair.fetch();
        assert!(matches!(pair.receiver.poll_message(), Some((7, KeyMessage::Ready { .. }))));
        assert!(pair.receiver.opener(7).unwrap().contains(key_id.as_bytes()), "{is_fetched}");
        // A message on the earlier connection arrives late.
        pair.receiver.handle_message(pair.now, 8, &announce).unwrap();
        assert!(pair.receiver.opener(7).unwrap().contains(key_id.as_bytes()), "{is_fetched}");
    }
}

#[test]
fn dec_keys_is_tried_three_times_with_the_same_ids() {
    let mut pair = Pair::new();
    let (key_id, _) = pair.kmes.issue();
    pair.kmes.failures = vec![FailureKind::Ambiguous, FailureKind::Unreachable];
    pair.receiver.handle_message(pair.now, 1, &KeyMessage::Announce(vec![key_id])).unwrap();
    let mut tries = 0;
    for _ in 0..10 {
        while let Some(request) = pair.receiver.poll_request(pair.now) {
            tries += 1;
            let answer = pair.kmes.answer(request);
            pair.receiver.handle_answer(pair.now, answer);
        }
        pair.now += ms(1000);
    }
    assert_eq!(tries, 3);
    assert!(matches!(pair.receiver.poll_message(), Some((1, KeyMessage::Ready { .. }))));

    pair.kmes.failures = vec![FailureKind::Unreachable; 9];
    pair.receiver.handle_message(pair.now, 1, &KeyMessage::Announce(vec![id("k")])).unwrap();
    for _ in 0..10 {
        while let Some(request) = pair.receiver.poll_request(pair.now) {
            let answer = pair.kmes.answer(request);
            pair.receiver.handle_answer(pair.now, answer);
        }
        pair.now += ms(1000);
    }
    assert_eq!(pair.kmes.failures.len(), 6);
    assert!(matches!(pair.receiver.poll_message(), Some((1, KeyMessage::Failed { .. }))));
}

#[test]
fn the_next_try_of_dec_keys_is_when_the_kme_says() {
    for (asked, pause) in [(ms(0), ms(2000)), (ms(3000), ms(5000)), (Duration::MAX, ms(12_000))] {
        let mut pair = Pair::new();
        let (key_id, _) = pair.kmes.issue();
        pair.receiver.handle_message(pair.now, 1, &KeyMessage::Announce(vec![key_id])).unwrap();
        let request = pair.receiver.poll_request(pair.now).unwrap();
        let busy = RequestFailure {
            retry_after: Some(asked),
            ..RequestFailure::new(FailureKind::Unavailable, "the KME is busy")
        };
        pair.receiver.handle_answer(pair.now, Answer { request, took: ms(10), outcome: Err(busy) });
        assert_eq!(pair.receiver.poll_timeout(), Some(pause));
        assert!(pair.receiver.poll_request(pause - ms(1)).is_none());
        let request = pair.receiver.poll_request(pause).unwrap();
        let answer = pair.kmes.answer(request);
        pair.receiver.handle_answer(pause, answer);
        assert!(matches!(pair.receiver.poll_message(), Some((1, KeyMessage::Ready { .. }))));
    }
}

#[test]
fn a_peer_that_only_announces_is_stopped_at_the_cap() {
    let mut pair = Pair::new();
    for i in 0..600 {
        let key_ids = (0..16).map(|j| id(&format!("flood-{i}-{j}"))).collect();
        pair.receiver.handle_message(pair.now, 1, &KeyMessage::Announce(key_ids)).unwrap();
    }
    assert_eq!(pair.receiver.statistics().fetching, 4096);
    assert_eq!(pair.receiver.statistics().failed, 600 * 16 - 4096);
    let mut in_flight = 0;
    while pair.receiver.poll_request(pair.now).is_some() {
        in_flight += 1;
    }
    assert_eq!(in_flight, 4);
}

#[test]
fn contradicting_masks_end_the_link() {
    let mut pair = Pair::new();
    pair.run();
    let first = pair.log.iter().find_map(|m| match m {
        KeyMessage::Ready { key_id, .. } => Some(key_id.to_string()),
        _ => None,
    });
    let key_id = first.unwrap();
    assert!(pair.receiver.handle_message(pair.now, 1, &retire(&key_id, 1, 2)).is_err());
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
    assert!(
        pair.receiver.handle_message(pair.now, 1, &retire(&key_id, 0, 0)).is_err(),
        "index 0 opened"
    );
    pair.receiver.handle_message(pair.now, 1, &retire("never-seen", 3, 1)).unwrap();
    assert!(
        pair.receiver.handle_message(pair.now, 9, &retire(&key_id, 1, 1)).is_err(),
        "no such link"
    );
}

#[test]
fn messages_that_never_came_are_counted_once() {
    let mut pair = Pair::new();
    pair.run();
    // Three messages are sealed under one key, and one of them arrives.
    for arrives in [true, false, false] {
        let envelope = pair.seal(Delivery::BestEffort).unwrap();
        if arrives {
            pair.open(envelope).unwrap();
        }
    }
    let missing = |pair: &Pair| pair.receiver.statistics().messages_missing;
    pair.connect();
    pair.run();
    pair.receiver.handle_timeout(pair.now);
    assert_eq!(missing(&pair), 0, "they may still come");
    pair.now += ms(5_000);
    pair.receiver.handle_timeout(pair.now);
    assert_eq!(missing(&pair), 2);
    pair.seal(Delivery::BestEffort).unwrap();
    pair.connect();
    pair.now += ms(5_000);
    // The connection closes before the next check.
    pair.close(pair.conn - 1);
    assert_eq!(missing(&pair), 3);
    pair.receiver.handle_timeout(pair.now);
    assert_eq!((missing(&pair), pair.receiver.statistics().expired), (3, 2));
}

#[test]
fn names_that_no_kme_knows_cost_a_bounded_number_of_calls() {
    let mut pair = Pair::new();
    let mut calls = 0;
    for tick in 0..6_000 {
        let made_up = (0..16).map(|i| id(&format!("made-up-{tick}-{i}"))).collect();
        pair.receiver.handle_message(pair.now, 1, &KeyMessage::Announce(made_up)).unwrap();
        while let Some(request) = pair.receiver.poll_request(pair.now) {
            calls += 1;
            let answer = pair.kmes.answer(request);
            pair.receiver.handle_answer(pair.now, answer);
        }
        while pair.receiver.poll_message().is_some() {}
        pair.now += ms(10);
    }
    assert!(calls <= 300 + 60 * 5 + 4, "{calls} in a minute");
    let next = pair.receiver.poll_timeout().expect("calls go on");
    assert!(next <= pair.now + ms(1000));
}
