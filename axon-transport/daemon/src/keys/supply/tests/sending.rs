use std::time::Duration;

use axon_envelope::Delivery;

use super::{Pair, ROUTE, id, ms, retire};
use crate::keys::{KeyMessage, KeyReceiver, KmeRequest, NoKey, request::FailureKind};

#[test]
fn nothing_is_sealed_before_ready() {
    let mut pair = Pair::new();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
    pair.draw();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None), "keys held, none announced");
    let (_, announce) = pair.sender.poll_message(pair.now).unwrap();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None), "announced, none READY");
    pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_wrong_proof_retires_its_key_and_nothing_else() {
    let mut pair = Pair::new();
    pair.draw();
    let (_, KeyMessage::Announce(key_ids)) = pair.sender.poll_message(pair.now).unwrap() else {
        panic!()
    };
    for (wrong, proof) in [[0; 32], [0xff; 32]].into_iter().enumerate() {
        let key_id = key_ids[wrong].clone();
        let ready = KeyMessage::Ready { key_id: key_id.clone(), proof };
        pair.sender.handle_message(pair.now, 1, &ready).unwrap();
        let expected = retire(std::str::from_utf8(key_id.as_bytes()).unwrap(), 0, 0);
        assert_eq!(pair.sender.poll_message(pair.now), Some((1, expected)));
        // A repeated READY concerns a key that neither side holds any more.
        pair.sender.handle_message(pair.now, 1, &ready).unwrap();
    }
    let statistics = pair.sender.statistics(pair.now);
    assert_eq!((statistics.disagreed, statistics.announced), (2, key_ids.len() - 2));
    let unknown = KeyMessage::Ready { key_id: id("nobody's"), proof: [0; 32] };
    pair.sender.handle_message(pair.now, 1, &unknown).unwrap();
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
    for unexpected in [KeyMessage::Announce(vec![id("k")]), retire("k", 0, 0)] {
        assert!(pair.sender.handle_message(pair.now, 1, &unexpected).is_err());
    }
    // The other keys stay valid.
    let announce = KeyMessage::Announce(key_ids[2..].to_vec());
    pair.receiver.handle_message(pair.now, 1, &announce).unwrap();
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn one_wrong_key_is_reported_and_gone_from_both_ends_for_good() {
    let mut pair = Pair::new();
    pair.draw();
    let wrong = id("key-1");
    pair.kmes.stored.insert(wrong.clone(), [9; 32]);
    pair.run();
    assert_eq!(pair.sender.statistics(pair.now).ready, 3);
    assert!(!pair.receiver.opener(1).unwrap().contains(wrong.as_bytes()));
    let report = pair.sender.disagreement(pair.now).unwrap();
    assert_eq!((report.key_id, report.keys), (wrong.clone(), 1));
    assert_eq!(pair.sender.disagreement(pair.now), None);
    // Neither end carries the key to the next connection.
    pair.close(1);
    let before = pair.log.len();
    pair.connect();
    pair.now += ms(1000);
    pair.run();
    let again = |m: &KeyMessage| matches!(m, KeyMessage::Announce(ids) if ids.contains(&wrong));
    assert!(!pair.log[before..].iter().any(again));
    assert_eq!(pair.sender.statistics(pair.now).ready, 4);
    assert_eq!(pair.sender.statistics(pair.now).disagreed, 1);
}

/// An outage of this host's KME excuses a peer that takes nothing. A lack of keys that the peer causes does not.
#[test]
fn shortage_of_keys_blames_the_kme_only_if_none_is_left_or_refused() {
    let failed = |pair: &Pair| pair.sender.statistics(pair.now).last_failure.is_some();
    let mut pair = Pair::new();
    assert!(!pair.sender.lacks_keys_of_kme(), "nothing was asked for");
    // A failed status call says nothing about keys.
    pair.kmes.failures = vec![FailureKind::Unavailable];
    let request = pair.sender.poll_request(pair.now).unwrap();
    assert!(matches!(request, KmeRequest::Status { .. }));
    let answer = pair.kmes.answer(request);
    pair.sender.handle_answer(pair.now, answer);
    assert!(failed(&pair) && !pair.sender.lacks_keys_of_kme());

    let mut pair = Pair::new();
    pair.kmes.left = Some(0);
    pair.draw();
    assert!(failed(&pair) && pair.sender.lacks_keys_of_kme());

    // The peer has not answered for the keys that the KME gave before.
    let mut pair = Pair::new();
    pair.draw();
    let (conn, announced) = pair.sender.poll_message(pair.now).unwrap();
    let KeyMessage::Announce(key_ids) = announced else { panic!("{announced:?}") };
    pair.kmes.left = Some(0);
    pair.now += Duration::from_secs(1);
    pair.sender.demand(pair.now, 1_000);
    pair.draw();
    assert!(failed(&pair) && !pair.sender.lacks_keys_of_kme());
    // The peer fails all of them, after the KME failed.
    for key_id in key_ids {
        assert!(!pair.sender.lacks_keys_of_kme());
        let failed = KeyMessage::Failed { key_id, reason: String::new() };
        pair.sender.handle_message(pair.now, conn, &failed).unwrap();
    }
    assert!(!pair.sender.lacks_keys_of_kme(), "the peer refused them");
    // The state lasts until the next call fails.
    pair.now += Duration::from_secs(60);
    pair.draw();
    assert!(pair.sender.lacks_keys_of_kme());
}

#[test]
fn a_peer_that_fails_every_proof_burns_few_keys() {
    let mut pair = Pair::new();
    for second in 0..60 {
        for _ in 0..100 {
            pair.draw();
            while let Some((conn, message)) = pair.sender.poll_message(pair.now) {
                let KeyMessage::Announce(key_ids) = message else { continue };
                for key_id in key_ids {
                    let ready = KeyMessage::Ready { key_id, proof: [1; 32] };
                    pair.sender.handle_message(pair.now, conn, &ready).unwrap();
                }
            }
            pair.now += ms(10);
        }
        // A new connection does not reset the pause.
        if second % 2 == 0 {
            pair.connect();
        }
    }
    assert!(pair.kmes.issued <= 40, "{} keys in a minute", pair.kmes.issued);
    pair.now += Duration::from_secs(30);
    pair.run();
    assert!(pair.seal(Delivery::Reliable).is_ok(), "well again");
}

#[test]
fn the_last_keys_are_kept_for_reliable() {
    let mut pair = Pair::new();
    pair.kmes.left = Some(4);
    pair.run();
    let mut best_effort = 0;
    while pair.seal(Delivery::BestEffort).is_ok() {
        best_effort += 1;
    }
    assert_eq!(best_effort, 20, "two keys of four");
    assert_eq!(pair.sender.available(Delivery::BestEffort), 0);
    assert_eq!(pair.sender.available(Delivery::Reliable), 20);
    assert_eq!(pair.seal(Delivery::BestEffort), Err(NoKey::Reserved));
    let mut reliable = 0;
    while pair.seal(Delivery::Reliable).is_ok() {
        reliable += 1;
    }
    assert_eq!(reliable, 20);
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::None));
}

