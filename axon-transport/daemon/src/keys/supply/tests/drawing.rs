//! Tests the sender's requests to its KME, and its reaction to the answers.

use std::time::Duration;

use axon_envelope::{Delivery, KmeKey};

use super::{Pair, id, ms};
use crate::keys::{
    KeyMessage,
    request::{Answer, FailureKind, Fetched, KmeRequest, RequestFailure},
};

/// Returns the number of keys that a call requests.
fn number(request: &KmeRequest) -> u32 {
    let KmeRequest::Enc { number, .. } = request else { panic!("{request:?}") };
    *number
}

#[test]
fn an_empty_store_is_asked_for_less_and_less_often() {
    let mut pair = Pair::new();
    pair.kmes.left = Some(0);
    pair.sender.demand(pair.now, 10_000);
    let mut asked = Vec::new();
    for _ in 0..10_000 {
        while let Some(request) = pair.sender.poll_request(pair.now) {
            if let KmeRequest::Enc { number, .. } = request {
                asked.push(number);
            }
            let answer = pair.kmes.answer(request);
            pair.sender.handle_answer(pair.now, answer);
        }
        pair.now += ms(10);
    }
    assert!(asked.len() < 80, "{} calls in 100 s", asked.len());
    assert_eq!(asked[0], 8);
    assert_eq!(asked.last(), Some(&1));
    pair.kmes.left = Some(3);
    pair.now += ms(2000);
    pair.run();
    assert_eq!(pair.announced(), 3, "what there is, is had");
}

#[test]
fn a_kme_that_asks_for_a_pause_has_it_but_not_for_ever() {
    for (asked, pause) in [(ms(7000), ms(7000)), (Duration::MAX, ms(60_000))] {
        let mut pair = Pair::new();
        let status = pair.sender.poll_request(pair.now).unwrap();
        let answer = pair.kmes.answer(status);
        pair.sender.handle_answer(pair.now, answer);
        let request = pair.sender.poll_request(pair.now).unwrap();
        let busy = RequestFailure {
            retry_after: Some(asked),
            ..RequestFailure::new(FailureKind::Unavailable, "the KME is busy")
        };
        pair.sender.handle_answer(pair.now, Answer { request, took: ms(10), outcome: Err(busy) });
        while pair.now < pause {
            if let Some(request) = pair.sender.poll_request(pair.now) {
                assert!(
                    matches!(request, KmeRequest::Status { .. }),
                    "{:?}: {request:?}",
                    pair.now
                );
                let answer = pair.kmes.answer(request);
                pair.sender.handle_answer(pair.now, answer);
            }
            pair.now += ms(100);
        }
        assert_eq!(pair.now, pause);
        pair.run();
        assert!(pair.announced() > 0, "after {pause:?}");
    }
}

#[test]
fn a_call_that_may_have_lost_keys_is_not_repeated_at_once() {
    let mut pair = Pair::new();
    let status = pair.sender.poll_request(pair.now).unwrap();
    assert!(pair.sender.poll_request(pair.now).is_none(), "not before the KME told its limits");
    let answer = pair.kmes.answer(status);
    pair.sender.handle_answer(pair.now, answer);
    let request = pair.sender.poll_request(pair.now).unwrap();
    pair.kmes.failures = vec![FailureKind::Ambiguous];
    let answer = pair.kmes.answer(request);
    pair.sender.handle_answer(pair.now, answer);
    assert!(pair.sender.poll_request(pair.now + ms(999)).is_none());
    assert!(pair.sender.poll_request(pair.now + ms(1000)).is_some());
}

#[test]
fn a_kme_without_a_status_is_asked_for_one_key_at_a_time() {
    let mut pair = Pair::new();
    let status = pair.sender.poll_request(pair.now).unwrap();
    pair.kmes.failures = vec![FailureKind::Unauthorized];
    let answer = pair.kmes.answer(status);
    pair.sender.handle_answer(pair.now, answer);
    for _ in 0..4 {
        assert_eq!(number(&pair.sender.poll_request(pair.now).unwrap()), 1);
    }
    assert!(pair.sender.poll_request(pair.now).is_none());
}

#[test]
fn answers_to_another_call_give_nothing_and_are_not_asked_for_in_a_loop() {
    let mut pair = Pair::new();
    let status = pair.sender.poll_request(pair.now).unwrap();
    let key = (id("key-of-status"), KmeKey::from_slice(&[1; 32]).unwrap());
    let outcome = Ok(Fetched::Keys(vec![key]));
    pair.sender.handle_answer(pair.now, Answer { request: status, took: ms(1), outcome });
    let mut calls = 0;
    while let Some(request) = pair.sender.poll_request(pair.now) {
        number(&request);
        calls += 1;
        assert!(calls <= 4);
        let outcome = Ok(Fetched::Stock(crate::keys::Stock {
            stored_key_count: 1000,
            max_key_per_request: 128,
        }));
        pair.sender.handle_answer(pair.now, Answer { request, took: ms(1), outcome });
    }
    assert!(pair.sender.poll_message(pair.now).is_none(), "nothing to announce");
    let statistics = pair.sender.statistics(pair.now);
    assert_eq!((statistics.asked, statistics.last_failure.is_some()), (0, true));
}

#[test]
fn repeated_keys_of_a_kme_are_used_once_and_asked_for_at_a_bounded_rate() {
    let mut pair = Pair::new();
    pair.run();
    assert_eq!(pair.announced(), 4);
    // All four keys are used up and retired, and then the KME counts from one again.
    pair.kmes.left = Some(0);
    while pair.seal(Delivery::Reliable).is_ok() {}
    pair.run();
    pair.kmes = super::Kmes::default();
    pair.now += ms(2_000);
    pair.run();
    assert!(pair.kmes.issued <= 4, "{} keys burnt at once", pair.kmes.issued);
    assert_eq!(pair.sender.statistics(pair.now).failed, u64::from(pair.kmes.issued));
    assert_eq!(pair.announced(), 4, "none of them a second time");
    assert!(pair.seal(Delivery::Reliable).is_err());
    for _ in 0..60 {
        pair.now += ms(1_000);
        pair.run();
    }
    assert!(pair.announced() > 4, "it gives others by now");
    let mut names: Vec<String> = Vec::new();
    for message in &pair.log {
        if let KeyMessage::Announce(key_ids) = message {
            names.extend(key_ids.iter().map(ToString::to_string));
        }
    }
    let all = names.len();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), all, "no key_ID twice");
}

#[test]
fn a_key_that_proved_a_name_is_not_drawn_again_nor_adopted_twice() {
    let mut pair = Pair::new();
    let (key_id, key) = (id("key-1"), KmeKey::from_slice(&[9; 32]).unwrap());
    pair.sender.adopt(pair.now, 1, key_id.clone(), key).unwrap();
    let again = KmeKey::from_slice(&[9; 32]).unwrap();
    pair.sender.adopt(pair.now, 1, key_id, again).unwrap();
    let statistics = pair.sender.statistics(pair.now);
    assert_eq!((statistics.ready, statistics.failed), (1, 1));
    pair.draw();
    let Some((_, KeyMessage::Announce(key_ids))) = pair.sender.poll_message(pair.now) else {
        panic!()
    };
    assert!(!key_ids.contains(&id("key-1")), "the KME's key-1 was there before: {key_ids:?}");
}

#[test]
fn keys_adopted_over_and_over_are_bounded() {
    let mut pair = Pair::new();
    for i in 0..5_000 {
        let key = KmeKey::from_slice(&[9; 32]).unwrap();
        // Half of the keys are on a connection that is not attached.
        pair.sender.adopt(pair.now, i % 2, id(&format!("proof-{i}")), key).unwrap();
    }
    assert_eq!(pair.sender.statistics(pair.now).ready, 2_048);
    let mut announced = 0;
    while let Some((_, message)) = pair.sender.poll_message(pair.now) {
        let KeyMessage::Announce(key_ids) = message else { panic!("{message:?}") };
        announced += key_ids.len();
    }
    assert_eq!(announced, 2_048);
}

#[test]
fn announced_and_ready_keys_are_at_most_a_quarter_of_the_stock() {
    let mut pair = Pair::new();
    pair.now = ms(1_000);
    pair.kmes.stock = 100;
    pair.sender.demand(pair.now, 100_000);
    pair.run();
    assert_eq!((pair.announced(), pair.sender.statistics(pair.now).target), (25, 25));
    pair.now += ms(5_000);
    pair.kmes.stock = 1;
    pair.run();
    assert_eq!((pair.announced(), pair.sender.statistics(pair.now).target), (25, 1));
    pair.now += ms(5_000);
    pair.kmes.stock = 0;
    pair.sender.demand(pair.now, 100_000);
    pair.run();
    assert_eq!(pair.sender.statistics(pair.now).target, pair.announced(), "0 says nothing");
    assert!(pair.announced() > 25);
}

#[test]
fn the_last_key_of_a_stock_is_for_any_message() {
    let mut pair = Pair::new();
    pair.kmes.stock = 1;
    pair.run();
    assert_eq!(pair.announced(), 1);
    assert!(pair.seal(Delivery::BestEffort).is_ok(), "a reserve that leaves none is none");
}

#[test]
fn it_warns_when_the_kme_gives_too_little() {
    let mut pair = Pair::new();
    pair.kmes.left = Some(0);
    for tick in 0..2_000 {
        if tick % 20 == 0 {
            pair.kmes.left = pair.kmes.left.map(|left| left + 1);
        }
        if tick == 50 {
            assert!(pair.sender.warning(pair.now).is_none(), "no supply was measured");
        }
        pair.sender.demand(pair.now, 1);
        while pair.seal(Delivery::Reliable).is_ok() {}
        pair.run();
        pair.now += ms(10);
    }
    let warning = pair.sender.warning(pair.now).expect("10 keys/s of 5");
    assert!(warning.supply > 4.5 && warning.supply < 5.5, "{warning}");
    assert!(warning.demand > 8.0 && warning.demand < 10.5, "{warning}");
}

#[test]
fn a_shrinking_stock_warns_before_it_is_empty() {
    let mut pair = Pair::new();
    let drawn = |pair: &Pair| u64::from(pair.kmes.issued);
    pair.kmes.stock = 1_000;
    for tick in 0..500 {
        pair.sender.demand(pair.now, 1);
        pair.run();
        pair.seal(Delivery::Reliable).unwrap();
        if tick == 499 {
            // 15 keys arrived meanwhile.
            pair.kmes.stock = 1_000 - drawn(&pair) + 15;
        }
        pair.now += ms(10);
    }
    assert!(pair.sender.warning(pair.now).is_none(), "every key came at once");
    pair.run();
    let warning = pair.sender.warning(pair.now).expect("3 keys/s come in");
    assert!((warning.supply - 3.0).abs() < 0.01, "{warning}");
    pair.now += Duration::from_secs(5);
    let drawn_before = drawn(&pair);
    pair.run();
    assert_eq!(drawn(&pair), drawn_before, "so that the stock is as it was");
    assert!(pair.sender.statistics(pair.now).supply.is_none(), "a steady stock shows no limit");
}