#[test]
fn unused_keys_move_to_the_next_connection_without_another_dec_keys() {
    let mut pair = Pair::new();
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    let announced = pair.announced();
    let stored = pair.kmes.stored.len();
    pair.connect();
    assert!(matches!(pair.log.last(), Some(KeyMessage::Retire { .. })), "the begun one ends");
    pair.run();
    assert_eq!(pair.failures(), 0);
    assert_eq!(pair.kmes.stored.len(), stored, "nothing was fetched twice");
    assert_eq!(pair.announced(), announced + 3 + 1, "three move, one is new");
    // A message that was sealed on the old connection opens only there.
    let mut copy = envelope.clone();
    assert!(pair.open(envelope).is_err());
    let old = pair.receiver.opener(1).unwrap();
    old.open_in_place(pair.now, ROUTE, &mut copy).unwrap();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn unused_keys_survive_a_lost_connection() {
    let mut pair = Pair::new();
    pair.run();
    pair.seal(Delivery::Reliable).unwrap();
    assert_eq!(pair.sender.attached(), Some(1));
    pair.close(1);
    assert_eq!(pair.sender.attached(), None);
    assert_eq!(pair.seal(Delivery::Reliable), Err(NoKey::Detached));
    pair.now += ms(60_000);
    pair.connect();
    pair.run();
    assert_eq!(pair.failures(), 0);
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_restarted_receiver_costs_the_keys_and_no_more() {
    let mut pair = Pair::new();
    pair.run();
    pair.close(1);
    pair.receiver = KeyReceiver::new("sae-b", "sae-a").unwrap();
    pair.connect();
    pair.run();
    assert_eq!(pair.failures(), 4, "the KME gave them to the receiver before");
    pair.now += ms(200);
    pair.run();
    let envelope = pair.seal(Delivery::Reliable).unwrap();
    pair.open(envelope).unwrap();
}

#[test]
fn a_peer_that_refuses_every_key_burns_few() {
    let mut pair = Pair::new();
    for _ in 0..6_000 {
        pair.draw();
        while let Some((conn, message)) = pair.sender.poll_message(pair.now) {
            let KeyMessage::Announce(key_ids) = message else { continue };
            for key_id in key_ids {
                let failed = KeyMessage::Failed { key_id, reason: String::new() };
                pair.sender.handle_message(pair.now, conn, &failed).unwrap();
            }
        }
        pair.now += ms(10);
    }
    assert!(pair.kmes.issued <= 40, "{} keys in a minute", pair.kmes.issued);
    pair.now += Duration::from_secs(30);
    pair.run();
    assert!(pair.seal(Delivery::Reliable).is_ok(), "well again");
}

/// A KME that hangs has this effect: the keys that were requested from it are lost.
#[test]
fn many_keys_that_are_refused_together_are_one_cause_to_wait() {
    let mut pair = Pair::new();
    for _ in 0..100 {
        pair.run();
        pair.sender.demand(pair.now, 100);
        for _ in 0..10 {
            let _ = pair.seal(Delivery::Reliable);
        }
        pair.now += ms(10);
    }
    while pair.seal(Delivery::Reliable).is_ok() {}
    let mut refused = 0;
    pair.draw();
    while let Some((conn, message)) = pair.sender.poll_message(pair.now) {
        let KeyMessage::Announce(key_ids) = message else { continue };
        for key_id in key_ids {
            refused += 1;
            let failed = KeyMessage::Failed { key_id, reason: String::new() };
            pair.sender.handle_message(pair.now, conn, &failed).unwrap();
        }
    }
    assert!(refused > 8, "{refused}");
    assert!(pair.seal(Delivery::Reliable).is_err());
    pair.now += ms(100);
    pair.run();
    assert!(pair.seal(Delivery::Reliable).is_ok());
}

#[test]
fn a_peer_that_is_owed_many_keys_and_refuses_them_soon_gets_few() {
    let mut pair = Pair::new();
    for _ in 0..6_000 {
        pair.sender.demand(pair.now, 1000);
        pair.draw();
        while let Some((conn, message)) = pair.sender.poll_message(pair.now) {
            let KeyMessage::Announce(key_ids) = message else { continue };
            for key_id in key_ids {
                let ready = KeyMessage::Ready { key_id, proof: [1; 32] };
                pair.sender.handle_message(pair.now, conn, &ready).unwrap();
            }
        }
        pair.now += ms(10);
    }
    assert!(pair.kmes.issued <= 2 * 256 + 40, "{} keys in a minute", pair.kmes.issued);
}

#[test]
fn a_key_in_use_ends_after_an_hour() {
    let mut pair = Pair::new();
    pair.run();
    pair.seal(Delivery::Reliable).unwrap();
    pair.now += Duration::from_secs(3599);
    pair.run();
    assert!(!pair.log.iter().any(|m| matches!(m, KeyMessage::Retire { .. })));
    pair.now += Duration::from_secs(1);
    pair.run();
    let retire = pair.log.iter().find_map(|m| match m {
        KeyMessage::Retire { used, reliable, .. } => Some((used.bits(), reliable.bits())),
        _ => None,
    });
    assert_eq!(retire, Some((1, 1)));
    pair.seal(Delivery::Reliable).unwrap();
}

#[test]
fn an_unanswered_announcement_is_retired() {
    let mut pair = Pair::new();
    pair.draw();
    assert!(matches!(pair.sender.poll_message(pair.now), Some((1, KeyMessage::Announce(_)))));
    assert_eq!(pair.sender.statistics(pair.now).announced, 4);
    pair.now += ms(60_000);
    assert!(matches!(pair.sender.poll_message(pair.now), Some((1, KeyMessage::Retire { .. }))));
    assert_eq!(pair.sender.statistics(pair.now).announced, 0);
}

#[test]
fn an_announcement_grows_old_over_all_its_connections() {
    let mut pair = Pair::new();
    pair.draw();
    let announced = |pair: &mut Pair| match pair.sender.poll_message(pair.now) {
        Some((_, KeyMessage::Announce(key_ids))) => key_ids,
        _ => Vec::new(),
    };
    let first = announced(&mut pair);
    assert_eq!(first.len(), 4);
    for _ in 0..5 {
        pair.now += ms(10_000);
        pair.sender.detach(pair.now, pair.conn);
        pair.connect();
        assert_eq!(announced(&mut pair).len(), 4, "again, since nobody answered");
    }
    pair.now += ms(10_000);
    pair.sender.detach(pair.now, pair.conn);
    pair.connect();
    assert_eq!(announced(&mut pair), [], "a minute is enough");
    assert_eq!(pair.sender.statistics(pair.now).failed, 4);
    pair.now += ms(1000);
    pair.run();
    assert!(pair.seal(Delivery::Reliable).is_ok());
}
